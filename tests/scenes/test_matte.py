"""Silhouettes of soft mattes: without noise, with what is thin, small or faint."""

import functools
import math
from dataclasses import replace

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
from xplanes.scenes.matte import FAINT, NOISE, SMALLER, VISIBLE, silhouette_of
from xplanes.scenes.silhouettes import may_hold

SIZE, COUNT = 200, 16

RADIUS, WIRE = 0.8, 0.9
"""Radius of a sphere, and half the length of a wire."""

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
    limit = min(max(1, round(NOISE * max(mask.shape))), max(extents) // SMALLER)
    kept = torch.zeros_like(mask)
    for region, extent in zip(regions, extents, strict=True):
        if extent > limit:
            kept[region[:, 0], region[:, 1]] = True
    return kept


def test_specks_are_the_connected_regions_that_are_small():
    generator, removed = torch.Generator().manual_seed(0), 0
    for height, width in ((1, 1), (1, 40), (40, 1), (90, 130), (140, 110)):
        for density in (0.01, 0.1, 0.3, 0.6):
            mask = torch.rand(height, width, generator=generator) < density
            mask[height // 2, width // 3 : 1 + 2 * width // 3] = True
            found = silhouette_of(255 * mask.byte())
            assert torch.equal(found, by_hand(mask)), (height, width, density)
            removed += int((mask & ~found).sum())
    assert removed > 1000


def disc(radius, size=SIZE, centre=(0.5, 0.5)):
    """Alpha of an antialiased disc. [size, size]"""
    place = torch.arange(size) + 0.5
    away = torch.hypot(place[:, None] - centre[0] * size, place - centre[1] * size)
    return (255 * (radius - away + 0.5).clamp(0, 1)).round().byte()


def line(angle, width, size=SIZE, *, length=None):
    """Alpha of an antialiased line through the middle. [size, size]"""
    place = torch.arange(size) + 0.5 - 0.5 * size
    turned = math.cos(angle), math.sin(angle)
    away = (place[:, None] * turned[0] - place * turned[1]).abs()
    along = (place[:, None] * turned[1] + place * turned[0]).abs()
    cover = (0.5 * width - away + 0.5).clamp(0, min(1, width))
    if length is not None:
        cover *= (0.5 * length - along + 0.5).clamp(0, 1)
    return (255 * cover).round().byte()


def test_faint_alpha_is_no_silhouette_beside_something_opaque():
    alpha = disc(40)
    for level in (1, 2, 8, VISIBLE - 1):
        hazy = torch.maximum(alpha, torch.tensor(level, dtype=torch.uint8))
        assert torch.equal(silhouette_of(hazy), alpha >= VISIBLE), level
    assert silhouette_of(torch.full_like(alpha, 255)).all()
    assert not silhouette_of(torch.zeros_like(alpha)).any()
    assert not silhouette_of(torch.full_like(alpha, FAINT - 1)).any()


def test_opaque_specks_are_left_out_and_what_is_larger_is_not():
    for size in (100, 200, 400):
        alpha = disc(0.2 * size, size)
        for side in range(1, size // 25):
            speckled = alpha.clone()
            speckled[3 : 3 + side, 5 : 5 + side] = 255
            found = silhouette_of(speckled)
            if side > NOISE * size:
                assert torch.equal(found, speckled >= VISIBLE), (size, side)
            else:
                assert torch.equal(found, alpha >= VISIBLE), (size, side)


def test_wires_are_kept_at_every_angle():
    body = disc(30, centre=(0.25, 0.25))
    for width in (0.25, 0.5, 1.0, 2.0):
        for step in range(8):
            angle = math.pi * step / 8
            for alpha in (line(angle, width), line(angle, width, length=12)):
                assert silhouette_of(alpha)[alpha >= VISIBLE].all(), (width, angle)
                beside = torch.maximum(alpha, body)
                assert torch.equal(silhouette_of(beside), beside >= VISIBLE), (width, angle)


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


def antialiased(views, cover_of):
    """The views with other images: how much of each pixel a thing covers, from its rays."""
    images = torch.zeros_like(views.images)
    colour = torch.tensor([200.0, 100.0, 50.0, 255.0])
    for index, image in enumerate(images):
        cover = cover_of(*views.image_rays(index), 4.0 / views.intrinsics.focal[0, 0].float())
        image[:] = (cover[:, None] * colour).round().byte().view(image.shape)
    return replace(views, images=images)


@functools.cache
def clean(*, moving=False):
    """Antialiased views of a sphere."""

    def cover(origins, directions, pixel):
        along = (origins * directions).sum(dim=-1, keepdim=True)
        away = (origins - along * directions).norm(dim=-1)
        return ((RADIUS - away) / pixel + 0.5).clamp(0, 1)

    times = None if moving else torch.zeros(COUNT)
    return antialiased(ball_views(COUNT, RADIUS, size=SIZE, times=times), cover)


def noisy(share, alpha=2):
    """Faint alpha on a share of all pixels."""

    def paint(images):
        generator = torch.Generator().manual_seed(1)
        chosen = torch.rand(images.shape[:3], generator=generator) < share
        chosen &= images[..., 3] == 0
        images[chosen] = torch.tensor([1, 1, 0, alpha], dtype=torch.uint8)
        return images

    return paint


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


MATTES = {
    "strong noise on 1%": noisy(0.01, alpha=12),
    "noise everywhere": noisy(1.0, alpha=8),
    "all of it": lambda images: noisy(0.01)(speckled(blurred(images))),
}


def painted(views, paint):
    return replace(views, images=paint(views.images.clone()))


def half_side(views):
    return 1 / scene_frame(views).scale


def occupied_share(views):
    grid = OccupancyGrid(24, 1, step=0.05)
    carve(grid, views, scene_frame(views))
    return float(grid.occupied.float().mean())


def near_share(views):
    batches = RayBatches(views, scene_frame(views), RAYS, seed=0)
    return batches.near_pixels / views.pixels


@functools.cache
def usual():
    """Half-side, share of the grid, and share of near rays without noise."""
    return half_side(clean()), occupied_share(clean()), near_share(clean())


@pytest.mark.parametrize("matte", MATTES)
def test_soft_mattes_leave_cube_grid_and_pools_as_they_are_in_memory_and_in_a_file(matte):
    views = clean()
    soft = painted(views, MATTES[matte])
    assert not torch.equal(soft.images, views.images)
    half, occupied, near = usual()
    assert half_side(soft) == pytest.approx(half, rel=0.02)
    assert occupied_share(soft) == pytest.approx(occupied, abs=0.02)
    assert near_share(soft) == pytest.approx(near, abs=0.02)
    file = stored(soft)
    for index in range(COUNT):
        assert torch.equal(file.silhouette(index), soft.silhouette(index))
    assert half_side(file) == half_side(soft)
    assert near_share(file) == pytest.approx(near_share(stored(views)), abs=0.02)


def test_pixels_that_no_silhouette_holds_keep_colour_and_time():
    views = painted(clean(moving=True), noisy(0.2, alpha=12))
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


def wire_views(radius):
    """Antialiased views of a wire along z."""

    def cover(origins, directions, pixel):
        # The point of the wire nearest to each ray: its height follows from two right angles.
        along, up = (origins * directions).sum(dim=-1), directions[:, 2]
        height = (origins[:, 2] - along * up) / (1 - up.square()).clamp_min(1e-6)
        offset = -origins
        offset[:, 2] += height.clamp(-WIRE, WIRE)
        distance = (offset * directions).sum(dim=-1)
        away = (offset.square().sum(dim=-1) - distance.square()).clamp_min(0).sqrt()
        return ((radius - away) / pixel + 0.5).clamp(0, float(min(1.0, 2 * radius / pixel)))

    return antialiased(ball_views(COUNT, 0.1, size=SIZE, times=torch.zeros(COUNT)), cover)


@pytest.mark.parametrize("thickness", [0.5, 1.0])
def test_a_wire_stays_in_the_cube_and_in_the_grid(thickness):
    pixel = 4.0 / float(clean().intrinsics.focal[0, 0])
    views = painted(
        wire_views(0.5 * thickness * pixel), lambda images: noisy(0.01)(speckled(images))
    )
    points = torch.linspace(-WIRE, WIRE, 300)[:, None] * torch.tensor([0.0, 0.0, 1.0])
    for seen in (views, stored(views)):
        frame = scene_frame(seen)
        assert frame.points(points).abs().max() <= 1
        assert may_hold(seen, points, radius=0.5 * pixel).all()
    assert half_side(views) < 1.1 * WIRE


def test_images_are_opaque_where_the_silhouette_is_all_of_them():
    views = ball_views(3, 0.5, size=90)
    images = torch.full_like(views.images, 255)
    for part, expected in ((slice(0, 0), True), (slice(0, 9), False)):
        images[1, part, :, 3] = VISIBLE - 1
        found = replace(views, images=images)
        assert found.is_opaque == stored(found).is_opaque == expected
