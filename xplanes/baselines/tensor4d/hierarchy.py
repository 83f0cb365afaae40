"""Planes of two levels, with their features concatenated, as in Tensor4D."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

Groups = tuple[tuple[str, ...], ...]
"""Names of planes by group; groups do not share planes."""

STATIC: Groups = (("yz",), ("xz",), ("xy",))
DYNAMIC: Groups = (("yz", "yt", "zt"), ("xz", "xt", "zt"), ("xy", "xt", "yt"))

AXES = "xyzt"

EARLIEST, LATEST = -0.95, 0.95
"""Coordinates of times 0 and 1 along the planes' time axis, which covers [-1, 1]."""


@dataclass(frozen=True)
class Level:
    """Size of the planes of one level.

    Attributes:
        resolution: Texels along each space axis.
        rows: Texels along time.
        channels: Channels.
    """

    resolution: int
    rows: int
    channels: int


def bilinear(plane: Tensor, columns: Tensor, rows: Tensor) -> Tensor:
    """Bilinear interpolation of a plane, with coordinates clamped at the border.

    Unlike ``grid_sample`` it has second derivatives, which the training of normals needs.

    Args:
        plane: Plane with channels last. [H, W, C]
        columns: Coordinates; -1 and 1 are the centres of the first and last texel. [N]
        rows: Coordinates along the rows, likewise. [N]

    Returns:
        Interpolated features. [N, C]
    """
    height, width, channels = plane.shape
    across = ((columns + 1) / 2 * (width - 1)).clamp(0, width - 1)
    down = ((rows + 1) / 2 * (height - 1)).clamp(0, height - 1)
    left = across.detach().long().clamp(0, max(width - 2, 0))
    upper = down.detach().long().clamp(0, max(height - 2, 0))
    u, v = (across - left)[:, None], (down - upper)[:, None]
    texels = plane.reshape(-1, channels)
    first = upper * width + left
    right, below = min(width - 1, 1), min(height - 1, 1) * width
    near, far = (
        torch.lerp(texels.index_select(0, at), texels.index_select(0, at + right), u)
        for at in (first, first + below)
    )
    return torch.lerp(near, far, v)


class HierarchicalPlanes(nn.Module):
    """Planes of several levels; features of a group are concatenated. Initialised to zero.

    Args:
        groups: Names of the planes, "ab" with axis a along its columns and b along its rows.
        levels: Sizes of the levels, from coarse to fine.
        blur: Texels per axis to which planes are downsampled while ``blurred``.

    `show` chooses the levels that are used and the downsampling; both are part of the state.

    Source: Tensor4D, released code.
    """

    fine: Tensor
    blurred: Tensor

    def __init__(self, groups: Groups, levels: Sequence[Level], *, blur: int = 64) -> None:
        super().__init__()
        self.groups, self.levels, self.blur = groups, tuple(levels), blur
        self.register_buffer("fine", torch.tensor(False))
        self.register_buffer("blurred", torch.tensor(True))
        self._fine, self._blurred = False, True
        self.register_load_state_dict_post_hook(lambda planes, _: planes._read_buffers())
        self.planes = nn.ParameterDict()
        for number, level in enumerate(levels):
            for group in groups:
                for name in group:
                    rows = level.rows if "t" in name else level.resolution
                    plane = torch.zeros(rows, level.resolution, level.channels)
                    self.planes[self._key(number, group, name)] = nn.Parameter(plane)

    def _read_buffers(self) -> None:
        """Copy the buffers to Python values, so that lookups need not synchronise with a GPU."""
        self._fine, self._blurred = bool(self.fine), bool(self.blurred)

    def show(self, *, fine: bool, blurred: bool) -> None:
        """Choose the levels that are used, and the downsampling.

        Args:
            fine: Whether levels beyond the first are used; otherwise their features are zeros.
            blurred: Whether planes are downsampled before the lookup.
        """
        if (fine, blurred) != (self._fine, self._blurred):
            self._fine, self._blurred = fine, blurred
            self.fine.fill_(fine)
            self.blurred.fill_(blurred)

    @staticmethod
    def _key(level: int, group: tuple[str, ...], name: str) -> str:
        return f"{level}_{group[0]}_{name}"

    @property
    def width(self) -> int:
        """Columns of each group's features."""
        return len(self.groups[0]) * sum(level.channels for level in self.levels)

    def forward(self, points: Tensor, times: Tensor) -> list[Tensor]:
        """Features of each group, for points in [-1, 1]^3. [N, 3], [N] -> [N, width] each"""
        scaled = EARLIEST + (LATEST - EARLIEST) * times
        place = dict(zip(AXES, [*points.unbind(dim=1), scaled], strict=True))
        blurred, fine = self._blurred, self._fine
        found = []
        for group in self.groups:
            parts = []
            for number, level in enumerate(self.levels):
                for name in group:
                    if number and not fine:
                        parts.append(points.new_zeros(len(points), level.channels))
                        continue
                    plane = self.planes[self._key(number, group, name)]
                    if blurred:
                        plane = self._averaged(plane)
                    parts.append(bilinear(plane, place[name[0]], place[name[1]]))
            found.append(torch.cat(parts, dim=1))
        return found

    def _averaged(self, plane: Tensor) -> Tensor:
        size = [min(self.blur, side) for side in plane.shape[:2]]
        first = plane.permute(2, 0, 1)[None]
        return F.interpolate(first, size=size, mode="area")[0].permute(1, 2, 0)

    def pictures(self) -> dict[str, Tensor]:
        """The finest planes by name. [C, rows, columns] each"""
        last, found = len(self.levels) - 1, {}
        for group in self.groups:
            for name in group:
                shown = name if len(group) == 1 else f"{name} of {group[0]}"
                found[shown] = self.planes[self._key(last, group, name)].permute(2, 0, 1)
        return found


class Compression(nn.Module):
    """A small network per group that reduces the number of features.

    Args:
        groups: Number of groups.
        inputs: Columns of each group.
        outputs: Columns of each group after compression.
        width: Neurons of the hidden layer.

    Source: Tensor4D, released code.
    """

    def __init__(self, groups: int, inputs: int, outputs: int, width: int = 256) -> None:
        super().__init__()
        self.parts = nn.ModuleList(
            nn.Sequential(
                *(nn.Linear(inputs, width), nn.LeakyReLU()),
                *(nn.Linear(width, outputs), nn.LeakyReLU()),
            )
            for _ in range(groups)
        )

    def forward(self, features: Sequence[Tensor]) -> Tensor:
        """[N, inputs] for each group -> [N, groups * outputs]"""
        return torch.cat([part(f) for part, f in zip(self.parts, features, strict=True)], dim=1)
