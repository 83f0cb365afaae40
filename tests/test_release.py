"""What builds, tests and publishes a release: pinned, with few rights, complete."""

import re
import zipfile
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.training.runs import SMALL
from tests.warm import ROOT, python

WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def read(path: Path) -> dict[Any, Any]:
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def test_actions_are_pinned_by_commit_in_one_version_which_is_named():
    pins = {}
    for path in WORKFLOWS:
        lines = re.findall(r"uses: (.+)", path.read_text(encoding="utf-8"))
        assert lines, path
        for line in lines:
            pinned = r"\./\S+|([\w.-]+/[\w./-]+)@([0-9a-f]{40} # v\d+\.\d+\.\d+)"
            found = re.fullmatch(pinned, line)
            assert found, f"{path}: {line}"
            assert pins.setdefault(found[1], found[2]) == found[2], line


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_only_jobs_that_publish_may_write(path):
    workflow = read(path)
    assert workflow["permissions"] == {"contents": "read"}
    rights = {
        name: job["permissions"] for name, job in workflow["jobs"].items() if "permissions" in job
    }
    allowed = {
        "release.yml": {"publish": {"id-token": "write"}},
        "site.yml": {"deploy": {"pages": "write", "id-token": "write"}},
    }
    assert rights == allowed.get(path.name, {})
    for job in workflow["jobs"].values():
        assert "uses" in job or job["timeout-minutes"] <= 60


def test_nothing_is_published_that_was_not_tested():
    jobs = read(ROOT / ".github" / "workflows" / "release.yml")["jobs"]
    assert set(jobs["publish"]["needs"]) == {"test", "build"}
    assert jobs["test"]["uses"] == "./.github/workflows/ci.yml"
    calls = read(ROOT / ".github" / "workflows" / "ci.yml")[True]  # YAML 1.1 reads "on" as true.
    assert "workflow_call" in calls


def test_hooks_run_the_tools_of_this_environment():
    (repository,) = read(ROOT / ".pre-commit-config.yaml")["repos"]
    assert repository["repo"] == "local"
    entries = [hook["entry"] for hook in repository["hooks"]]
    assert [entry.split()[0] for entry in entries] == ["ruff", "ruff", "pyright", "python"]
    assert all(hook["language"] == "system" for hook in repository["hooks"])
    assert (ROOT / entries[-1].split()[1]).is_file()


def test_the_image_holds_what_the_wheel_is_built_from():
    lines = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    assert lines[1] == "*"
    kept = {line[1:] for line in lines if line.startswith("!")}
    assert kept == {"conf", "xplanes", "LICENSE", "README.md", "pyproject.toml"}
    assert all((ROOT / name).exists() for name in kept)


def test_the_image_runs_as_a_user_without_rights():
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    users = re.findall(r"^USER (\S+)", text, re.MULTILINE)
    assert users == ["1000"]
    assert text.index("USER 1000") < text.index("ENTRYPOINT")
    torch = re.search(r"^ARG TORCH=(\S+)", text, re.MULTILINE)
    assert torch
    assert f"torch=={torch[1]}" in (ROOT / "README.md").read_text(encoding="utf-8")


# The wheel, installed without the repository and used from an empty folder


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that holds what the wheel installs."""
    place = tmp_path_factory.mktemp("wheel")
    python("-m", "hatchling", "build", "-t", "wheel", "-d", str(place))
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
    printed = python("-c", code, cwd=tmp_path, env=settings).stdout
    for words in (
        str(installed / "xplanes" / "__init__.py"),
        *("pretrain-lrm", "architecture: openlrm-large-1.1", "psnr", "xplanes train resume="),
        *("wrote video.webp", "1 runs: 1 finished"),
    ):
        assert words in printed, words
    assert {path.name for path in tmp_path.iterdir()} == {"data", "outputs", "video.webp"}


def test_the_page_and_its_scripts_are_shipped():
    builder = pytest.importorskip("hatchling.builders.wheel").WheelBuilder(str(ROOT))
    shipped = {Path(file.distribution_path) for file in builder.recurse_included_files()}
    page = {path.relative_to(ROOT) for path in (ROOT / "xplanes" / "tools" / "web").iterdir()}
    assert page
    assert page | {Path("xplanes", "conf", "train.yaml")} <= shipped
