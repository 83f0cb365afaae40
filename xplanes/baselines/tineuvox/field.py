"""TiNeuVox: a deformation network, a feature grid in canonical space, and small decoders."""

import math
from collections.abc import Mapping
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from xplanes.baselines.networks import layers, octaves
from xplanes.fields.background import Background
from xplanes.fields.base import ViewDependentField

STRIDES = (1, 2, 4)
"""Spacings of the three interpolations of the grid, in grid points."""

PER_CHANNEL = 5
"""Time features per channel of the grid: as many as a feature encoded with two octaves has."""


class TiNeuVox(ViewDependentField):
    """A dynamic radiance field in canonical space.

    Args:
        box: Least and largest corner of the grid, in world units. [2, 3]
        resolution: Cube root of the final number of cells.
        channels: Channels of a cell.
        width: Neurons of the hidden layers.
        octaves: Frequencies of the encodings of positions, times, directions and features.
        alpha: Initial opacity of one cell of the final grid.
        halvings: Number of halvings of the number of cells for the initial grid.
        moves: Whether points are deformed to canonical space; False for a static scene.
        unit: World units per unit of the field's frame.
        precision: Precision of the matrix products.
        background: Background outside of the grid's box; None for a plain colour.

    Attributes:
        count: Current number of cells of the grid.

    Source: TiNeuVox, released code.
    """

    box: Tensor
    voxels: Tensor

    def __init__(
        self,
        box: Tensor,
        resolution: int,
        channels: int,
        width: int,
        *,
        octaves: tuple[int, int, int, int] = (10, 8, 4, 2),
        alpha: float = 1e-2,
        halvings: int = 0,
        moves: bool = True,
        unit: float = 1.0,
        precision: str = "32",
        background: Background | None = None,
    ) -> None:
        super().__init__()
        self.resolution, self.channels, self.octaves = resolution, channels, octaves
        self.unit, self._precision = unit, precision
        self.shift = math.log(1 / (1 - alpha) - 1)
        self.register_buffer("box", box)
        self.register_buffer("voxels", torch.tensor(resolution**3 // 2**halvings))
        self._read_buffers()
        self.grid = nn.Parameter(torch.zeros(1, channels, *self._size(self.count)))
        points, times, directions, features = (1 + 2 * count for count in octaves)
        time_features = PER_CHANNEL * channels
        self.time = layers([times, width, time_features])
        self.deformation = layers([3 * points + time_features, width, width, 3]) if moves else None
        read = len(STRIDES) * channels * features
        self.trunk = layers([read + time_features + 3 * points, width])
        self.density = nn.Linear(width, 1)
        self.tint = nn.Linear(width, width)
        self.colours = layers([width + 3 * directions, width // 2, 3])
        self.background = background
        self.register_load_state_dict_pre_hook(_fit_grid)
        self.register_load_state_dict_post_hook(lambda field, _: field._read_buffers())

    def _read_buffers(self) -> None:
        """Copy buffers to the host once, so that steps need not synchronise with the GPU."""
        self.count = int(self.voxels)
        self._corners = self.box.double().cpu()

    @property
    def planes(self) -> Mapping[str, Tensor]:
        """Central slices of the grid. [C, rows, columns] each"""
        grid = self.grid[0]
        x, y, z = (size // 2 for size in grid.shape[1:])
        return {"xy": grid[:, :, :, z].mT, "xz": grid[:, :, y].mT, "yz": grid[:, x].mT}

    @property
    def moves(self) -> bool:
        return self.deformation is not None

    @property
    def precision(self) -> str:
        return self._precision

    @property
    def outline(self) -> str:
        cells = " x ".join(str(size) for size in self._size(self.resolution**3))
        behind = "" if self.background is None else " · a background"
        return f"(grid of {cells} cells) · {self.channels} channels{behind}"

    @property
    def cell(self) -> float:
        """Side of a cell in units of the frame."""
        return self._cell(self.count) / self.unit

    def bounds(self) -> Tensor:
        """Least and largest corner of the grid in the field's frame. [2, 3]"""
        return self.box / self.unit

    @torch.no_grad()
    def resize(self, voxels: int) -> None:
        """Resample the grid to another number of cells, in place."""
        size = self._size(voxels)
        self.grid.data = F.interpolate(
            self.grid.data, size=size, mode="trilinear", align_corners=True
        )
        self.voxels.fill_(voxels)
        self.count = voxels

    def read(self, places: Tensor) -> Tensor:
        """Interpolate the grid at three spacings, zero outside. World points [N, 3] -> [N, 3 C]"""
        # Padded so that the corners of all three grids coincide.
        fill = [-(size - 1) % STRIDES[-1] for size in self.grid.shape[:1:-1]]
        grid = F.pad(self.grid, [n for size in fill for n in (0, size)])
        low, high = self.box
        place = (2 * (places - low) / (high - low) - 1).flip(-1)[None, None, None]
        found = [
            F.grid_sample(grid[:, :, ::step, ::step, ::step], place, align_corners=True)
            for step in STRIDES
        ]
        return torch.cat(found, dim=1)[0, :, 0, 0].T

    def geometry(self, points: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
        places = points * self.unit
        count = self.octaves
        with self._mixed(points):
            encoded = octaves(places, count[0])
            time_features = self.time(octaves(times[:, None], count[1]))
            moved = places
            if self.deformation is not None:
                moved = places + self.deformation(torch.cat([encoded, time_features], dim=1))
            read = octaves(self.read(moved.to(self.grid.dtype)), count[3])
            features = self.trunk(torch.cat([read, time_features, encoded], dim=1)).relu()
            logit = self.density(features)[:, 0]
        per_cell = F.softplus(logit.to(points.dtype) + self.shift)
        # As in the released code, density is per side of a cell of the final grid.
        return per_cell * (self.unit / self._cell(self.resolution**3)), features

    def colour(self, features: Tensor, directions: Tensor) -> Tensor:
        with self._mixed(directions):
            seen = octaves(directions, self.octaves[2])
            logits = self.colours(torch.cat([self.tint(features), seen], dim=1))
        return logits.to(directions.dtype).sigmoid()

    def _mixed(self, values: Tensor) -> torch.autocast:
        return torch.autocast(values.device.type, torch.bfloat16, enabled=self._precision == "bf16")

    def _cell(self, voxels: int) -> float:
        low, high = self._corners
        return float(((high - low).prod() / voxels) ** (1 / 3))

    def _size(self, voxels: int) -> list[int]:
        low, high = self._corners
        # Round down, with a tolerance for rounding errors.
        sides = (high - low) / self._cell(voxels) + 1e-4
        return [max(2, int(side)) for side in sides.tolist()]


def _fit_grid(field: TiNeuVox, state: Mapping[str, Any], prefix: str, *_rest: Any) -> None:
    """Resize the grid to that of the state, which may have grown."""
    saved = state.get(f"{prefix}grid")
    if isinstance(saved, Tensor) and saved.shape[:2] == field.grid.shape[:2]:
        field.grid.data = field.grid.new_zeros(saved.shape)
