"""A model before its first step: places of picture and planes speak one language."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from xplanes.lrm.config import LRMConfig
from xplanes.lrm.openlrm import OpenLRM

SHARPNESS = 1.2
"""Factor on queries and keys that are compared as they are, for attention to the picture."""

SELF_SHARPNESS = 0.8
"""The same for attention among the planes."""

SLOWEST, FASTEST = 0.8, 16.0
"""Range of the waves' frequencies, in radians per unit length."""


def init_model(config: LRMConfig, seed: int) -> OpenLRM:
    """A model with random weights and places that match between picture and planes.

    A token is placed by waves along x, y and z, in channels of their own. A patch of the picture
    has an x and a z, a token of plane "xz" too, and one of "xy" has an x: with equal query and key
    weights each attends to what lies in its line of sight from the first step on.

    Args:
        config: Sizes of the model.
        seed: Source of the random weights.
    """
    generator = torch.Generator().manual_seed(seed)
    model = OpenLRM(config)
    for module in model.modules():
        if isinstance(module, nn.Linear):
            nn.init.normal_(module.weight, std=module.in_features**-0.5, generator=generator)
            if module.bias is not None:
                nn.init.zeros_(module.bias)
        elif isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
            fan = module.weight[0].numel() if isinstance(module, nn.Conv2d) else config.width
            nn.init.normal_(module.weight, std=fan**-0.5, generator=generator)
            assert module.bias is not None
            nn.init.zeros_(module.bias)
    places = _places(config)
    with torch.no_grad():
        for block in [*model.encoder.blocks, *model.blocks]:
            for name, child in block.named_modules():  # branches start small
                if name.endswith(("attention.out", "mlp.2")) and "image" not in name:
                    child.weight.mul_(0.2)  # type: ignore[operator]
        patch = model.encoder.patch
        assert patch.bias is not None
        patch.bias.copy_(-patch.weight.sum(dim=(1, 2, 3)))  # nothing to say of white
        for block in model.blocks:
            _compare(block.image_attention, SHARPNESS)  # type: ignore[arg-type]
            _compare(block.self_attention, SELF_SHARPNESS)  # type: ignore[arg-type]
            for norm in (block.norm1, block.norm2, block.norm3):
                nn.init.zeros_(norm.modulation[1].weight)  # type: ignore[index]
        model.encoder.position[0, 1:] = _patch_places(config, places)
        model.position[0] = 0.5 * _plane_places(config, places)
        for layer in model.decoder.layers[:-1]:  # half of what rectifiers get is lost
            layer.weight.mul_(2**0.5)  # type: ignore[operator]
    return model


def _compare(attention: nn.Module, sharpness: float) -> None:
    """Let queries and keys be the tokens themselves."""
    for linear in (attention.query, attention.key):
        linear.weight.copy_(sharpness * torch.eye(*linear.weight.shape))  # type: ignore[union-attr]


def _places(config: LRMConfig) -> tuple[range, int]:
    """Channels of a head, by axis, and the number of waves along each."""
    width = config.head_width
    waves = width // 12
    return range(0, 6 * waves, 2 * waves), waves


def _wave(values: Tensor, axis: int, config: LRMConfig, places: tuple[range, int]) -> Tensor:
    """Waves along an axis in the channels of that axis, of every head. [T] -> [T, D]"""
    starts, waves = places
    frequencies = SLOWEST * (FASTEST / SLOWEST) ** torch.linspace(0, 1, waves)
    phases = values[:, None] * frequencies
    code = torch.zeros(len(values), config.heads, config.head_width)
    span = slice(starts[axis], starts[axis] + 2 * waves)
    code[:, :, span] = torch.cat([phases.sin(), phases.cos()], dim=-1)[:, None]
    return code.flatten(1)


def _patch_places(config: LRMConfig, places: tuple[range, int]) -> Tensor:
    """Places of the picture's patches where the centre plane is seen. [G G, D]"""
    side = config.encoder.grid
    reach = 0.5 * config.source_distance / config.source_focal
    line = reach * (2 * (torch.arange(side) + 0.5) / side - 1)
    down, right = torch.meshgrid(-line, line, indexing="ij")
    return _wave(right.flatten(), 0, config, places) + _wave(down.flatten(), 2, config, places)


def _plane_places(config: LRMConfig, places: tuple[range, int]) -> Tensor:
    """Places of the tokens of the planes xy, xz and zy, rows first. [3 R R, D]"""
    side = config.low_resolution
    line = 2 * (torch.arange(side) + 0.5) / side - 1
    rows, columns = (part.flatten() for part in torch.meshgrid(line, line, indexing="ij"))
    return torch.cat(
        [
            _wave(columns, column, config, places) + _wave(rows, row, config, places)
            for column, row in ((0, 1), (0, 2), (2, 1))
        ]
    )


def grow_model(earlier: OpenLRM, config: LRMConfig) -> OpenLRM:
    """A model with planes of another resolution that goes on from one that was trained.

    Everything is taken over; what places have learned is interpolated, their waves are drawn anew.

    Args:
        earlier: A model that differs in its low resolution at most.
        config: Sizes of the new one.
    """
    model, places = OpenLRM(config), _places(config)
    old = earlier.config.low_resolution
    learned = earlier.position[0] - 0.5 * _plane_places(earlier.config, places)
    planes = learned.unflatten(0, (3, old, old)).permute(0, 3, 1, 2)
    size = (config.low_resolution, config.low_resolution)
    wider = (
        F.interpolate(planes, size=size, mode="bilinear").flatten(2).transpose(1, 2).flatten(0, 1)
    )
    state = {
        **earlier.state_dict(),
        "position": (wider + 0.5 * _plane_places(config, places))[None],
    }
    model.load_state_dict(state)
    return model
