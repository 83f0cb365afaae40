"""Views of two cameras taken together."""

from dataclasses import fields, replace

import pytest
import torch

from tests.synthetic import ball_views
from tests.training.runs import small_config
from xplanes.checks import parse
from xplanes.config import DataConfig
from xplanes.scenes.errors import SceneError
from xplanes.scenes.views import joined
from xplanes.training.builder import build_scene


def test_views_are_joined_in_order():
    first, second = ball_views(3, 0.5), ball_views(2, 0.4, seed=1)
    both = joined(first, second)
    assert len(both) == 5
    assert both.files == first.files + second.files
    assert torch.equal(both.images[3:], second.images)
    assert torch.equal(both.camera_to_world[:3], first.camera_to_world)
    assert both.times.tolist() == pytest.approx([0, 0.5, 1, 0, 1])


@pytest.mark.parametrize("change", [{"size": 20}, {"angle": 0.9}])
def test_views_that_do_not_fit_are_refused(change):
    with pytest.raises(SceneError, match=r"data\.train_on_video=false"):
        joined(ball_views(2, 0.5), ball_views(2, 0.5, **change))


def test_the_video_of_a_scene_can_be_trained_on(tmp_path):
    config = parse(small_config(tmp_path, "data.train_on_video=true", "data.views=4"))
    scene = build_scene(config.data)
    assert len(scene.splits["train"]) == 4 + len(scene.video)
    assert len(scene.splits["test"]) == 3
    plain = build_scene(replace(config.data, train_on_video=False))
    assert len(plain.splits["train"]) == 4


def test_a_video_that_is_not_there_is_refused(tmp_path):
    config = parse(small_config(tmp_path)).data
    build_scene(config)
    folder = next(tmp_path.iterdir())
    (folder / "transforms_video.json").unlink()
    values = {field.name: getattr(config, field.name) for field in fields(DataConfig)}
    values |= {"scene": folder.name, "train_on_video": True}
    with pytest.raises(SceneError, match=r"no video of a fixed camera.*set it to false"):
        build_scene(DataConfig(**values))
