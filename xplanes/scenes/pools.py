"""Pixels that rays are drawn through: those near silhouettes and far from them."""

import copy
import itertools

import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.scenes.store import CELL, TILE, StoredImages, by_tile, count_in_squares, packed
from xplanes.scenes.views import Views

FAR, OTHER, PLAIN, NOTHING = range(4)
"""Kinds of pixels, as numbers."""

ORDER = (FAR, PLAIN, OTHER)
"""Kinds as they are listed."""

BLOCK = 2**16
"""Pixels that the same 16 bits tell apart."""

PART = 2**22
"""Pixels whose numbers are put together at a time."""


class PixelPools:
    """Pixels of three kinds, each of which has a share of its own: far, plain and all others.

    Pixels are listed kind by kind, by the lower 16 bits of their numbers: whole numbers would take
    as much memory as the images.

    Args:
        near: Pixels near silhouettes; all others are far. Overwritten. bool [V, H, W]
        plain: Which pixels have one colour with all around them; None for none. bool [V, H, W]
        valid: Which pixels show something; None for all. bool [V, H, W]

    Attributes:
        sizes: Numbers of far, plain and other pixels; none are plain where no others would be left.
    """

    def __init__(
        self, near: Tensor, plain: Tensor | None = None, valid: Tensor | None = None
    ) -> None:
        kinds = near.view(torch.uint8)
        if plain is not None and (near & ~plain).any():
            kinds.add_(near & plain)
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
        """Listed pixels before those of each kind and block, kind by kind. int64 [3 B + 1]"""
        self.whole: Tensor | None = None
        """Numbers of all pixels, on a GPU. [N]"""
        self.listed = None
        """Lower bits of all pixels' numbers; None where all are of one kind. int16 [N]"""
        if max(self.sizes) < near.numel():
            self.listed = torch.empty(self.total, dtype=torch.int16)
            places = iter(self.listed.split(counts.flatten().tolist()))
            for kind, part in itertools.product(ORDER, blocks):
                next(places).copy_((part == kind).nonzero()[:, 0])

    def share(self, far: float, plain: float) -> None:
        """Settle the shares of far and of plain pixels."""
        self.bounds = torch.tensor([far, plain], dtype=torch.float64).cumsum(dim=0)

    def to(self, device: torch.device) -> "PixelPools":
        """The same on another device."""
        moved = copy.copy(self)
        if self.listed is not None:
            # A GPU has room for whole numbers, and a draw there is a few operations shorter.
            kind = torch.int32 if len(self.before) // len(ORDER) * BLOCK < 2**31 else torch.int64
            steps = range(0, self.total, PART)
            parts = (torch.arange(n, min(n + PART, self.total)) for n in steps)
            whole = torch.cat([self.numbers(part).to(kind) for part in parts])
            moved.whole = whole.to(device)
        for name in ("counts", "starts", "bounds"):
            setattr(moved, name, getattr(self, name).to(device))
        return moved

    def pick(self, kind: Tensor, where: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels, and which of them are far, by numbers from 0 to 1. [R] -> bool [R], int64 [R]"""
        kind = torch.bucketize(kind.contiguous(), self.bounds, right=True)
        place = torch.addcmul(self.starts[kind], where, self.counts[kind]).long()
        place.clamp_(max=self.total - 1)
        return kind == 0, self.numbers(place)

    def numbers(self, place: Tensor) -> Tensor:
        """Pixels at places in the list. int64 [R] -> int64 [R]"""
        if self.whole is not None:
            return self.whole[place].long()
        if self.listed is None:
            return place
        block = torch.searchsorted(self.before, place, right=True) - 1
        block %= len(self.before) // len(ORDER)
        return BLOCK * block + (self.listed[place].long() & (BLOCK - 1))


def pixels_of(chosen: Tensor, uniform: Tensor) -> Tensor:
    """Some of the chosen pixels of a tile, by numbers from 0 to 1. bool [H, W], [K] -> int64 [K]"""
    pixels = chosen.flatten().nonzero()[:, 0]
    return pixels[(uniform * len(pixels)).long().clamp_(max=len(pixels) - 1)]


class TilePool:
    """Tiles to draw from, each as often as it has pixels.

    Args:
        places: The view of each tile, and the tile's number in it. int32 [K, 2]
        cells: Which of its cells belong to the pool, as bits. uint8 [K, B]
        pixels: The pixels of these cells, without padding. int64 [K]
    """

    def __init__(self, places: Tensor, cells: Tensor, pixels: Tensor) -> None:
        self.places, self.cells, self.ends = places, cells, pixels.cumsum(dim=0)

    def __len__(self) -> int:
        return int(self.ends[-1]) if len(self.ends) else 0

    def pick(self, uniform: Tensor) -> Tensor:
        """Views, tiles and their cells at places given by numbers from 0 to 1. [K] -> [K, 2 + B]"""
        place = (uniform * len(self)).long().clamp_(max=len(self) - 1)
        found = torch.searchsorted(self.ends, place, right=True)
        return torch.cat([self.places[found].long(), self.cells[found].long()], dim=1)


def tile_pools(views: Views, images: StoredImages, margins: list[int]) -> tuple[TilePool, TilePool]:
    """The cells of tiles within some pixels of the silhouettes, and all others."""
    numbers = torch.tensor(
        [-(-height // TILE) * -(-width // TILE) for height, width in _sizes(images)]
    )
    ends = numbers.cumsum(dim=0)
    total = int(numbers.sum())
    # Filled image by image: small tensors that stay, among large ones that go, would scatter both.
    places = torch.empty(total, 2, dtype=torch.int32)
    bits = torch.empty(2, total, (TILE // CELL) ** 2 // 8, dtype=torch.uint8)
    counts = torch.empty(2, total, dtype=torch.int64)
    for index, (size, margin) in enumerate(zip(_sizes(images), margins, strict=True)):
        part = slice(int(ends[index] - numbers[index]), int(ends[index]))
        places[part, 0] = index
        places[part, 1] = torch.arange(int(numbers[index]), dtype=torch.int32)
        lit = near = images.lit(index)
        if not lit.all():
            reach = -(-margin // CELL)
            around = F.max_pool2d(lit.float()[None], 2 * reach + 1, stride=1, padding=reach)
            near = around[0] > 0
        shown = views.shown(index)
        if shown is None:
            height, width = (_lengths(side) for side in size)
            count = height[:, None] * width
        else:
            count = count_in_squares(shown, CELL)
        for pool, chosen in enumerate((near, ~near)):
            bits[pool, part] = torch.from_numpy(packed(by_tile(chosen)))
            counts[pool, part] = by_tile(count * chosen).sum(dim=1)
    near_pool, far_pool = (
        TilePool(places[count > 0], bit[count > 0], count[count > 0])
        for bit, count in zip(bits, counts, strict=True)
    )
    return near_pool, far_pool


def in_cells(
    cells: Tensor, height: Tensor, width: Tensor, uniform: Tensor
) -> tuple[Tensor, Tensor]:
    """Pixels of tiles, each in any of some cells as likely as any other.

    Args:
        cells: The cells of each tile to draw from. bool [K, (TILE / CELL)**2]
        height: Rows from each tile's first to the end of its image. int64 [K]
        width: Columns, likewise. int64 [K]
        uniform: Numbers from 0 to 1. [K, P]

    Returns:
        Rows and columns in the tiles. int64 [K, P] each
    """
    side = TILE // CELL
    first = CELL * torch.arange(side)
    rows, columns = ((size[:, None] - first).clamp(0, CELL) for size in (height, width))
    pixels = (rows[:, :, None] * columns[:, None, :]).flatten(1) * cells
    ends = pixels.cumsum(dim=1)
    total = ends[:, -1:]
    place = torch.minimum((uniform * total).long(), total - 1)
    cell = torch.searchsorted(ends, place, right=True)
    place -= (ends - pixels).gather(1, cell)
    across = columns.gather(1, cell % side)
    row = cell // side * CELL + place // across
    return row, cell % side * CELL + place % across


def _sizes(images: StoredImages) -> list[tuple[int, int]]:
    """Height and width of each image."""
    return [(height, width) for height, width in images.sizes.tolist()]


def _lengths(side: int) -> Tensor:
    """Rows, or columns, of the cells along a side of an image."""
    return (side - torch.arange(0, side, CELL)).clamp(max=CELL)
