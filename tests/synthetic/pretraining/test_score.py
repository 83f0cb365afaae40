"""Scores of an ideal model and of an untrained one."""

import json

import numpy as np
import pytest
import torch
from PIL import Image

from tests.synthetic.pretraining.small import VIEW, small_pool, small_sizes
from tests.synthetic.pretraining.test_solids import one
from xplanes.cli import main
from xplanes.fields.decoder import Decoder
from xplanes.synthetic.demo.render import camera_at
from xplanes.synthetic.pretraining import score as score_module
from xplanes.synthetic.pretraining.initialisation import init_model
from xplanes.synthetic.pretraining.pool import inside, render_solids
from xplanes.synthetic.pretraining.quick import QuickLook, overlap, world_to_model
from xplanes.synthetic.pretraining.score import Subject, demo_subjects, held_out, score, score_all
from xplanes.synthetic.pretraining.solids import BOX

SIDE, TEXELS = 40, 64


class Oracle(Decoder):
    """Knows the solids; its features are the coordinates."""

    def __init__(self, solids, turn, colour):
        super().__init__(2, density_scale=400.0)
        self.solids, self.back, self.colour = solids, torch.linalg.inv(turn), colour

    def logits(self, features):
        points = features[:, [0, 1, 3]] @ self.back.T
        solid = torch.from_numpy(inside(self.solids, points.double().numpy()))
        colour = torch.logit(torch.tensor(self.colour)).expand(len(points), 3)
        return torch.cat([torch.where(solid, 20.0, -20.0)[:, None], colour], dim=-1)


class KnowingModel:
    """Answers every picture with the same object."""

    view, half_side, image_size = VIEW, 1.0, SIDE

    def __init__(self, solids, pose, colour):
        self.decoder = Oracle(solids, world_to_model(pose, self), colour)  # type: ignore[arg-type]

    def encode(self, images):
        line = (2 * torch.arange(TEXELS) + 1) / TEXELS - 1
        rows, columns = torch.meshgrid(line, line, indexing="ij")
        return torch.stack([columns, rows]).expand(1, 3, 2, TEXELS, TEXELS)


def test_a_model_that_knows_the_answer_scores_high():
    """Cameras, scale and axes from the world to the planes fit together."""
    light = [0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0]
    solids = one(BOX, light=light).moved(0.9, np.array([0.2, -0.1, 0.15]))
    solids.numbers[:] = 0  # one even colour
    poses = [camera_at(*at).numpy() for at in ((20, 15), (110, 40), (-60, 5))]
    colour = solids.paints[0, 0].tolist()
    subject = Subject(
        "box",
        torch.from_numpy(np.stack(poses)),
        lambda pose, side: torch.from_numpy(render_solids(solids, pose.numpy(), side)[0]),
        lambda points: torch.from_numpy(inside(solids, points.double().numpy())),
    )
    model = KnowingModel(solids, subject.cameras[0], colour)
    found = score(model, subject)  # type: ignore[arg-type]
    assert found.values["iou"] > 0.99
    assert found.values["psnr_input"] > 20  # edges are sampled once per pixel
    assert found.values["psnr_novel"] > 20
    assert found.strip.shape == (SIDE, 4 * SIDE, 3)
    wrong = KnowingModel(solids, subject.cameras[1], colour)
    assert score(wrong, subject).values["iou"] < 0.7  # type: ignore[arg-type]


def test_subjects_are_held_out_objects_and_demo_scenes():
    first = next(held_out(1))
    assert first.cameras.shape == (4, 4, 4)
    assert first.picture(first.cameras[0], 16).shape == (16, 16, 3)
    scene = next(demo_subjects())
    assert scene.name == "excavator"
    picture = scene.picture(scene.cameras[0], 16)
    assert (picture[0, 0] == 1).all()
    assert (picture[8, 8] < 1).any()
    assert scene.inside(torch.tensor([[0.0, -0.65, -0.55], [3, 3, 3]])).tolist() == [True, False]


def test_scores_and_sheets_are_written(tmp_path, monkeypatch):
    monkeypatch.setattr(score_module, "GRID", 8)
    monkeypatch.setattr(score_module, "demo_subjects", lambda: held_out(1))
    lines, model = [], init_model(small_sizes(), 0).eval()
    table = score_all(model, tmp_path, objects=2, announce=lines.append)
    written = json.loads((tmp_path / "scores.json").read_text())
    assert written["mean"] == table
    assert set(written["objects"]) == {"object 0", "object 1"}
    assert "psnr_novel" in lines[0]
    assert Image.open(tmp_path / "objects.png").size == (8 * 24, 24)
    assert (tmp_path / "failures.png").is_file()


def test_quick_scores_need_no_rendering_of_objects_and_overlap_counts_points():
    yes, no = torch.tensor([True, True, False]), torch.tensor([False, True, True])
    assert overlap(yes, no) == pytest.approx(1 / 3)
    assert overlap(no & False, yes & False) == 1
    values = QuickLook(small_pool(2), 2).scores(init_model(small_sizes(), 0))
    assert 0 <= values["iou"] <= 1
    assert 3 < values["psnr_novel"] < 30


def test_the_command_names_what_is_wrong(tmp_path, capsys):
    assert main(["score-lrm", str(tmp_path / "none.safetensors")]) == 1
    assert "none.safetensors" in capsys.readouterr().err
    assert main(["score-lrm", "tiny", "--objects", "0"]) == 1
    assert "--objects 0" in capsys.readouterr().err
