"""Views of two cameras taken together."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.balls import ball_views
from tests.training.runs import small_config
from xplanes.components import build
from xplanes.errors import SceneError
from xplanes.scenes.dnerf import BlenderSettings
from xplanes.scenes.source import SceneSettings
from xplanes.scenes.views import joined


def test_views_are_joined_in_order():
    first, second = ball_views(3, 0.5), ball_views(2, 0.4, seed=1)
    both = joined(first, second)
    assert len(both) == 5
    assert both.files == first.files + second.files
    assert torch.equal(both.images[3:], second.images)
    assert torch.equal(both.camera_to_world[:3], first.camera_to_world)
    assert both.times.tolist() == pytest.approx([0, 0.5, 1, 0, 1])


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    """Settings of a demo scene that is on disk."""
    folder = tmp_path_factory.mktemp("scenes")
    plain = small_config(folder, "data.resolution=8", "data.views=4")
    config = build(plain["data"], SceneSettings, "data")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("xplanes.synthetic.demo.write.VIDEO_FRAMES", 5)
        config.read()
        yield config


def test_the_video_of_a_scene_can_be_trained_on(config):
    scene = replace(config, train_on_video=True).read()
    assert len(scene.video) == 5
    assert len(scene.splits["train"]) == 4 + 5
    assert len(scene.splits["test"]) == 3
    assert len(config.read().splits["train"]) == 4


def test_a_video_that_is_not_there_is_refused(config, tmp_path):
    (folder,) = Path(config.root).iterdir()
    shutil.copytree(folder, tmp_path / folder.name)
    (tmp_path / folder.name / "transforms_video.json").unlink()
    shared = {name: getattr(config, name) for name in ("resolution", "views", "static")}
    values = shared | dict.fromkeys(("eval_views", "half_side", "centre", "cache"))
    values |= {"eval_split": "test", "refine_cameras": False, "mask_use": "auto"}
    values |= {"name": "dnerf", "root": str(tmp_path), "scene": folder.name}
    with pytest.raises(SceneError, match=r"no video of a fixed camera.*set it to false"):
        BlenderSettings(**values, train_on_video=True).read()
