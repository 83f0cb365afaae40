"""Small runs that can be killed, and what they must come to in the end."""

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.training.runs import outcome, small_config
from tests.warm import ROOT

SETTINGS = (
    "callbacks.checkpoints.every=3",
    "model.precision=32",
    "preparation.frames=6",
    "preparation.fixed_view=train",
    "preparation.fixed_view_steps=10",
    "preparation.fixed_view_seconds=1000",
)


class Tally:
    """Counts of one test; its docstring names the fault."""

    def __init__(self, kind: str) -> None:
        counts = dict.fromkeys(("cases", "recovered", "said"), 0)
        self.content: dict[str, Any] = {"kind": kind.strip().rstrip("."), **counts}

    def recovered(self) -> None:
        """Count a case that came to what it would have come to without the fault."""
        self.content["cases"] += 1
        self.content["recovered"] += 1

    def said(self, text: str, *words: str) -> None:
        """Count a message, which must hold all these words and no traceback."""
        for word in words:
            assert word in text, text
        assert "Traceback" not in text, text
        self.content["said"] += 1


@pytest.fixture
def tally(request: pytest.FixtureRequest) -> Tally:
    """The counts of the requesting test."""
    counts = Tally(request.function.__doc__)
    request.node.user_properties.append(("tally", counts.content))
    return counts


@dataclass
class Child:
    """A run in a process of its own."""

    pid: int
    log: Path
    finish: Callable[[], int]

    def output(self) -> str:
        return self.log.read_text(errors="replace")


class Nursery:
    """Forks runs, one after the other."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.faults.nursery"],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.count = 0
        assert self._number() == 0

    def start(self, config: dict[str, Any], folder: Path, *, resume: bool, **more: Any) -> Child:
        self.count += 1
        log = self.folder / f"{self.count}.log"
        job = {"config": config, "folder": str(folder), "resume": resume, "log": str(log), **more}
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(job) + "\n")
        self.process.stdin.flush()
        return Child(self._number(), log, self._number)

    def run(self, config: dict[str, Any], folder: Path, *, resume: bool, **more: Any) -> Child:
        """Run to the end, which must be a good one."""
        child = self.start(config, folder, resume=resume, **more)
        assert child.finish() == 0, child.output()
        return child

    def _number(self) -> int:
        assert self.process.stdout is not None
        return int(self.process.stdout.readline())


@contextmanager
def nursery_in(folder: Path) -> Iterator[Nursery]:
    """A place where runs start, with their logs in a folder."""
    nursery = Nursery(folder)
    yield nursery
    nursery.process.stdin.close()  # type: ignore[union-attr]
    nursery.process.wait(60)


@pytest.fixture(scope="session")
def nursery(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Nursery]:
    with nursery_in(tmp_path_factory.mktemp("logs")) as found:
        yield found


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scenes that all runs share."""
    return tmp_path_factory.mktemp("shared")


def config_of(root: Path, lrm: str, cache: Path | None, *overrides: str) -> dict[str, Any]:
    """A run of 40 steps with random initialisation or from an LRM."""
    place = f"preparation.cache={'null' if cache is None else cache}"
    wide = ("model.channels=32", "model.decoder.width=64") if lrm == "tiny" else ()
    return small_config(root / "scenes", *SETTINGS, *wide, f"lrm={lrm}", place, *overrides)


@pytest.fixture(scope="session")
def whole(
    nursery: Nursery, shared: Path, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Any]:
    """What uninterrupted runs come to, by LRM."""
    found = {}
    for lrm in ("none", "tiny"):
        folder = tmp_path_factory.mktemp("whole")
        nursery.run(config_of(shared, lrm, folder / "cache"), folder / "run", resume=False)
        found[lrm] = outcome(folder / "run")
    return found


@pytest.fixture
def recovered(tally: Tally, nursery: Nursery, whole: dict[str, Any]) -> Callable[..., None]:
    """Checks that a run, which ``config`` lets go on first, came to what a whole one does."""

    def check(folder: Path, lrm: str = "none", config: dict[str, Any] | None = None) -> None:
        if config is not None:
            nursery.run(config, folder, resume=(folder / "run.json").is_file())
        assert outcome(folder) == whole[lrm]
        tally.recovered()

    return check
