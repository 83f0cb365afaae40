"""Silhouettes of soft mattes: without noise, with what is thin, small or faint."""

import functools
from dataclasses import replace
from itertools import product

import pytest
import torch
import torch.nn.functional as F

from tests.balls import ball_views
from tests.scenes.common import stored
from xplanes.rendering.occupancy import OccupancyGrid
from xplanes.rendering.pruning import carve
from xplanes.scenes.batches import RayBatches
from xplanes.scenes.datamodule import UNIFORM
from xplanes.scenes.frame import scene_frame
from xplanes.scenes.matte import FAINT, VISIBLE, silhouette_of

SIZE, COUNT = 200, 16

RADIUS = 0.8
"""Of a sphere."""

RAYS = replace(UNIFORM, skip_background=True, background_share=0.4, background_jitter=0.1)


def by_hand(mask):
    """The same mask without noise, region by region."""
    left, regions = {tuple(place) for place in mask.nonzero().tolist()}, []
    while left:
        open_now = [left.pop()]
        region = list(open_now)
        while open_now:
            row, column = open_now.pop()
            around = {(row + r, column + c) for r in (-1, 0, 1) for c in (-1, 0, 1)} & left
            left -= around
            open_now += around
            region += around
        regions.append(torch.tensor(region))
    extents = [int((each.amax(dim=0) - each.amin(dim=0)).max()) + 1 for each in regions]
    limit = min(max(1, round(0.01 * max(mask.shape))), max(extents) // 5)
    kept = torch.zeros_like(mask)
    for region, extent in zip(regions, extents, strict=True):
        if extent > limit:
            kept[region[:, 0], region[:, 1]] = True
    return kept


def test_specks_are_the_connected_regions_that_are_small():
    generator, removed = torch.Generator().manual_seed(0), 0
    sizes = ((1, 1), (1, 40), (40, 1), (90, 130), (140, 110), (40, 320), (420, 30))
    for (height, width), density in product(sizes, (0.01, 0.1, 0.3, 0.6)):
        mask = torch.rand(height, width, generator=generator) < density
        mask[height // 2, width // 3 : 1 + 2 * width // 3] = True
        found = silhouette_of(255 * mask.byte())
        assert torch.equal(found, by_hand(mask)), (height, width, density)
        removed += int((mask & ~found).sum())
    assert removed > 1000
    for length in (4, 5, 9, 10):  # Of the largest region.
        mask = torch.zeros(9, 400, dtype=torch.bool)
        mask[4, 100 : 100 + length] = mask[1, 1] = mask[6, 300:302] = True
        assert torch.equal(silhouette_of(255 * mask.byte()), by_hand(mask)), length


def disc(radius):
    """Alpha of an antialiased disc. [SIZE, SIZE]"""
    place = torch.arange(SIZE) + 0.5 - SIZE / 2
    away = torch.hypot(place[:, None], place)
    return (255 * (radius - away + 0.5).clamp(0, 1)).round().byte()


def test_faint_alpha_is_no_silhouette_beside_something_opaque():
    alpha = disc(40)
    for level in (1, 2, 8, VISIBLE - 1):
        hazy = torch.maximum(alpha, torch.tensor(level, dtype=torch.uint8))
        assert torch.equal(silhouette_of(hazy), alpha >= VISIBLE), level
    assert silhouette_of(torch.full_like(alpha, 255)).all()
    assert not silhouette_of(torch.zeros_like(alpha)).any()
    assert not silhouette_of(torch.full_like(alpha, FAINT - 1)).any()
    alpha[3] = 32  # A wire of an eighth of a pixel.
    assert silhouette_of(alpha)[3].all()


def test_what_is_faint_all_over_is_kept_without_its_noise():
    for peak in (0.03, 0.06, 0.1, 0.2):
        alpha = (peak * disc(60).float()).round().byte()
        noise = torch.rand(alpha.shape, generator=torch.Generator().manual_seed(0)) < 0.01
        noisy = torch.where(noise, torch.maximum(alpha, torch.tensor(2).byte()), alpha)
        assert torch.equal(silhouette_of(noisy), alpha >= FAINT), peak
    # A few stray opaque pixels do not make the image opaque.
    alpha = (0.06 * disc(60).float()).round().byte()
    speckled = alpha.clone()
    speckled[[4, 60, 190], [7, 193, 20]] = 255
    assert torch.equal(silhouette_of(speckled), alpha >= FAINT)


@functools.cache
def clean(*, moving=False):
    """Antialiased views of a sphere."""
    views = ball_views(COUNT, RADIUS, size=SIZE, times=None if moving else torch.zeros(COUNT))
    images, pixel = torch.zeros_like(views.images), 4.0 / views.intrinsics.focal[0, 0].float()
    for index, image in enumerate(images):
        origins, directions = views.image_rays(index)
        along = (origins * directions).sum(dim=-1, keepdim=True)
        away = (origins - along * directions).norm(dim=-1, keepdim=True)
        cover = ((RADIUS - away) / pixel + 0.5).clamp(0, 1)
        image[:] = (cover * torch.tensor([200.0, 100.0, 50.0, 255.0])).round().view(image.shape)
    return replace(views, images=images)


def noisy(images, share, alpha=2):
    """Faint alpha on a share of all pixels."""
    generator = torch.Generator().manual_seed(1)
    chosen = torch.rand(images.shape[:3], generator=generator) < share
    chosen &= images[..., 3] == 0
    images = images.clone()
    images[chosen] = torch.tensor([1, 1, 0, alpha], dtype=torch.uint8)
    return images


def speckled(images):
    """Four stray opaque pixels of up to 2 x 2 pixels in each image, near its corners."""
    for number, image in enumerate(images):
        for row, column, side in ((4, 9, 1), (15, -7, 2), (-9, -30, 1), (-20, 5, 2)):
            row, column = row % SIZE - number // 4, column % SIZE - number % 4
            image[row : row + side, column : column + side] = 255
    return images


def blurred(images):
    """Mattes with soft edges, of a Gaussian one pixel wide."""
    kernel = torch.exp(-0.5 * torch.arange(-4.0, 5.0).square())
    kernel = kernel / kernel.sum()
    planes = images.permute(0, 3, 1, 2).reshape(-1, 1, SIZE, SIZE).float()
    planes = F.conv2d(planes, kernel.view(1, 1, 1, 9), padding=(0, 4))
    planes = F.conv2d(planes, kernel.view(1, 1, 9, 1), padding=(4, 0))
    return planes.round().byte().view(-1, 4, SIZE, SIZE).permute(0, 2, 3, 1).contiguous()


def half_side(views):
    return 1 / scene_frame(views).scale


def occupied_share(views):
    grid = OccupancyGrid(24, 1, step=0.05)
    carve(grid, views, scene_frame(views))
    return float(grid.occupied.float().mean())


def near_share(views):
    batches = RayBatches(views, scene_frame(views), RAYS, seed=0)
    return batches.near_pixels / views.pixels


def test_soft_mattes_leave_cube_grid_and_pools_as_they_are_in_memory_and_in_a_file():
    views = clean()
    soft = replace(views, images=noisy(speckled(blurred(views.images)), 0.1, alpha=12))
    assert half_side(soft) == pytest.approx(half_side(views), rel=0.02)
    assert occupied_share(soft) == pytest.approx(occupied_share(views), abs=0.02)
    assert near_share(soft) == pytest.approx(near_share(views), abs=0.02)
    file = stored(soft)
    for index in range(COUNT):
        assert torch.equal(file.silhouette(index), soft.silhouette(index))
    assert half_side(file) == half_side(soft)
    assert near_share(file) == pytest.approx(near_share(stored(views)), abs=0.02)


def test_pixels_that_no_silhouette_holds_keep_colour_and_time():
    views = clean(moving=True)
    views = replace(views, images=noisy(views.images, 0.2, alpha=12))
    batches = RayBatches(views, scene_frame(views), RAYS, seed=0)
    faint = empty = moved = 0
    for step in range(20):
        batch = batches.draw(step)
        stray = (batch["alpha"] * 255).round() == 12
        faint += int(stray.sum())
        expected = torch.tensor([1, 1, 0]) / 255 + (1 - 12 / 255)
        assert torch.allclose(batch["target"][stray], expected, atol=1e-5)
        unmoved = torch.isin(batch["times"], views.times)
        assert unmoved[stray].all()
        clear = batch["alpha"] == 0
        empty += int(clear.sum())
        moved += int((~unmoved)[clear].sum())
    assert faint > 500
    assert moved > 0.5 * empty


def test_images_are_opaque_where_the_silhouette_is_all_of_them():
    views = ball_views(3, 0.5, size=90)
    images = torch.full_like(views.images, 255)
    for part, expected in ((slice(0, 0), True), (slice(0, 9), False)):
        images[1, part, :, 3] = VISIBLE - 1
        found = replace(views, images=images)
        assert found.is_opaque == stored(found).is_opaque == expected
