"""Pools of pixels for drawing rays: near silhouettes, far from them, and without texture."""

import copy
import itertools
from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.scenes.silhouettes import count_in_squares, enlarged
from xplanes.scenes.store import RUN, StoredImages
from xplanes.scenes.views import Views

FAR, OTHER, TEXTURELESS, NOTHING = range(4)
"""Kinds of pixels, as numbers."""

ORDER = (FAR, TEXTURELESS, OTHER)
"""Order of the kinds in the list."""

BLOCK = 2**16
"""Number of pixels that 16 bits can index."""

PART = 2**22
"""Number of pixels whose full indices are computed at a time."""

CELLS = 8
"""Consecutive pixels of a run, or side of a square, that are classified together."""


class PixelPools:
    """Pixels of three kinds, drawn with separate shares: far, textureless and all others.

    Pixels are listed by kind, with the lower 16 bits of their indices: full indices would take as
    much memory as the images.

    Args:
        near: Pixels near silhouettes; all others are far. Overwritten. bool [V, H, W]
        textureless: Pixels without texture around them; None for none. bool [V, H, W]
        valid: Pixels that may be drawn; None for all. bool [V, H, W]

    Attributes:
        sizes: Numbers of far, textureless and other pixels; if all near pixels are textureless,
            they count as others.
    """

    def __init__(
        self, near: Tensor, textureless: Tensor | None = None, valid: Tensor | None = None
    ) -> None:
        kinds = near.view(torch.uint8)
        if textureless is not None and (near & ~textureless).any():
            kinds.add_(near & textureless)
        if valid is not None:
            kinds.masked_fill_(~valid, NOTHING)
        blocks = kinds.flatten().split(BLOCK)
        counts = torch.tensor([[int((part == kind).sum()) for part in blocks] for kind in ORDER])
        sizes = counts.sum(dim=1)
        self.sizes: tuple[int, ...] = tuple(sizes.tolist())
        self.total = sum(self.sizes)
        self.counts = sizes.double()
        self.starts = self.counts.cumsum(dim=0) - self.counts
        self.bounds = torch.zeros(2, dtype=torch.float64)
        self.before = F.pad(counts.flatten().cumsum(dim=0), (1, 0))
        """Offset in the list of each kind and block, ordered by kind. int64 [3 B + 1]"""
        self.whole: Tensor | None = None
        """Full indices of all pixels, on a GPU. [N]"""
        self.listed = None
        """Lower bits of all pixels' indices; None if all are of one kind. int16 [N]"""
        if max(self.sizes) < near.numel():
            self.listed = torch.empty(self.total, dtype=torch.int16)
            places = iter(self.listed.split(counts.flatten().tolist()))
            for kind, part in itertools.product(ORDER, blocks):
                next(places).copy_((part == kind).nonzero()[:, 0])

    def share(self, far: float, textureless: float) -> None:
        """Set the shares of far and of textureless pixels."""
        self.bounds = torch.tensor([far, textureless], dtype=torch.float64).cumsum(dim=0)

    def to(self, device: torch.device) -> "PixelPools":
        """The pools on another device."""
        moved = copy.copy(self)
        if self.listed is not None:
            # A GPU has the memory for full indices, which save a few operations per draw.
            kind = torch.int32 if len(self.before) // len(ORDER) * BLOCK < 2**31 else torch.int64
            steps = range(0, self.total, PART)
            parts = (torch.arange(n, min(n + PART, self.total)) for n in steps)
            whole = torch.cat([self.numbers(part).to(kind) for part in parts])
            moved.whole = whole.to(device)
        for name in ("counts", "starts", "bounds"):
            setattr(moved, name, getattr(self, name).to(device))
        return moved

    def pick(self, kind: Tensor, where: Tensor) -> tuple[Tensor, Tensor]:
        """Draw pixels; returns whether each is far, and its index. [R], [R] -> bool, int64 [R]

        ``kind`` and ``where`` are uniform numbers that choose the kind and the position in it.
        """
        kind = torch.bucketize(kind.contiguous(), self.bounds, right=True)
        place = torch.addcmul(self.starts[kind], where, self.counts[kind]).long()
        place.clamp_(max=self.total - 1)
        return kind == 0, self.numbers(place)

    def numbers(self, place: Tensor) -> Tensor:
        """Indices of the pixels at positions in the list. int64 [R] -> int64 [R]"""
        if self.whole is not None:
            return self.whole[place].long()
        if self.listed is None:
            return place
        block = torch.searchsorted(self.before, place, right=True) - 1
        block %= len(self.before) // len(ORDER)
        return BLOCK * block + (self.listed[place].long() & (BLOCK - 1))


class RunPools:
    """Pixels of images in files, near silhouettes and far from them, drawn in runs.

    Runs are drawn in proportion to their number of pixels of a kind. `CELLS` consecutive pixels are
    all near if one is, and silhouettes are dilated by whole squares of side `CELLS`.

    Args:
        views: Views whose images are ``images``.
        images: Images in files of pixels.
        margins: Margin in pixels around each image's silhouette that counts as near. [V]

    Attributes:
        sizes: Numbers of far, textureless and near pixels; none are textureless.
    """

    def __init__(self, views: Views, images: StoredImages, margins: Sequence[int]) -> None:
        self.views = views
        self.pixels = images.sizes.prod(dim=1)
        self.first = F.pad((-(-self.pixels // RUN)).cumsum(dim=0), (1, 0))
        """Index of each view's first run, and number of all runs. int64 [V + 1]"""
        total = int(self.first[-1])
        counts = torch.zeros(2, total, dtype=torch.int64)
        self.near = torch.full((total, RUN // CELLS // 8), 255, dtype=torch.uint8)
        """One bit per `CELLS` pixels of a run: whether they are near. uint8 [runs, B]"""
        self.all_near = True
        for index, margin in enumerate(margins):
            runs = slice(int(self.first[index]), int(self.first[index + 1]))
            near, shown = _widened(images.silhouette(index), margin), views.shown(index)
            if shown is None and near.all():
                counts[1, runs] = self._lengths(index, torch.arange(runs.stop - runs.start))
                continue
            self.all_near = False
            cells = _in_runs(near).view(-1, RUN // CELLS, CELLS).any(dim=2)
            valid = _in_runs(torch.ones_like(near) if shown is None else shown)
            self.near[runs] = torch.from_numpy(np.packbits(cells.numpy(), axis=1))
            near = cells.repeat_interleave(CELLS, dim=1)
            counts[0, runs], counts[1, runs] = ((valid & (near == kind)).sum(1) for kind in (0, 1))
        self.ends = counts.flatten().cumsum(dim=0)
        """Cumulative number of pixels per run, far ones, then near ones. int64 [2 runs]"""
        far, near = counts.sum(dim=1).tolist()
        self.sizes = far, 0, near
        self.far_share = 0.0

    def _lengths(self, view: Tensor | int, run: Tensor) -> Tensor:
        """Number of pixels per run; the last run of an image may have fewer. [K]"""
        return (self.pixels[view] - RUN * run).clamp(max=RUN)

    def share(self, far: float, textureless: float) -> None:
        """Set the share of far pixels; none are textureless."""
        self.far_share = far

    def pick(self, kind: Tensor, where: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Draw runs; returns whether each is far, its view, and its index in that view. [K]"""
        far, total, (size, _, rest) = kind < self.far_share, int(self.first[-1]), self.sizes
        place = torch.where(far, where * size, size + where * rest).long()
        place = place.clamp_(max=size + rest - 1)
        run = torch.searchsorted(self.ends, place, right=True) % total
        view = torch.searchsorted(self.first, run, right=True) - 1
        return far, view, run - self.first[view]

    def inside(self, far: Tensor, view: Tensor, run: Tensor, uniform: Tensor) -> Tensor:
        """Pixels drawn within runs of `pick` by uniform numbers. [K, P] -> int64 [K, P]"""
        length = self._lengths(view, run)
        if self.all_near:
            return torch.minimum((uniform * length[:, None]).long(), length[:, None] - 1)
        bits = self.near[self.first[view] + run].numpy()
        near = torch.from_numpy(np.unpackbits(bits, axis=1)).bool().repeat_interleave(CELLS, dim=1)
        chosen = (near != far[:, None]) & (torch.arange(RUN) < length[:, None])
        for row, (index, start) in enumerate(zip(view.tolist(), (RUN * run).tolist(), strict=True)):
            if (shown := self.views.shown(index)) is not None:
                part = shown.flatten()[start : start + RUN]
                chosen[row, : len(part)] &= part
        ends = chosen.cumsum(dim=1)
        place = torch.minimum((uniform * ends[:, -1:]).long(), ends[:, -1:] - 1)
        return torch.searchsorted(ends, place, right=True)


def _widened(mask: Tensor, margin: int) -> Tensor:
    """The squares within ``margin`` pixels of those that contain mask pixels. bool [h, w]"""
    if mask.all():
        return mask
    reach = -(-margin // CELLS)
    held = (count_in_squares(mask, CELLS) > 0).float()[None]
    near = F.max_pool2d(held, 2 * reach + 1, stride=1, padding=reach)[0] > 0
    return enlarged(near, CELLS, mask.shape)


def _in_runs(mask: Tensor) -> Tensor:
    """The pixels of an image as runs, padded with False. bool [h, w] -> [runs, RUN]"""
    return F.pad(mask.flatten(), (0, -mask.numel() % RUN)).view(-1, RUN)
