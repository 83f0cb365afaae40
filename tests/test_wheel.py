"""The wheel, installed without the repository and used from an empty folder."""

import os
import subprocess
import sys
import zipfile
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
    run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(place), cwd=ROOT)
    (wheel,) = place.glob("xplanes-*.whl")
    with zipfile.ZipFile(wheel) as content:
        content.extractall(place / "site")
    return place / "site"


COMMANDS = """
import sys
from importlib.metadata import entry_points
import xplanes
from xplanes.synthetic.demo import write

write.VIDEO_FRAMES = 2
(script,) = entry_points(group="console_scripts", name="xplanes")
main = script.load()
print(xplanes.__file__)
for arguments in {!r}:
    try:
        code = main(arguments)
    except SystemExit as end:
        code = end.code
    assert not code, arguments
"""


@pytest.mark.slow
def test_commands_work_from_an_empty_folder(installed, tmp_path):
    # The compiled loops would take half a minute to compile for this copy.
    settings = {"PYTHONPATH": str(installed), "XPLANES_CPU_LOOPS": "0"}
    commands = [
        ["--help"],
        ["train", "model=nine_planes", "lrm=xlarge", "--cfg", "job"],
        ["train", *SMALL, "trainer.max_steps=5", "hydra.run.dir=outputs/run"],
        "render outputs/run --frames 2 --size 16 --out video.webp".split(),
        ["table", "outputs"],
    ]
    code = COMMANDS.format(commands)
    printed = run(sys.executable, "-c", code, cwd=tmp_path, **settings)
    for words in (
        str(installed / "xplanes" / "__init__.py"),
        *("pretrain-lrm", "architecture: openlrm-large-1.1", "psnr", "xplanes train resume="),
        *("wrote video.webp", "1 runs: 1 finished"),
    ):
        assert words in printed, words
    assert {path.name for path in tmp_path.iterdir()} == {"data", "outputs", "video.webp"}


def test_the_page_and_its_scripts_are_shipped():
    """Of what goes into a wheel, a list is enough."""
    builder = pytest.importorskip("hatchling.builders.wheel").WheelBuilder(str(ROOT))
    shipped = {Path(file.distribution_path) for file in builder.recurse_included_files()}
    page = {path.relative_to(ROOT) for path in (ROOT / "xplanes" / "tools" / "web").iterdir()}
    assert page
    assert page | {Path("xplanes", "conf", "train.yaml")} <= shipped
