"""Initialisation of a model: position embeddings of image and planes that match each other."""

from dataclasses import fields

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from xplanes.lrm.config import LRMConfig
from xplanes.lrm.openlrm import OpenLRM
from xplanes.synthetic.pretraining.settings import NARROWEST

SHARPNESS = 1.2
"""Scale of the identity that initialises queries and keys of attention to the image."""

SELF_SHARPNESS = 0.8
"""Scale of this identity for attention among the planes' tokens."""

SLOWEST, FASTEST = 0.8, 16.0
"""Range of the frequencies of the position embedding, in radians per unit length."""


def init_model(config: LRMConfig, seed: int) -> OpenLRM:
    """A model with random weights and matching position embeddings of image and planes.

    The embedding of a token consists of sines and cosines of its x, y and z, each in its own
    channels. An image patch has x and z, a token of plane "xz" has the same, a token of "xy" has x.
    Because query and key weights are initialised equal, each token attends to the patches in its
    line of sight from the first step.

    Args:
        config: Sizes of the model.
        seed: Seed of the random weights.
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
    with torch.no_grad():
        for block in [*model.encoder.blocks, *model.blocks]:
            for name, child in block.named_modules():  # residual branches are initialised small
                if name.endswith(("attention.out", "mlp.2")) and "image" not in name:
                    child.weight.mul_(0.2)  # type: ignore[operator]
        patch = model.encoder.patch
        assert patch.bias is not None
        patch.bias.copy_(-patch.weight.sum(dim=(1, 2, 3)))  # a white patch has a zero token
        for block in model.blocks:
            _compare(block.image_attention, SHARPNESS)  # type: ignore[arg-type]
            _compare(block.self_attention, SELF_SHARPNESS)  # type: ignore[arg-type]
            for norm in (block.norm1, block.norm2, block.norm3):
                nn.init.zeros_(norm.modulation[1].weight)  # type: ignore[index]
        model.encoder.position[0, 1:] = _patch_places(config)
        model.position[0] = 0.5 * _plane_places(config)
        for layer in model.decoder.layers[:-1]:  # ReLU drops half of the variance
            layer.weight.mul_(2**0.5)  # type: ignore[operator]
    return model


def _compare(attention: nn.Module, sharpness: float) -> None:
    """Initialise query and key weights to a scaled identity."""
    for linear in (attention.query, attention.key):
        linear.weight.copy_(sharpness * torch.eye(*linear.weight.shape))  # type: ignore[union-attr]


def _wave(values: Tensor, axis: int, config: LRMConfig) -> Tensor:
    """Sines and cosines of a coordinate, in its axis's channels of every head. [T] -> [T, D]"""
    waves = config.head_width // NARROWEST
    frequencies = SLOWEST * (FASTEST / SLOWEST) ** torch.linspace(0, 1, waves)
    phases = values[:, None] * frequencies
    code = torch.zeros(len(values), config.heads, config.head_width)
    code[:, :, 2 * waves * axis : 2 * waves * (axis + 1)] = torch.cat(
        [phases.sin(), phases.cos()], dim=-1
    )[:, None]
    return code.flatten(1)


def _patch_places(config: LRMConfig) -> Tensor:
    """Position embedding of the image patches, at the plane through the centre. [G G, D]"""
    side = config.encoder.grid
    reach = 0.5 * config.source_distance / config.source_focal
    line = reach * (2 * (torch.arange(side) + 0.5) / side - 1)
    down, right = torch.meshgrid(-line, line, indexing="ij")
    return _wave(right.flatten(), 0, config) + _wave(down.flatten(), 2, config)


def _plane_places(config: LRMConfig) -> Tensor:
    """Position embedding of the tokens of planes xy, xz and zy, row by row. [3 R R, D]"""
    side = config.low_resolution
    line = 2 * (torch.arange(side) + 0.5) / side - 1
    rows, columns = (part.flatten() for part in torch.meshgrid(line, line, indexing="ij"))
    axes = ((0, 1), (0, 2), (2, 1))
    return torch.cat([_wave(columns, c, config) + _wave(rows, r, config) for c, r in axes])


def grow_model(earlier: OpenLRM, config: LRMConfig) -> OpenLRM:
    """A model with another plane resolution, initialised from a trained one.

    All weights are copied. The learned part of the position embedding is interpolated; sines and
    cosines are computed for the new resolution.

    Args:
        earlier: The trained model; it may differ in ``low_resolution`` only.
        config: Sizes of the new model.

    Raises:
        ValueError: If the configurations differ in anything else.
    """
    for each in fields(config):
        before, now = getattr(earlier.config, each.name), getattr(config, each.name)
        if each.name != "low_resolution" and before != now:
            raise ValueError(f"its {each.name} is {before}, and {now} here")
    model, old = OpenLRM(config), earlier.config.low_resolution
    learned = earlier.position[0] - 0.5 * _plane_places(earlier.config)
    planes = learned.unflatten(0, (3, old, old)).permute(0, 3, 1, 2)
    size = (config.low_resolution, config.low_resolution)
    wider = F.interpolate(planes, size=size, mode="bilinear").flatten(2).mT.flatten(0, 1)
    position = (wider + 0.5 * _plane_places(config))[None]
    model.load_state_dict({**earlier.state_dict(), "position": position})
    return model
