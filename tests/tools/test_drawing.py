"""Pictures for the viewer: what is cropped, what is hidden, what floats."""

import math
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from torch import Tensor

from tests.baselines.test_kplanes_field import products
from tests.baselines.test_tensor4d_field import surface as tensor4d
from tests.baselines.test_tineuvox_field import field as tineuvox
from xplanes.baselines.kplanes.field import DensityField, HybridDecoder, KPlanes
from xplanes.baselines.proposal import ProposalRenderer
from xplanes.baselines.tensor4d.neus import NeusRenderer
from xplanes.baselines.tineuvox.fixed_step import FixedStepRenderer
from xplanes.fields.base import ViewDependentField
from xplanes.rendering.base import RayRenderer
from xplanes.rendering.grid_renderer import GridRenderer
from xplanes.rendering.occupancy import OccupancyGrid
from xplanes.rendering.pictures import depth_picture
from xplanes.scenes.cameras import look_at, orbit
from xplanes.scenes.frame import Frame
from xplanes.scenes.views import Views
from xplanes.tools.drawing import Picture, Shot, draw, in_box

FLAT = Frame(1.0, torch.eye(3), torch.zeros(3))
TURN = torch.linalg.qr(torch.tensor([[1.0, 0.5, 0.2], [-0.3, 1.0, 0.4], [0.1, -0.6, 1.0]]))[0]
FRAME = Frame(0.5, TURN * torch.linalg.det(TURN).sign(), torch.tensor([1.0, -2.0, 0.5]))
FRONT, BACK = torch.tensor([0.0, -0.5, 0.0]), torch.tensor([0.0, 0.5, 0.0])
SIZE = 24
POSE = look_at(torch.tensor([[0.0, -3.0, 0.0]]))[0]
"""Looks along +y: `FRONT` hides `BACK`."""


class Balls(ViewDependentField):
    """Opaque balls: one is green, the others are red."""

    planes = {}  # noqa: RUF012
    moves = True
    precision = "32"
    outline = "balls"

    def __init__(self, *centres: Tensor, green: Tensor | None = None, radius: float = 0.3) -> None:
        super().__init__()
        self.centres, self.green, self.radius = torch.stack(centres), green, radius

    def geometry(self, points: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
        away = torch.cdist(points, self.centres).amin(dim=1)
        return 300.0 * (away < self.radius), points

    def colour(self, features: Tensor, directions: Tensor) -> Tensor:
        colours = torch.tensor([0.8, 0.1, 0.1]).repeat(len(features), 1)
        if self.green is not None:
            near = (features - self.green).norm(dim=1) < self.radius + 0.01
            colours[near] = torch.tensor([0.1, 0.8, 0.1])
        return colours


def grid_renderer(filled: ViewDependentField | None = None) -> GridRenderer:
    """Where a field is given, its grid knows what is solid, and skips what that hides."""
    grid = OccupancyGrid(16, 1, step=0.02)
    if filled is not None:
        grid.sweep(filled, torch.Generator())
        for _ in range(60):  # Until it trusts that solid cells are solid.
            cells = grid.occupied.nonzero()[:, 0]
            points, times = grid.draw(cells, torch.full((len(cells), 4), 0.5))
            grid.observe(cells, filled(points, times)[1])
    return GridRenderer(grid, 192)


def views_of(alpha: Tensor | None = None, times: Tensor | None = None) -> Views:
    """Views from four places, at each time again."""
    times = torch.zeros(4) if times is None else times
    poses = orbit(4, radius=3, elevation=10, target=FLAT.centre).repeat(len(times) // 4, 1, 1)
    images = torch.zeros(len(times), SIZE, SIZE, 4, dtype=torch.uint8)
    if alpha is not None:
        images[..., 3] = alpha
    return Views(images, poses, times, 1.2 * SIZE, tuple("abcdefgh"[: len(times)]))  # type: ignore[arg-type]


def shot(**changed: Any) -> Shot:
    settings: dict[str, Any] = {"time": 0.0, "fov": 0.5, "height": SIZE, "aspect": 1.5} | changed
    return Shot(settings.pop("pose", POSE), **settings)


def drawn(
    field: Any, renderer: RayRenderer, wanted: Shot, views: Views | None = None, **more: Any
) -> Picture:
    views = views_of() if views is None else views
    found = draw(field, renderer, wanted, views=views, frame=FLAT, background=torch.ones(3), **more)
    assert found is not None
    return found


def crop(low: float, high: float) -> Tensor:
    """Points with y between two values."""
    return torch.tensor([[-1.0, low, -1.0], [1.0, high, 1.0]])


def test_modes_show_colour_depth_and_opacity():
    field = Balls(FRONT)
    renderer = grid_renderer()
    wanted = shot()
    assert (wanted.height, wanted.width) == (SIZE, 36)
    image = renderer.image(field, *wanted.camera.rays(), 0.0, torch.ones(3))
    colour = image["colour"].view(SIZE, 36, 3)
    depth, opacity = (image[name].view(SIZE, 36) for name in ("depth", "opacity"))
    assert 50 < (opacity > 0.5).sum() < 400
    for mode, expected in {
        "colour": colour,
        "depth": depth_picture(depth, opacity),
        "opacity": opacity[..., None].expand(-1, -1, 3),
    }.items():
        for at_once in (8192, 100):
            found = drawn(field, renderer, shot(mode=mode), at_once=at_once)
            torch.testing.assert_close(found.colours, expected.clamp(0, 1), atol=1e-5, rtol=0)


def test_depth_is_that_along_the_optical_axis():
    # A ball looks like a disc from all sides; a wall does not.
    class Wall(Balls):
        def geometry(self, points: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
            return 3000.0 * (points[:, 1] > 0), points

    found = drawn(Wall(FRONT), GridRenderer(OccupancyGrid(16, 1, step=0.02), 2000), shot())
    solid = found.depth.isfinite()
    assert solid.sum() > 200
    assert float((found.depth[solid] - 3).abs().max()) < 0.01
    assert not solid[0, 0]


def test_what_is_cropped_neither_shows_nor_hides():
    both = Balls(FRONT, BACK, green=BACK)
    renderer = grid_renderer(both)
    assert renderer.occlusion > 0
    # The same cells, of which none counts as opaque.
    clear = replace(renderer, occlusion=0.0)
    alone = drawn(Balls(BACK, green=BACK), clear, shot()).colours
    assert (alone[..., 1] > alone[..., 0] + 0.5).any()
    whole = drawn(both, renderer, shot()).colours
    cropped = drawn(both, renderer, shot(box=crop(0.0, 1.0))).colours
    assert not torch.allclose(whole, alone, atol=0.1)
    torch.testing.assert_close(cropped, alone, atol=0.02, rtol=0)


def every_renderer() -> dict[str, tuple[Any, RayRenderer]]:
    """An untrained field of each kind, with what renders it."""
    torch.manual_seed(0)
    solid = tensor4d(width=64, filled=False)
    cells = tineuvox(alpha=0.9)
    planes = KPlanes(products(), HybridDecoder(4, 16))
    proposals = torch.nn.ModuleList([DensityField(products(), 8)])
    return {
        "occupancy": (planes, grid_renderer()),
        "proposal": (planes, ProposalRenderer(proposals, [32], 16)),
        "fixed step": (cells, FixedStepRenderer(cells, near=1, far=5, step=0.5, threshold=1e-4)),
        "neus": (solid, NeusRenderer(solid, samples=16, more=16, coarse_sharpness=64.0)),
    }


NEUS = pytest.param("neus", marks=pytest.mark.slow)


@pytest.mark.parametrize("name", ["occupancy", "proposal", "fixed step", NEUS])
def test_every_renderer_crops(name):
    field, renderer = every_renderer()[name]
    everything = torch.tensor([[-9.0] * 3, [9.0] * 3])
    box = torch.tensor([[-0.5, -0.5, -0.2], [0.4, 0.5, 0.5]])
    whole = drawn(field, renderer, shot())
    same = drawn(field, renderer, shot(box=everything))
    torch.testing.assert_close(same.colours, whole.colours, atol=1e-3, rtol=0)
    wanted = shot(box=box, mode="opacity")
    opacity = drawn(field, renderer, wanted).colours[..., 0]
    origins, directions = wanted.camera.rays()
    places = origins[:, None] + torch.linspace(1, 5, 801)[:, None] * directions[:, None]
    through = in_box(box)(places).any(dim=1).view_as(opacity)
    assert 20 < through.sum() < 600
    assert float(opacity[~through].max()) < 0.01
    before = drawn(field, renderer, shot(mode="opacity")).colours[..., 0]
    assert float(before[~through].max()) > 0.05
    assert float(opacity[through].max()) > 0.02


def test_bounds_of_the_training_cameras_do_not_cut_the_scene_off():
    distance = 8.0
    field = every_renderer()["fixed step"][0]
    options: Any = {"step": 0.5, "threshold": 1e-4}
    bounded = FixedStepRenderer(field, near=1.5, far=4.5, **options)
    free = FixedStepRenderer(field, near=0.01, far=20.0, **options)
    pose = look_at(torch.tensor([[0.0, -distance, 0.0]]))[0]
    wanted = shot(pose=pose, fov=1.5 / distance, mode="opacity")
    cut = bounded.image(field, *wanted.camera.rays(), 0.0, torch.ones(3))["depth"].view(SIZE, 36)
    found, expected = (drawn(field, renderer, wanted) for renderer in (bounded, free))
    torch.testing.assert_close(found.colours, expected.colours, atol=0.02, rtol=0)
    seen = expected.depth.isfinite() & found.depth.isfinite()
    torch.testing.assert_close(found.depth[seen], expected.depth[seen], atol=0.1, rtol=0)
    assert float((cut - expected.depth)[seen].abs().min()) > 0.3


def silhouette(field: Balls, pose: Tensor) -> Tensor:
    """The alpha of a view of `views_of` that shows a field. [SIZE, SIZE]"""
    wanted = shot(pose=pose, aspect=1.0, fov=2 * math.atan(1 / 2.4))
    return 255 * drawn(field, grid_renderer(), wanted).depth.isfinite()


def redness(field: Balls, renderer: RayRenderer, views: Views, time: float = 0.0) -> Tensor:
    """How much more red than green a picture of a field's floaters is. [SIZE, columns]"""
    found = drawn(field, renderer, shot(mode="floaters", time=time), views).colours
    return found[..., 0] - found[..., 1]


@pytest.mark.parametrize("hidden", [False, True])
def test_floaters_are_what_no_silhouette_covers(hidden):
    """A ball that the images show, and one that they do not, beside it or behind it."""
    there = Balls(FRONT)
    floater = BACK if hidden else torch.tensor([0.75, 0.5, 0.0])
    both = Balls(FRONT, floater)
    alpha = [silhouette(there, pose) for pose in views_of().camera_to_world]
    # Views of other times show nothing, and are not looked at.
    views = views_of(alpha=torch.stack(alpha))
    expected = drawn(Balls(floater), grid_renderer(), shot()).depth.isfinite()
    assert expected.sum() > 40
    assert ((redness(both, grid_renderer(both), views) > 0.3) == expected).float().mean() > 0.97
    assert float(redness(there, grid_renderer(), views).abs().max()) < 1e-5


def test_floaters_are_told_by_the_images_nearest_in_time():
    times = torch.tensor([0.0, 1.0]).repeat_interleave(4)
    balls = {0.0: Balls(FRONT), 1.0: Balls(torch.tensor([0.6, 0.0, 0.0]))}
    poses = views_of(times=times).camera_to_world
    alpha = [silhouette(balls[t], pose) for t, pose in zip(times.tolist(), poses, strict=True)]
    views = views_of(torch.stack(alpha), times)
    for time, floats in ((0.1, True), (0.9, False)):
        red = redness(balls[1.0], grid_renderer(), views, time)
        assert bool((red > 0.3).any()) == floats


def test_drawing_ends_once_it_is_not_wanted():
    stop = Mock(side_effect=[False, False, True])
    more: Any = {"views": views_of(), "frame": FLAT, "background": torch.ones(3), "at_once": 100}
    assert draw(Balls(FRONT), grid_renderer(), shot(), stop=stop, **more) is None
    assert stop.call_count == 3
