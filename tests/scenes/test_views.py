"""Views of two cameras taken together."""

import shutil
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import pytest
import torch

from tests.refusals import assert_refused
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


def test_views_that_do_not_fit_are_refused():
    views = ball_views(2, 0.5)
    for change in ({"size": 20}, {"angle": 0.9}):
        other = ball_views(2, 0.5, **change)
        words = r"data\.train_on_video=false"
        assert_refused(SceneError, words, partial(joined, views, other), change)


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    """Settings of a demo scene that is on disk."""
    folder = tmp_path_factory.mktemp("scenes")
    config = parse(small_config(folder, "data.resolution=8", "data.views=4")).data
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("xplanes.scenes.demo.write.VIDEO_FRAMES", 5)
        build_scene(config)
        yield config


def test_the_video_of_a_scene_can_be_trained_on(config):
    scene = build_scene(replace(config, train_on_video=True))
    assert len(scene.video) == 5
    assert len(scene.splits["train"]) == 4 + 5
    assert len(scene.splits["test"]) == 3
    assert len(build_scene(config).splits["train"]) == 4


def test_a_video_that_is_not_there_is_refused(config, tmp_path):
    (folder,) = Path(config.root).iterdir()
    shutil.copytree(folder, tmp_path / folder.name)
    (tmp_path / folder.name / "transforms_video.json").unlink()
    values = {field.name: getattr(config, field.name) for field in fields(DataConfig)}
    values |= {"root": str(tmp_path), "scene": folder.name, "train_on_video": True}
    with pytest.raises(SceneError, match=r"no video of a fixed camera.*set it to false"):
        build_scene(DataConfig(**values))
