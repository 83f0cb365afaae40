"""Runs initialised from a Large Reconstruction Model: stages, files, resuming."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.preparation.test_reconstruct import CHOICES, publish
from tests.refusals import interrupt
from tests.training.runs import SMALL, changed, metrics, status
from xplanes.models.initialisation import STAGES
from xplanes.preparation import fixed_view, sources
from xplanes.tools.evaluate import evaluate
from xplanes.tools.runs import load_run


@pytest.fixture(scope="module", autouse=True)
def small_fields() -> Iterator[None]:
    """The field that renders the fixed-view video is small too."""
    sizes = [text for text in SMALL if text.startswith("model.")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fixed_view, "compose_plain", lambda _, lines: changed((*lines, *sizes)))
        yield


def source(place: Path, name: str) -> tuple[str, ...]:
    """Overrides of runs from an LRM, whose weights and cache lie in a folder."""
    return (
        *CHOICES[name],
        *(f"lrm.weights={publish(place / name, name)}", f"preparation.cache={place}/cache"),
        *("preparation.frames=3", "preparation.fixed_view_seconds=1000"),
        *("preparation.fixed_view_steps=4", "trainer.max_steps=2", "callbacks.evaluation.at=[0]"),
    )


RENDERED = "preparation.fixed_view=train"
"""The fixed-view video is rendered by a field."""


def test_a_run_from_the_scenes_video(train, tmp_path):
    folder = train(*source(tmp_path, "triposr"), "model=nine_planes")
    told = metrics(folder)
    seconds = told["seconds"]["prepare"]
    assert set(seconds) == set(STAGES)
    assert seconds["fixed_view"] == 0
    assert all(seconds[stage] > 0 for stage in STAGES[1:])
    assert told["lrm"]["frames"] == 3
    assert set(told["decomposition"]) == {"xy", "xz", "yz", "unexplained"}
    for picture in ("fixed_view.png", "decomposition.png"):
        assert (folder / "media" / picture).is_file()
    assert list((folder / "media" / "step000000").glob("*.png"))
    loaded = load_run(folder)
    again = evaluate(loaded, "none")
    assert again["test"]["psnr"] == pytest.approx(told["test"]["psnr"], abs=1e-4)


def test_a_stopped_preparation_resumes_from_the_last_finished_stage(train, tmp_path, monkeypatch):
    place = tmp_path / "uninterrupted"
    whole = metrics(train(*source(place, "openlrm-1.1"), RENDERED, name="uninterrupted/run"))
    overrides = (*source(tmp_path, "openlrm-1.1"), RENDERED)
    with monkeypatch.context() as patch:
        patch.setattr(sources, "from_sequence", interrupt)
        with pytest.raises(KeyboardInterrupt):
            train(*overrides)
    assert status(tmp_path / "run")["status"] == "interrupted"
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "cache").glob("*.pt")}
    assert {path.name.split("-")[0] for path in kept} >= {"fixed_view", "triplane"}
    told = metrics(train(*overrides, resume=True))
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert told["seconds"]["prepare"]["fixed_view"] > 0
    assert "rendered by six_planes" in told["lrm"]["fixed_view"]
    assert told["test"] == whole["test"]
