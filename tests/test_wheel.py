"""The wheel, installed without the repository and used from an empty folder."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.training.runs import SMALL

ROOT = Path(__file__).resolve().parents[1]


def run(*command: str, cwd: Path, **environment: str) -> str:
    """What a command prints; it must succeed."""
    done = subprocess.run(
        command,
        cwd=cwd,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that holds what the wheel installs."""
    place = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    run(*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", str(place), ".", cwd=ROOT)
    (wheel,) = place.glob("xplanes-*.whl")
    run(*pip, "install", "--no-deps", "--target", str(place / "site"), str(wheel), cwd=place)
    return place / "site"


def test_commands_work_from_an_empty_folder(installed: Path, tmp_path: Path) -> None:
    def xplanes(*arguments: str) -> str:
        script = next((installed / "bin").glob("xplanes*"))
        # The compiled loops would take half a minute to compile for this copy.
        settings = {"PYTHONPATH": str(installed), "XPLANES_CPU_LOOPS": "0"}
        return run(sys.executable, str(script), *arguments, cwd=tmp_path, **settings)

    found = run(
        sys.executable,
        "-c",
        "import xplanes; print(xplanes.__file__)",
        cwd=tmp_path,
        PYTHONPATH=str(installed),
    )
    assert Path(found.strip()) == installed / "xplanes" / "__init__.py"
    composed = xplanes("train", "model=nine_planes", "lrm=xlarge", "--cfg", "job")
    assert "architecture: openlrm-large-1.1" in composed
    assert "pretrain-lrm" in xplanes("--help")
    printed = xplanes("train", *SMALL, "trainer.max_steps=5", "hydra.run.dir=outputs/run")
    assert "psnr" in printed
    assert "xplanes train resume=" in printed
    xplanes("render", "outputs/run", "--frames", "2", "--size", "16", "--out", "video.webp")
    assert (tmp_path / "video.webp").is_file()
    assert "1 runs: 1 finished" in xplanes("table", "outputs")
    assert {path.name for path in tmp_path.iterdir()} == {"data", "outputs", "video.webp"}
