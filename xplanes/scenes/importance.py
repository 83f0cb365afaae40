"""Importance sampling of rays: more rays where renders still differ from the images."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, distributed

from xplanes.backend import in_group
from xplanes.scenes.views import Views

MOST_TILES = 2**17
"""Largest number of tiles, over all images."""

SIDE = 16
"""Side of a tile in pixels, doubled until there are few enough tiles."""

CANDIDATES = 4
"""Candidate pixels per ray; also the largest factor by which a pixel is preferred."""

REFRESH, KEPT = 50, 0.84
"""Batches between updates of the errors, and decay factor of older batches per update."""

START = 300
"""Batches before pixels are preferred: errors are large everywhere at first."""

LEAST = 0.02
"""Share of the mean squared error that is added to that of each tile, so that none is ignored."""


@dataclass(frozen=True)
class Tiles:
    """Square tiles of all images, numbered; the colour error is averaged over each.

    Attributes:
        side: Pixels along a side.
        rows: Tiles along the height of the largest image.
        columns: Tiles along its width.
    """

    side: int
    rows: int
    columns: int

    @classmethod
    def of(cls, views: Views) -> "Tiles":
        """Tiles of the smallest side for which there are at most `MOST_TILES`, if possible."""
        side = SIDE
        while True:
            rows, columns = math.ceil(views.height / side), math.ceil(views.width / side)
            if len(views) * rows * columns <= MOST_TILES or rows * columns == 1:
                return cls(side, rows, columns)
            side *= 2

    def number(self, view: Tensor, row: Tensor, column: Tensor) -> Tensor:
        """Number of the tile of each pixel. int64 [R] each -> int64 [R]"""
        tile = (view * self.rows + row // self.side) * self.columns + column // self.side
        return tile % MOST_TILES


def preferred(errors: Tensor, share: float, count: int, offset: Tensor) -> tuple[Tensor, Tensor]:
    """Choose pixels in proportion to a mixture of 1 and their errors (systematic resampling).

    Args:
        errors: Error of each candidate's tile. [N]
        share: Share of the pixels that are chosen in proportion to their errors.
        count: Number of pixels to choose.
        offset: Uniform random number from 0 to 1. []

    Returns:
        Indices of the chosen candidates, ascending, int64 [count], and the weights that make means
        over them unbiased: the inverse of their relative probabilities. [count]
    """
    chance = share * errors / errors.mean() + (1 - share)
    ends = chance.clamp_max(len(errors) / count).double().cumsum(dim=0)
    places = torch.arange(count, dtype=torch.float64, device=errors.device) + offset
    chosen = torch.searchsorted(ends, places * (ends[-1] / count)).clamp_max_(len(errors) - 1)
    chance = ends.diff(prepend=ends.new_zeros(1))[chosen]
    return chosen, (ends[-1] / len(errors) / chance).float()


class ErrorMap:
    """Recent mean colour error of each tile, for `preferred`.

    Args:
        start: Batches after which errors are used, from the next update on.

    Attributes:
        errors: Root mean squared error of each tile, or of all tiles where it is unknown; None
            before errors are used. [MOST_TILES]
    """

    def __init__(self, start: int = START) -> None:
        self.start, self.batches = start, 0
        self.errors: Tensor | None = None
        self._sums = torch.zeros(0)
        """Sums of squared errors and their number: of all processes up to the last update, and of
        this process since then; empty before the first batch. [2, 2, MOST_TILES]"""

    def observe(
        self, batch: Mapping[str, Any], colour: Tensor, shown: Tensor | None = None
    ) -> None:
        """Add the errors of a rendered batch, if it has tiles.

        Args:
            batch: With ``tile``, int64 [R], and ``target`` [R, 3].
            colour: Colours of its rays. [R, 3]
            shown: Rays that count; all when None. bool [R]
        """
        if (tile := batch.get("tile")) is None:
            return
        error = (colour.detach() - batch["target"]).square().mean(dim=1)
        if not len(self._sums):
            self._sums = torch.zeros(2, 2, MOST_TILES)
        if self._sums.device != error.device:
            self._sums = self._sums.to(error.device)
        fresh = self._sums[1]
        counted = torch.ones_like(error) if shown is None else shown.to(error)
        fresh[0].index_add_(0, tile, error * counted)
        fresh[1].index_add_(0, tile, counted)
        self.batches += 1
        if self.batches % REFRESH == 0:
            if in_group():
                distributed.all_reduce(fresh)
            # A batch that is not finite must not remain in the sums.
            self._sums[0].mul_(KEPT).add_(fresh).nan_to_num_(0.0, 0.0, 0.0)
            fresh.zero_()
            self.errors = self._errors()

    def drop_own(self) -> None:
        """Discard the errors that this process has observed since the last update."""
        self._sums[1:].zero_()

    def _errors(self) -> Tensor | None:
        if self.batches - self.batches % REFRESH < max(self.start, 1):
            return None
        error, count = self._sums[0]
        overall = error.sum() / count.sum().clamp_min(1) + torch.finfo(error.dtype).tiny
        mean = torch.where(count > 0, error / count.clamp_min(1e-6), overall)
        return (mean + LEAST * overall).sqrt()

    def state_dict(self) -> dict[str, Any]:
        """Its content, for a checkpoint."""
        return {"sums": self._sums, "batches": self.batches}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from the content of a checkpoint.

        Raises:
            KeyError, TypeError: If the content is of another kind.
        """
        self._sums, self.batches = state["sums"], state["batches"]
        self.errors = self._errors()
