"""The occupancy grid: cells over space and time, marked empty or occupied."""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from xplanes.backend import compiled, cpu_loops
from xplanes.rendering.box import Field
from xplanes.rendering.compositing import OPAQUE

TRUST = 0.1
"""Rate at which the least density of a cell rises towards an observed density."""


class OccupancyGrid(nn.Module):
    """A decaying maximum of the field's density per cell of the cube [-1, 1]^3 and time bin.

    A cell is occupied while the opacity of its density over one sample step is above ``threshold``.
    All cells are initially occupied; an observation lowers the density of its cell by the factor
    ``decay`` at most. Cells that are not ``allowed`` (outside the silhouettes) stay empty; cells
    that are not ``likely`` can become occupied only next to an occupied cell; cells that are
    ``kept`` stay occupied, so that thin parts, which are learnt late, can still appear in them.

    ``least`` is a running minimum of the observed densities: it falls at once and rises slowly. A
    cell that a surface crosses, or that is filled at only some times of its bin, has a high density
    but transmits light; only ``least`` tells whether it occludes the samples behind it.

    Args:
        resolution: Cells along each side.
        time_bins: Bins along time.
        step: Length of one sample, in the field's frame.
        threshold: Opacity of one sample step below which a cell counts as empty.
        decay: Factor on a cell's density at each observation.
    """

    density: Tensor
    least: Tensor
    occupied: Tensor
    allowed: Tensor
    likely: Tensor
    kept: Tensor

    def __init__(
        self,
        resolution: int,
        time_bins: int,
        *,
        step: float,
        threshold: float = 0.001,
        decay: float = 0.95,
    ) -> None:
        super().__init__()
        self.resolution, self.time_bins = resolution, time_bins
        self.step, self.threshold, self.decay = step, threshold, decay
        self.empty_density = threshold / step
        self.opaque_density = OPAQUE / step
        cells = time_bins * resolution**3
        self.register_buffer("allowed", torch.ones(cells, dtype=torch.bool))
        self.register_buffer("likely", torch.ones(cells, dtype=torch.bool))
        self.register_buffer("kept", torch.zeros(cells, dtype=torch.bool))
        self.register_buffer("density", torch.full((cells,), 4 * self.empty_density))
        self.register_buffer("least", torch.zeros(cells))
        self.register_buffer("occupied", torch.ones(cells, dtype=torch.bool))

    def bins(self, times: Tensor) -> Tensor:
        """Time bin of each time from 0 to 1. int64 [N]"""
        return (times * self.time_bins).long().clamp_(0, self.time_bins - 1)

    def cells(self, points: Tensor, times: Tensor) -> Tensor:
        """Cell of each point of the cube at its time. [N, 3], [N] -> int64 [N]"""
        place = (0.5 * self.resolution * (points + 1)).long().clamp_(0, self.resolution - 1)
        cells = self.bins(times)
        for axis in (2, 1, 0):
            cells = cells * self.resolution + place[:, axis]
        return cells

    def at(self, time: float) -> "OccupancyGrid":
        """A copy of the bin of a time from 0 to 1, as a grid of one bin."""
        settings = {"step": self.step, "threshold": self.threshold, "decay": self.decay}
        copied = OccupancyGrid(self.resolution, 1, **settings).to(self.density.device)
        cells, place = self.resolution**3, int(self.bins(torch.tensor([time])))
        for name, values in copied.named_buffers():
            values.copy_(getattr(self, name)[place * cells : (place + 1) * cells])
        return copied

    def allow(self, allowed: Tensor) -> None:
        """Exclude all other cells permanently. bool [time_bins, G, G, G], axes z, y, x

        Cells that were excluded before stay excluded, whatever ``allowed`` contains.
        """
        self.allowed.logical_and_(allowed.reshape(-1))
        self.kept.logical_and_(self.allowed)
        self.density.mul_(self.allowed)
        self._mark()

    def presume(self, likely: Tensor) -> None:
        """Empty all other cells; they become occupied only next to occupied ones.

        Otherwise an untrained field would fill empty space. Shape and axes as in `allow`.
        """
        self.likely.logical_and_(likely.reshape(-1))
        self.density.mul_(self.likely)
        self._mark()

    def keep(self, kept: Tensor) -> None:
        """Mark cells to stay occupied, if they are allowed. Shape and axes as in `allow`."""
        self.kept.logical_or_(kept.reshape(-1) & self.allowed)
        self._mark()

    def _mark(self) -> None:
        """Recompute ``occupied`` for all cells."""
        torch.gt(self.density, self.empty_density, out=self.occupied)
        self.occupied.logical_or_(self.kept)

    def _occupied_cells(self) -> Tensor:
        """Indices of all occupied cells, ascending. int64 [N]"""
        if self.occupied.device.type == "cpu":
            # Up to ten times as fast as PyTorch's ``nonzero``.
            return torch.from_numpy(np.flatnonzero(self.occupied.numpy()))
        return self.occupied.nonzero()[:, 0]

    @property
    def occupied_fraction(self) -> float:
        """Share of all cells that are occupied."""
        if self.occupied.device.type == "cpu":
            return np.count_nonzero(self.occupied.numpy()) / self.occupied.numel()
        return float(self.occupied.float().mean())

    @torch.no_grad()
    def observe(self, cells: Tensor, density: Tensor, live: Tensor | None = None) -> None:
        """Update cells with the field's density at samples; excluded cells stay empty.

        Args:
            cells: Cell of each sample. [N]
            density: Density there. [N]
            live: Whether each sample is used, used ones first; all are used when None. [N]
        """
        density = self._usable(density)
        if live is None and cpu_loops(self.density):
            fixed = self.allowed, self.kept
            arrays = cells, density, *fixed, self.density, self.least, self.occupied
            numbers = map(np.float32, (self.decay, TRUST, self.empty_density))
            cpu = compiled("xplanes.rendering.rays_numba")
            cpu.observe_cells(*(array.numpy() for array in arrays), *numbers)
            return
        if live is not None:
            # Unused samples repeat used ones, which has no effect. They repeat different ones,
            # because writes to a single cell would be serialised.
            one = torch.arange(len(live), device=live.device) % live.sum().clamp_min(1)
            cells = torch.where(live, cells, cells[one])
            density = torch.where(live, density, density[one])
        before, least = self.density[cells], self.least[cells]
        seen = torch.maximum(before * self.decay, density) * self.allowed[cells]
        lowest = torch.minimum(density, torch.lerp(least, density, TRUST))
        if live is not None:
            none = ~live.any()
            seen, lowest = torch.where(none, before, seen), torch.where(none, least, lowest)
        self.density.scatter_reduce_(0, cells, seen, "amax", include_self=False)
        self.least.scatter_reduce_(0, cells, lowest, "amin", include_self=False)
        self.occupied[cells] = (self.density[cells] > self.empty_density) | self.kept[cells]

    @torch.no_grad()
    def sweep(self, field: Field, generator: torch.Generator) -> None:
        """Evaluate every occupied cell once, and empty those without density.

        A cell stays occupied if it or a spatial neighbour has density at one random point and time,
        so that a single observation cannot lose a thin surface.

        Args:
            field: From points [N, 3] and times [N] to colour [N, 3] and density [N].
            generator: Source of randomness.
        """
        device = self.density.device
        seen = torch.zeros_like(self.density)
        for part in self._occupied_cells().split(2**15 if device.type == "cpu" else 2**19):
            uniform = torch.rand(len(part), 4, generator=generator).to(device)
            seen[part] = self._usable(field(*self.draw(part, uniform))[1])
        size = self.resolution
        around = F.max_pool3d(
            seen.view(1, self.time_bins, size, size, size), 3, stride=1, padding=1
        )
        keep = self.occupied & (around.view(-1) > self.empty_density)
        # A cell kept because of a neighbour is emptied if two observations find no density there.
        floor = self.empty_density / max(self.decay, 1e-3) * 1.001
        raised = seen.clamp_min(floor)
        lost = self.density.clamp_max(0.5 * self.empty_density)
        torch.minimum(self.least, seen, out=self.least)
        self.density.copy_(torch.where(keep, raised, lost))
        torch.logical_or(keep, self.kept, out=self.occupied)

    @torch.no_grad()
    def update(self, field: Field, count: int, generator: torch.Generator) -> None:
        """Evaluate random cells, to find density in cells that are wrongly marked empty.

        Half of them are drawn from all cells, the other half next to occupied cells, where missing
        content is most likely. Each is evaluated at a random point and time.

        Args:
            field: From points [N, 3] and times [N] to colour [N, 3] and density [N].
            count: Maximum number of cells; drawn cells that must stay empty are left out.
            generator: Source of randomness.
        """
        device = self.density.device
        beside = self._near_occupied(count // 2, generator)
        total = self.density.numel()
        cells = torch.randint(total, (count - count // 2,), generator=generator).to(device)
        cells = torch.cat([cells, beside])
        cells = cells[self.allowed[cells]]
        cells = cells[self.likely[cells] | self._beside_occupied(cells)]
        if not len(cells):
            return
        uniform = torch.rand(count, 4, generator=generator).to(device)[: len(cells)]
        points, times = self.draw(cells, uniform)
        self.observe(cells, field(points, times)[1])

    @torch.no_grad()
    def update_by(self, field: Field, uniform: Tensor) -> None:
        """`update` with given random numbers, without waiting for the device.

        Args:
            field: From points [N, 3] and times [N] to colour [N, 3] and density [N].
            uniform: Random numbers from 0 to 1 for up to N cells. [N, 8]
        """
        count, total = len(uniform), self.density.numel()
        chosen = uniform[:, 0]
        running = self.occupied.cumsum(0)
        number = (chosen[: count // 2] * running[-1]).long() + 1
        beside = torch.searchsorted(running, number).clamp_max_(total - 1)
        beside = self._moved(beside, (3 * uniform[: count // 2, 1:4].T).long() - 1)
        anywhere = (chosen[count // 2 :] * total).long()
        cells = torch.cat([anywhere, beside])
        counted = self.allowed[cells] & (self.likely[cells] | self._beside_occupied(cells))
        order = counted.to(torch.uint8).argsort(stable=True, descending=True)
        cells, counted = cells[order], counted[order]
        points, times = self.draw(cells, uniform[:, 4:].float())
        self.observe(cells, field(points, times)[1], counted)

    def occupied_points(self, uniform: Tensor) -> tuple[Tensor, Tensor]:
        """Random points and times in occupied cells.

        If all cells are empty, the CPU returns no points. The GPU, for which the host does not wait
        for the number of occupied cells, returns points in the last cell.

        Args:
            uniform: Random numbers from 0 to 1 for cell, position along each axis, and time. [N, 5]

        Returns:
            [N, 3], [N]
        """
        if uniform.device.type == "cpu":
            cells = self._occupied_cells()
            if len(cells):
                cells = cells[(uniform[:, 0] * len(cells)).long().clamp_(max=len(cells) - 1)]
            return self.draw(cells, uniform[: len(cells), 1:])
        running = self.occupied.cumsum(0)
        number = (uniform[:, 0] * running[-1]).long() + 1
        cells = torch.searchsorted(running, number).clamp_max_(self.density.numel() - 1)
        return self.draw(cells, uniform[:, 1:])

    def _near_occupied(self, count: int, generator: torch.Generator) -> Tensor:
        """Random cells at most one cell from an occupied one along each axis, in its time bin."""
        device = self.density.device
        cells = self._occupied_cells()
        if not len(cells):
            return cells
        cells = cells[torch.randint(len(cells), (count,), generator=generator).to(device)]
        return self._moved(cells, torch.randint(-1, 2, (3, count), generator=generator).to(device))

    def _moved(self, cells: Tensor, moves: Tensor) -> Tensor:
        """Cells shifted along each axis, clamped to the grid. [N], [3, N] -> [N]"""
        size = self.resolution
        for stride, move in zip((1, size, size**2), moves, strict=True):
            place = torch.div(cells, stride, rounding_mode="floor") % size
            cells = cells + ((place + move).clamp(0, size - 1) - place) * stride
        return cells

    def _beside_occupied(self, cells: Tensor) -> Tensor:
        """Whether a cell or one of its face neighbours is occupied. bool [N]"""
        size = self.resolution
        found = self.occupied[cells]
        for stride in (1, size, size**2):
            place = torch.div(cells, stride, rounding_mode="floor") % size
            below = torch.where(place > 0, cells - stride, cells)
            above = torch.where(place < size - 1, cells + stride, cells)
            found = found | self.occupied[below] | self.occupied[above]
        return found

    def _usable(self, density: Tensor) -> Tensor:
        """Densities clamped to [0, ``opaque_density``], so that cells can decay; NaN becomes 0."""
        return density.float().nan_to_num(0.0).clamp(0, self.opaque_density)

    def draw(self, cells: Tensor, uniform: Tensor) -> tuple[Tensor, Tensor]:
        """Points and times in cells from uniform numbers. [N], [N, 4] -> [N, 3], [N]"""
        size = self.resolution
        index = [cells % size, cells // size % size, cells // size**2 % size, cells // size**3]
        place = torch.stack(index, dim=-1) + uniform
        return place[:, :3] * (2 / size) - 1, place[:, 3] / self.time_bins
