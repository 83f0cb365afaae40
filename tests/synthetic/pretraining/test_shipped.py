"""The bundled models: sizes as in conf/, file size and quality."""

import dataclasses

import pytest
import torch

from xplanes.components import read_settings
from xplanes.config import CONF, compose_plain
from xplanes.lrm.alignment import align
from xplanes.lrm.config import parse_config
from xplanes.lrm.weights import FOLDER, bundled_models, load_bundled
from xplanes.scenes.cameras import focal_length
from xplanes.synthetic.demo.render import CAMERA_ANGLE_X, CAMERA_DISTANCE, camera_at
from xplanes.synthetic.pretraining import score as score_module
from xplanes.synthetic.pretraining.pool import FOCAL
from xplanes.synthetic.pretraining.score import held_out
from xplanes.synthetic.pretraining.settings import PretrainingSettings, published_sizes


@pytest.fixture(scope="module")
def models():
    return {name: load_bundled(name)[0] for name in bundled_models()}


def test_there_are_two_and_together_they_are_small():
    assert set(bundled_models()) == {"tiny", "mini"}
    for group in ("pretrain", "lrm"):
        assert set(bundled_models()) <= {path.stem for path in (CONF / group).glob("*.yaml")}
    assert sum(path.stat().st_size for path in FOLDER.iterdir()) < 20e6


def test_the_weights_are_of_the_described_model(models):
    for name, model in models.items():
        plain = compose_plain("pretrain_lrm", [f"pretrain={name}"])
        sizes = read_settings(PretrainingSettings, plain).model
        assert sizes.name == name
        wanted = parse_config(published_sizes(sizes, FOCAL))
        assert dataclasses.asdict(model.config) == dataclasses.asdict(wanted), name
        assert all(tensor.isfinite().all() for tensor in model.state_dict().values()), name


def test_a_dnerf_camera_is_its_own(models):
    """The similarity that takes such a camera to the model's own is exact."""
    picture = {"focal": focal_length(CAMERA_ANGLE_X, 96), "height": 96, "width": 96}
    for name, model in models.items():
        pose, target = camera_at(30.0, 20.0), torch.zeros(3)
        found = align(pose, **picture, target=target, view=model.view)
        assert found.mismatch.largest < 1e-9, name
        scale = model.view.distance / CAMERA_DISTANCE
        assert found.frame.scale == pytest.approx(scale), name


def test_it_reconstructs_held_out_objects(models, monkeypatch):
    monkeypatch.setattr(score_module, "GRID", 24)
    _, subject = held_out(2)
    subject = dataclasses.replace(subject, cameras=subject.cameras[:2])
    for name, model in models.items():
        found = score_module.score(model, subject).values
        assert found["psnr_novel"] > 18, name
        assert found["psnr_input"] > 22, name
        assert found["iou"] > 0.35, name
