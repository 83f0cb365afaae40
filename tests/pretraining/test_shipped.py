"""The models in the package are those that conf/ describes, small, and better than nothing."""

import dataclasses

import pytest
import torch

from xplanes.config import CONF
from xplanes.lrm.bundled import FOLDER, bundled_models, load_bundled
from xplanes.lrm.config import parse_config
from xplanes.pretraining.command import compose_pretraining
from xplanes.pretraining.observe import FOCAL
from xplanes.pretraining.score import held_out, score
from xplanes.pretraining.settings import parse_pretraining, published_sizes
from xplanes.scenes.demo.film import CAMERA_ANGLE_X, CAMERA_DISTANCE


def test_there_is_one_and_all_together_are_small():
    assert set(bundled_models()) == {"tiny", "mini"}
    for group in ("pretrain", "lrm"):
        assert set(bundled_models()) <= {path.stem for path in (CONF / group).glob("*.yaml")}
    assert sum(path.stat().st_size for path in FOLDER.iterdir()) < 20e6


@pytest.mark.parametrize("name", bundled_models())
def test_the_weights_are_of_the_described_model(name):
    sizes = parse_pretraining(compose_pretraining([f"pretrain={name}"])).model
    model, _ = load_bundled(name)
    wanted = parse_config(published_sizes(sizes, FOCAL))
    assert dataclasses.asdict(model.config) == dataclasses.asdict(wanted)
    assert all(tensor.isfinite().all() for tensor in model.state_dict().values())


@pytest.mark.parametrize("name", bundled_models())
def test_a_dnerf_camera_is_its_own(name):
    """The similarity that takes such a camera to the model's own is exact."""
    from xplanes.lrm.alignment import align
    from xplanes.scenes.demo.film import camera_at

    model, _ = load_bundled(name)
    focal = 0.5 * 96 / torch.tan(torch.tensor(0.5 * CAMERA_ANGLE_X, dtype=torch.float64))
    found = align(
        camera_at(30.0, 20.0),
        focal=float(focal),
        height=96,
        width=96,
        target=torch.zeros(3),
        view=model.view,
    )
    assert found.mismatch.largest < 1e-9
    assert found.frame.scale == pytest.approx(model.view.distance / CAMERA_DISTANCE)


@pytest.mark.parametrize("name", bundled_models())
def test_it_reconstructs_what_it_never_saw(name):
    model, _ = load_bundled(name)
    found = [score(model, subject).values for subject in held_out(2)]
    assert sum(values["psnr_novel"] for values in found) / 2 > 15
    assert sum(values["psnr_input"] for values in found) / 2 > 19
    assert sum(values["iou"] for values in found) / 2 > 0.15
