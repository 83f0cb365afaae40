"""Scenes in which nothing moves: when that is said, and what becomes of their times."""

from dataclasses import replace

import torch

from tests.synthetic import ball_scene, ball_views
from xplanes.scenes.source import SAME, at_one_moment, stands_still


def film(*, change: int = 0, count: int = 5):
    """A video of equal frames, but for one pixel of the last."""
    views = ball_views(count, 0.5)
    images = views.images[:1].repeat(count, 1, 1, 1)
    images[-1, 3, 4, 1] = (
        images[-1, 3, 4, 1].to(torch.int16).add(change).clamp(0, 255).to(torch.uint8)
    )
    return replace(views, images=images)


def test_one_pixel_tells():
    for change in (0, 1, SAME, SAME + 1, 200):
        assert stands_still(film(change=change)) == (change <= SAME), change


def test_frames_of_one_moment_say_nothing():
    assert not stands_still(film(count=1))
    views = film()
    assert not stands_still(replace(views, times=torch.zeros(5)))


def test_all_views_come_to_one_moment():
    scene = replace(ball_scene(), video=film())
    still = at_one_moment(scene, "said so")
    assert still.still == "said so"
    assert len(still.video) == 1
    for name, views in still.splits.items():
        assert views.is_still
        assert views.files == scene.splits[name].files
        assert torch.equal(views.images, scene.splits[name].images)
    assert not scene.splits["train"].is_still
