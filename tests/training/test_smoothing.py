"""Coarse structure before details, in rigs with surroundings."""

from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F

from tests.balls import ball_views
from tests.training.test_surroundings import built
from xplanes.models.smoothing import FAR, RECOGNISABLE, UNITS, coherence, smoothed
from xplanes.scenes.frame import cube_frame, pixels_across
from xplanes.training.building import parts_from, site_content


def boxes(planes, radius):
    """Two box filters along each axis. [P, H, W, C]"""
    planes = planes.permute(0, 3, 1, 2)
    for kernel, pad in ((2 * radius + 1, radius),) * 2:
        planes = F.avg_pool2d(planes, (kernel, 1), 1, (pad, 0), count_include_pad=False)
        planes = F.avg_pool2d(planes, (1, kernel), 1, (0, pad), count_include_pad=False)
    return planes.permute(0, 2, 3, 1)


@pytest.mark.parametrize("radius", [1, 3])
def test_smoothing_is_two_box_filters(radius):
    planes = torch.randn(3, 12, 9, 4, dtype=torch.float64)
    torch.testing.assert_close(smoothed(planes, radius), boxes(planes, radius))


@pytest.mark.parametrize(("squares", "least", "most"), [(2, 15, 16), (4, 5, 6), (8, 1, 2)])
def test_images_of_small_patterns_are_blurred_less(squares, least, most):
    """Chessboards across the cube."""
    views, across = chessboards(squares)
    radius = UNITS * coherence(views, across)
    assert least < radius < most
    small = views.composite(0, torch.zeros(3))[::2, ::2][None]
    left = [float(boxes(small, r).var() / small.var()) for r in (least, most)]
    assert left[0] > RECOGNISABLE > left[1]


def test_nothing_is_blurred_where_nothing_would_be_left_or_cameras_are_far():
    assert coherence(*chessboards(64)) == 0
    views, _ = chessboards(2)
    away = float(views.camera_to_world[:, :3, 3].norm(dim=1).median())
    assert coherence(views, cube_frame(0.9 * away / FAR, torch.zeros(3))) == 0


def chessboards(squares):
    """Views of chessboards, and the frame of a cube that they fill."""
    size = 128
    views = ball_views(2, 0.5, size=size)
    tile = torch.arange(size) * squares // size
    board = ((tile[:, None] + tile) % 2 * 255).to(torch.uint8)
    images = board[None, ..., None].expand(len(views), size, size, 4).clone()
    images[..., 3] = 255
    views = replace(views, images=images)
    unit = cube_frame(1.0, torch.zeros(3))
    return views, cube_frame(size / pixels_across(views, unit), torch.zeros(3))


def rig(texels=16):
    module = built("world", f"model.loss.rig_smoothing={texels}", "model.resolution=64")
    site = replace(module.site, times=module.site.times.repeat(2), coherence=8 / 64)
    return module, module.model.settings.build(site)


def test_gradients_are_smoothed_at_first():
    module, model = rig()
    assert module.model.smoothing == module.site.coherence == 0  # One view of each timestep.
    stacks = model.field.space, model.field.background.planes
    steps = model.weights.rig_passing_steps
    for done, progress, radius in ((0, 0, 8), (0.5, 0, 4), (0, 0.15, 4), (0, 0.3, 0), (1, 0, 0)):
        before = [torch.randn_like(planes) for planes in stacks]
        for planes, gradient in zip(stacks, before, strict=True):
            planes.grad = gradient.clone()
        model._smooth_gradients(replace(module.state, step=int(done * steps), progress=progress))
        for planes, gradient in zip(stacks, before, strict=True):
            expected = boxes(gradient, radius) if radius else gradient
            torch.testing.assert_close(planes.grad, expected, atol=1e-5, rtol=1e-4)
    assert rig(3)[1].smoothing == 3
    assert rig(0)[1].smoothing == 0


def test_what_the_images_allow_travels_with_the_field():
    module, _ = rig()
    parts = replace(module.parts, site=replace(module.site, coherence=4 / 64, initialised=True))
    content = site_content(parts)
    found = parts_from(content, module.method, (), None)
    assert (found.site.coherence, found.site.positions) == (4 / 64, module.site.positions)
    assert found.site.initialised
