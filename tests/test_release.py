"""What builds, tests and publishes a release: pinned, with few rights, complete."""

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def read(path: Path) -> dict[Any, Any]:
    return yaml.safe_load(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_actions_are_pinned_by_commit_and_name_their_version(path):
    lines = re.findall(r"uses: (.+)", path.read_text(encoding="utf-8"))
    assert lines
    for line in lines:
        assert re.fullmatch(r"(\./\S+|[\w.-]+/[\w./-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+)", line), line


def test_one_version_of_an_action_is_used_everywhere():
    text = "".join(path.read_text(encoding="utf-8") for path in WORKFLOWS)
    pins = set(re.findall(r"uses: ([\w.-]+/[\w./-]+)@(\S+)", text))
    assert len(pins) == len({name for name, _ in pins})


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
