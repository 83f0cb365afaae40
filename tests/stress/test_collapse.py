"""Beginnings on scenes of all kinds: no field shows nothing, or fog."""

import json
from pathlib import Path

import pytest

from xplanes.config import compose_plain
from xplanes.run import run
from xplanes.synthetic.demo.suite import KINDS

pytestmark = pytest.mark.stress

BEGINNINGS = [(kind, lrm, 0) for kind in KINDS for lrm in ("none", "tiny")]
BEGINNINGS += [
    (kind, lrm, seed)
    for kind in ("white_floor", "fixed_cameras")
    for lrm in ("none", "tiny")
    for seed in (1, 2)
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("suite")


@pytest.mark.parametrize(("kind", "lrm", "seed"), BEGINNINGS)
def test_no_field_collapses(folder, tmp_path, kind, lrm, seed):
    config = compose_plain(
        "train",
        [
            *("data=suite", f"data.scene={kind}", f"data.root={folder}", f"lrm={lrm}"),
            *("data.resolution=100", "data.eval_views=4", f"seed={seed}", "media=false"),
            *("trainer.max_steps=500", "trainer.max_seconds=null", "logger=none"),
            *("callbacks.evaluation.at=[]", f"preparation.cache={folder / 'cache'}"),
        ],
    )
    run(config, tmp_path / "run", [], resume=False)
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["restarts"] == 0
    # Thin wires that turn are hardly more than their stand after so few steps.
    assert metrics["test"]["psnr"] > metrics["blank_psnr"]
    assert metrics["test"].get("floaters", 0.0) < 0.5  # Captures have no transparent pixels.
