"""Pixels that rays are drawn through: those near silhouettes and far from them."""

import copy

import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.scenes.store import CELL, TILE, StoredImages, by_tile, count_in_squares, packed
from xplanes.scenes.views import Views


class PixelPool:
    """Pixels to draw from.

    Args:
        chosen: Which pixels of some images or of a tile. bool, of any shape
    """

    def __init__(self, chosen: Tensor) -> None:
        self.count = int(chosen.sum())
        self.pixels = None
        """Their numbers; None where all are chosen, which takes no memory."""
        if self.count < chosen.numel():
            kind = torch.int32 if chosen.numel() < 2**31 else torch.int64
            self.pixels = chosen.flatten().nonzero()[:, 0].to(kind)

    def __len__(self) -> int:
        return self.count

    def put_first(self, some: Tensor) -> int:
        """Reorder: some of the images' pixels first. Says how many; none if there are no others."""
        if not self.count or not some.any():
            return 0
        pixels = (
            torch.arange(some.numel(), dtype=torch.int32) if self.pixels is None else self.pixels
        )
        first = some.flatten()[pixels]
        found = int(first.sum())
        if not 0 < found < self.count:
            return 0
        self.pixels = torch.cat([pixels[first], pixels[~first]])
        return found

    def pick(self, uniform: Tensor) -> Tensor:
        """Pixels at places given by numbers from 0 to 1. [K] -> [K, 1]"""
        place = (uniform * len(self)).long().clamp_(max=len(self) - 1)[:, None]
        return place if self.pixels is None else self.pixels[place].long()


class PixelPools:
    """Pixels of three kinds, each of which has a share of its own: far, plain and all others.

    Args:
        far: Those far from silhouettes.
        near: All others, the plain ones first.
        plain: How many of these are plain.
        shares: Of far and of plain pixels.
    """

    def __init__(
        self, far: PixelPool, near: PixelPool, plain: int, shares: tuple[float, float]
    ) -> None:
        self.order = None
        """Numbers of all pixels, kind by kind; None where they are of one kind, in order."""
        if far.pixels is not None and near.pixels is not None:
            self.order = torch.cat([far.pixels, near.pixels])
            # No second copy: they are millions.
            far.pixels, near.pixels = self.order[: len(far)], self.order[len(far) :]
        elif near.pixels is not None or far.pixels is not None:
            self.order = near.pixels if len(near) else far.pixels
        counts = torch.tensor([len(far), plain, len(near) - plain], dtype=torch.float64)
        self.counts, self.starts = counts, counts.cumsum(dim=0) - counts
        self.bounds = torch.tensor(shares, dtype=torch.float64).cumsum(dim=0)
        self.most = len(far) + len(near) - 1

    def to(self, device: torch.device) -> "PixelPools":
        """The same on another device."""
        moved = copy.copy(self)
        moved.order = None if self.order is None else self.order.to(device)
        for name in ("counts", "starts", "bounds"):
            setattr(moved, name, getattr(self, name).to(device))
        return moved

    def pick(self, kind: Tensor, where: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels, and which of them are far, by numbers from 0 to 1. [R] -> bool [R], int64 [R]"""
        kind = torch.bucketize(kind.contiguous(), self.bounds, right=True)
        place = torch.addcmul(self.starts[kind], where, self.counts[kind]).long()
        place.clamp_(max=self.most)
        return kind == 0, place if self.order is None else self.order[place].long()


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
        shown = views.intrinsics.has_ray(index)
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
