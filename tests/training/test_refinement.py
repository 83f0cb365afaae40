"""Space planes that get more texels while they train."""

from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import DictConfig

from tests.training.runs import small_config
from xplanes.errors import ConfigError
from xplanes.evaluation.runs import load_run
from xplanes.fields.xplanes import refined
from xplanes.models import x_planes
from xplanes.pipeline import run
from xplanes.scenes.frame import Frame, pixel_footprint
from xplanes.scenes.views import Intrinsics, Views
from xplanes.training.clock import TrainingClock


def config_of(scenes: Path, *overrides: str) -> DictConfig:
    return small_config(
        scenes,
        "trainer.max_steps=16",
        "callbacks.checkpoints.every=4",
        "callbacks.evaluation.at=[]",
        *overrides,
    )


def planes_after(folder: Path, config: DictConfig) -> dict[str, torch.Tensor]:
    run(config, folder, [], resume=False)
    return load_run(folder).module.state_dict()


@pytest.fixture
def early(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(x_planes, "REFINE_FROM", 6)


def test_refined_planes_lie_between_the_texels_that_there_were() -> None:
    """Against numpy's interpolation along one axis and then the other."""
    generator = torch.Generator().manual_seed(0)
    planes = torch.rand(3, 5, 5, 2, generator=generator, dtype=torch.float64)
    # Centres of texels; numpy repeats the outermost beyond the last centre, as is wanted.
    coarse, fine = (np.arange(5) + 0.5) / 5, (np.arange(13) + 0.5) / 13

    def along(values: np.ndarray) -> np.ndarray:
        return np.interp(fine, coarse, values)

    expected = np.apply_along_axis(along, 1, np.apply_along_axis(along, 2, planes.numpy()))
    np.testing.assert_allclose(refined(planes, 13).numpy(), expected, atol=1e-14)
    assert torch.equal(refined(planes, 5), planes)


def test_a_refined_run_resumes_to_the_same_bits(
    scenes: Path, tmp_path: Path, early: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It fails before its planes are refined, and after."""
    config = config_of(scenes, "model.final_resolution=40")
    whole = planes_after(tmp_path / "whole", config)
    assert whole["field.space"].shape == (3, 40, 40, 8)
    original, folder, stop = TrainingClock.on_train_batch_end, tmp_path / "broken", 0

    def break_down(self, trainer, module, *rest) -> None:
        original(self, trainer, module, *rest)
        if trainer.global_step == stop:
            raise OSError("power cut")

    with monkeypatch.context() as patch:
        patch.setattr(TrainingClock, "on_train_batch_end", break_down)
        for stop in (5, 11):
            with pytest.raises(OSError, match="power cut"):
                run(config, folder, [], resume=stop > 5)
    run(config, folder, [], resume=True)
    again = load_run(folder).module.state_dict()
    for name, value in whole.items():
        assert torch.equal(again[name], value), name


def test_planes_are_refined_only_while_there_is_time_to_learn(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(x_planes, "REFINE_FROM", 9)
    config = config_of(scenes, "model.final_resolution=40")
    assert planes_after(tmp_path / "late", config)["field.space"].shape == (3, 24, 24, 8)


def test_texels_follow_the_pixels(scenes: Path, tmp_path: Path, early: None) -> None:
    """32 pixels are no more than the texels; a cube eight times as large is."""
    sizes = {"null": 24, "auto": 24, "auto data.half_side=8": 48}
    for index, (options, size) in enumerate(sizes.items()):
        config = config_of(scenes, *f"model.final_resolution={options}".split())
        found = planes_after(tmp_path / str(index), config)["field.space"].shape[1]
        assert found == size, options


def test_a_footprint_is_a_pixel_s_width_in_the_middle_of_the_cube() -> None:
    poses = torch.eye(4).repeat(3, 1, 1)
    poses[:, 2, 3] = torch.tensor([4.0, 5.0, 9.0])
    views = Views(
        torch.zeros(3, 20, 20, 4, dtype=torch.uint8),
        poses,
        torch.zeros(3),
        Intrinsics.shared(50.0, 20, 20, 3),
        ("a", "b", "c"),
    )
    frame = Frame(scale=0.5, rotation=torch.eye(3), centre=torch.tensor([0.0, 0.0, 1.0]))
    assert pixel_footprint(views, frame) == pytest.approx(0.5 * 4 / 50, rel=1e-6)


def test_planes_are_not_refined_to_fewer_texels(scenes: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"final_resolution=8: must be at least .*resolution=24"):
        run(config_of(scenes, "model.final_resolution=8"), tmp_path / "run", [], resume=False)
