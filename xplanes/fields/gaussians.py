"""Gaussians as a representation: canonical parameters, and how a field of planes deforms them."""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from xplanes.fields.base import Representation
from xplanes.fields.products import PlaneProducts

BASE = 0.28209479177387814
"""The spherical harmonic of degree 0."""

NEIGHBOURS = 3
"""Whose mean squared distance is the first variance of a Gaussian (Kerbl et al. 2023)."""

FIRST_OPACITY = 0.1
"""Of every Gaussian (Kerbl et al. 2023)."""

ROWS = 1024
"""Points whose distances to all others are in memory at once."""


@dataclass(frozen=True)
class PosedGaussians:
    """Gaussians at one time, as a rasteriser takes them.

    Attributes:
        means: In the field's frame. [N, 3]
        quaternions: Rotations (w, x, y, z) of any length. [N, 4]
        scales: Standard deviations along the rotated axes. [N, 3]
        opacities: From 0 to 1. [N]
        harmonics: Coefficients of the colours' spherical harmonics, of which 0.5 is left out.
            [N, K, 3]
        degree: Highest degree that is in use.
    """

    means: Tensor
    quaternions: Tensor
    scales: Tensor
    opacities: Tensor
    harmonics: Tensor
    degree: int


class Gaussians(Representation):
    """Canonical Gaussians, whose number changes in training, and their motion.

    Tensors with a row for each Gaussian are those that `rows` names. A state of another number of
    Gaussians can be loaded.

    Args:
        points: First means, in the field's frame. [N, 3]
        colours: Their colours, from 0 to 1. [N, 3]
        degree: Highest degree of the spherical harmonics.
        extent: How far apart the cameras stand, in units of the field's frame.
        moves: Whether there is any motion.

    Source: Kerbl et al. 2023, released code.
    """

    PARAMETERS = ("means", "quaternions", "log_scales", "logits", "base", "detail")
    STATISTICS = ("slopes", "seen")

    def __init__(
        self, points: Tensor, colours: Tensor, *, degree: int, extent: float, moves: bool
    ) -> None:
        super().__init__()
        count = len(points)
        spacing = neighbour_distance(points)
        self.means = nn.Parameter(points.clone())
        self.quaternions = nn.Parameter(points.new_tensor([1.0, 0, 0, 0]).repeat(count, 1))
        self.log_scales = nn.Parameter(spacing.log()[:, None].repeat(1, 3))
        self.logits = nn.Parameter(torch.full((count,), FIRST_OPACITY).logit())
        self.base = nn.Parameter((colours - 0.5)[:, None] / BASE)  # [N, 1, 3]
        self.detail = nn.Parameter(torch.zeros(count, (degree + 1) ** 2 - 1, 3))
        self._moves = moves
        # Sum of the projected means' gradients, and how often each Gaussian was drawn.
        self.register_buffer("slopes", torch.zeros(count))
        self.register_buffer("seen", torch.zeros(count))
        self.register_buffer("degree", torch.tensor(0))
        self.register_buffer("deforms", torch.tensor(False))
        self.register_buffer("extent", torch.tensor(extent))

    slopes: Tensor
    seen: Tensor
    degree: Tensor
    deforms: Tensor
    extent: Tensor

    @property
    def moves(self) -> bool:
        return self._moves

    @property
    def precision(self) -> str:
        return "32"

    @property
    def outline(self) -> str:
        return f"{len(self):,} Gaussians"

    def __len__(self) -> int:
        return len(self.means)

    @property
    def rows(self) -> dict[str, Tensor]:
        """The tensors with a row for each Gaussian."""
        return {name: getattr(self, name) for name in (*self.PARAMETERS, *self.STATISTICS)}

    @property
    def scales(self) -> Tensor:
        """Canonical standard deviations. [N, 3]"""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        """From 0 to 1. [N]"""
        return self.logits.sigmoid()

    @abstractmethod
    def motion(self, time: float) -> tuple[Tensor, Tensor, Tensor]:
        """What is added to means, quaternions and logarithms of scales at a time.

        Args:
            time: From 0 to 1.

        Returns:
            [N, 3], [N, 4], [N, 3]
        """

    def at(self, time: float) -> PosedGaussians:
        """The Gaussians at a time from 0 to 1; gradients reach the parameters."""
        means, quaternions, log_scales = self.means, self.quaternions, self.log_scales
        if self.moves and self.deforms:
            shift, turn, growth = self.motion(time)
            means, quaternions = means + shift, quaternions + turn
            log_scales = log_scales + growth
        harmonics = torch.cat([self.base, self.detail], dim=1)
        degree = int(self.degree)
        return PosedGaussians(
            means, quaternions, log_scales.exp(), self.opacities, harmonics, degree
        )

    def _load_from_state_dict(
        self,
        state_dict: Any,
        prefix: str,
        local_metadata: Any,
        strict: bool,
        missing_keys: list[str],
        unexpected_keys: list[str],
        error_msgs: list[str],
    ) -> None:
        count = len(state_dict.get(f"{prefix}means", self.means))
        if count != len(self):
            for tensor in self.rows.values():
                tensor.data = tensor.new_zeros(count, *tensor.shape[1:])
        super()._load_from_state_dict(
            *(state_dict, prefix, local_metadata, strict),
            *(missing_keys, unexpected_keys, error_msgs),
        )


class HexPlaneGaussians(Gaussians):
    """Gaussians that a multi-resolution field of six planes moves, turns and scales.

    Gradients of the deformation reach planes and networks, and the means only as what is added to.

    Args:
        points: As `Gaussians`.
        colours: As `Gaussians`.
        degree: As `Gaussians`.
        extent: As `Gaussians`.
        planes: The field's planes; None where nothing moves.
        width: Neurons of the hidden layers.

    Source: 4D-GS (Wu et al. 2024), Section 4.
    """

    def __init__(
        self,
        points: Tensor,
        colours: Tensor,
        *,
        degree: int,
        extent: float,
        planes: PlaneProducts | None,
        width: int,
    ) -> None:
        super().__init__(points, colours, degree=degree, extent=extent, moves=planes is not None)
        self.products = planes
        self.network = nn.ModuleDict()
        if planes is not None:
            self.network["features"] = _linear(planes.features, width)
            for name, outputs in (("shift", 3), ("turn", 4), ("growth", 3)):
                last = nn.Linear(width, outputs)
                # What moves begins where the static stage has left it.
                nn.init.zeros_(last.weight)
                nn.init.zeros_(last.bias)
                self.network[name] = nn.Sequential(
                    nn.ReLU(), _linear(width, width), nn.ReLU(), last
                )

    @property
    def planes(self) -> Mapping[str, Tensor]:
        """The planes of the finest scale. [C, rows, columns] each"""
        if self.products is None:
            return {}
        names = self.products.names
        return {name: plane[0] for name, plane in self.products.planes()[-len(names) :]}

    def motion(self, time: float) -> tuple[Tensor, Tensor, Tensor]:
        assert self.products is not None
        times = torch.full_like(self.means[:, 0], time)
        hidden = self.network["features"](self.products(self.means.detach(), times))
        shift, turn, growth = (self.network[name](hidden) for name in ("shift", "turn", "growth"))
        return shift, turn, growth


def _linear(inputs: int, outputs: int) -> nn.Linear:
    layer = nn.Linear(inputs, outputs)
    nn.init.xavier_uniform_(layer.weight)
    return layer


def neighbour_distance(points: Tensor) -> Tensor:
    """Root of the mean squared distance to the three nearest other points, at least 3e-4. [N]"""
    if len(points) < 2:
        return torch.full_like(points[:, 0], 0.1)
    count = min(NEIGHBOURS, len(points) - 1)
    found = [
        # The nearest is the point itself.
        torch.cdist(part, points).topk(count + 1, largest=False).values[:, 1:]
        for part in points.split(ROWS)
    ]
    return torch.cat(found).square().mean(dim=1).clamp(min=1e-7).sqrt()
