"""Static scenes: how they are detected, and how their times are set."""

from dataclasses import replace

import torch

from tests.balls import ball_scene, ball_views
from xplanes.scenes.source import SAME, as_static, frames_are_equal


def video(*, change: int = 0, count: int = 5):
    """A video of equal frames, but for one pixel of the last."""
    views = ball_views(count, 0.5)
    images = views.images[:1].repeat(count, 1, 1, 1)
    images[-1, 3, 4, 1] += change  # Of nothing but background.
    return replace(views, images=images)


def test_one_changed_pixel_is_detected():
    for change in (0, 1, SAME, SAME + 1, 200):
        assert frames_are_equal(video(change=change)) == (change <= SAME), change


def test_one_timestep_does_not_prove_a_static_scene():
    assert not frames_are_equal(video(count=1))
    views = video()
    assert not frames_are_equal(replace(views, times=torch.zeros(5)))


def test_a_static_scene_has_all_views_at_one_time():
    scene = replace(ball_scene(), video=video())
    static = as_static(scene, "said so")
    assert static.static_reason == "said so"
    assert len(static.video) == 1
    for name, views in static.splits.items():
        assert views.is_static
        assert views.files == scene.splits[name].files
        assert torch.equal(views.images, scene.splits[name].images)
    assert not scene.splits["train"].is_static
