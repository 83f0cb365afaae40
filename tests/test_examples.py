"""The notebook and its twin run from the first cell to the last."""

import json
import shlex
from pathlib import Path
from typing import Any

import pytest

from tests import inside
from tests.training.runs import SMALL

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"

pytest.importorskip("trimesh")
pytest.importorskip("skimage")

OF_THE_LRM = ("lrm=", "model.channels", "model.decoder")
SHORT = [*(text for text in SMALL if not text.startswith(OF_THE_LRM)), "preparation.frames=3"]


@pytest.fixture
def settings(tmp_path: Path, scenes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Few steps on small images, in a folder of their own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FIRST_MINUTE_SETTINGS", shlex.join([*SHORT, f"data.root={scenes}"]))
    monkeypatch.setenv("PYTHONPATH", str(EXAMPLES.parent))


def check_outputs(folder: Path) -> None:
    written = folder / "outputs" / "first_minute"
    for run, lrm in (("lrm", "tiny"), ("random", "none")):
        metrics = json.loads((written / run / "metrics.json").read_text())
        assert (metrics["lrm"].get("name", "none"), metrics["step"]) == (lrm, 40)
    assert (written / "picture.png").is_file()
    assert len(json.loads((written / "web" / "export.json").read_text())["times"]) == 8


@pytest.mark.slow
def test_the_script_runs(settings, tmp_path):
    text = (EXAMPLES / "first_minute.py").read_text(encoding="utf-8")
    for long, short in (('"320"', '"64"'), ('"--times", "8"', '"--times", "8", *COARSE')):
        assert text.count(long) == 1
        text = text.replace(long, short)
    script = tmp_path / "first_minute.py"
    script.write_text(f'COARSE = "--resolution", "32"\n{text}', encoding="utf-8")
    done = inside.run(str(script), cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"open {Path('outputs', 'first_minute', 'web', 'index.html')}" in done.stdout
    check_outputs(tmp_path)


@pytest.mark.slow
def test_the_notebook_runs(settings, tmp_path, monkeypatch):
    """Its cells are those of the script, which tests/test_docs.py checks."""
    # Another process, whose scenes have videos of their usual length.
    own = shlex.join([*SHORT, f"data.root={tmp_path / 'scenes'}"])
    monkeypatch.setenv("FIRST_MINUTE_SETTINGS", own)
    nbformat: Any = pytest.importorskip("nbformat")
    nbclient: Any = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    notebook = nbformat.read(EXAMPLES / "first_minute.ipynb", as_version=4)
    nbformat.validate(notebook)
    client = nbclient.NotebookClient(
        notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}
    )
    client.execute()
    check_outputs(tmp_path)
    pictures = [
        output["data"]
        for cell in notebook.cells
        if cell.cell_type == "code"
        for output in cell.outputs
        if output.output_type == "display_data"
    ]
    assert ["image/png" in data for data in pictures] == [True, True]
