"""Commands as processes of their own, forked from one that has loaded everything.

As a program, reads one JSON object per line (``arguments``, ``cwd``, ``environment``, ``out``,
``err``), forks a process that runs it, and answers with its id and, once it has ended, with its
exit status.
"""

import importlib
import json
import os
import runpy
import select
import signal
import subprocess
import sys
import tempfile
import time
from functools import cache
from pathlib import Path
from typing import IO, Any

from xplanes.config import compose_plain
from xplanes.process import defaults

ROOT = Path(__file__).resolve().parent.parent

HEAVY = (
    *("torch.utils.tensorboard.writer", "xplanes.fields.lookup_numba", "xplanes.run"),
    "xplanes.rendering.rays_numba",
)

VIDEO_FRAMES = 16
"""Frames of a demo scene's video in tests: the same in commands, which share the scenes."""


class Running:
    """A command under way; as much of `subprocess.Popen` as tests need."""

    def __init__(self, answers: IO[str], folder: Path) -> None:
        self.answers, self.folder = answers, folder
        self.pid = int(answers.readline())
        self.returncode: int | None = None

    def poll(self, seconds: float = 0) -> int | None:
        if self.returncode is None and select.select([self.answers], [], [], seconds)[0]:
            self.returncode = int(self.answers.readline())
        return self.returncode

    def wait(self, seconds: float) -> int:
        code = self.poll(seconds)
        if code is None:
            self.kill()
            raise TimeoutError(f"not done after {seconds} s:\n{self.text('err')}")
        return code

    def send_signal(self, number: int) -> None:
        if self.returncode is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)
        self.poll(30)

    def text(self, stream: str) -> str:
        return (self.folder / stream).read_text(errors="replace")


@cache
def outputs() -> tempfile.TemporaryDirectory[str]:
    """Where the commands' outputs go, until the tests end."""
    return tempfile.TemporaryDirectory()


@cache
def server() -> subprocess.Popen[str]:
    """The process that has loaded everything; one for all tests of a worker."""
    environment = os.environ | defaults(os.environ)
    started = subprocess.Popen(
        [sys.executable, "-m", "tests.warm"],
        cwd=ROOT,
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        bufsize=1,
    )
    assert started.stdout is not None
    assert started.stdout.readline() == "ready\n"
    return started


def start(*arguments: str, cwd: Path = ROOT) -> Running:
    """Begin ``python ARGUMENTS``, of which the first is a script or -m; one at a time."""
    warm, folder = server(), Path(tempfile.mkdtemp(dir=outputs().name))
    job: dict[str, Any] = {"arguments": arguments, "cwd": str(cwd), "environment": {**os.environ}}
    job |= {stream: str(folder / stream) for stream in ("out", "err")}
    assert warm.stdin is not None
    assert warm.stdout is not None
    warm.stdin.write(json.dumps(job) + "\n")
    return Running(warm.stdout, folder)


def run(*arguments: str, cwd: Path = ROOT, code: int = 0) -> subprocess.CompletedProcess[str]:
    """``python ARGUMENTS`` to its end, with this exit status."""
    running = start(*arguments, cwd=cwd)
    ended = running.wait(240)
    assert ended == code, running.text("err")
    return subprocess.CompletedProcess(arguments, code, running.text("out"), running.text("err"))


def train(*arguments: str, **options) -> subprocess.CompletedProcess[str]:
    """``python train.py ARGUMENTS`` to its end, see `run`."""
    return run(str(ROOT / "train.py"), *arguments, **options)


FORK = """
import json, os, sys
exec(sys.argv[1])
for number, code in enumerate(json.loads(sys.argv[2])):
    child = os.fork()
    if child:
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
        continue
    file = os.open(str(number), os.O_WRONLY | os.O_CREAT)
    os.dup2(file, 1)
    os.dup2(file, 2)
    status = 0
    try:
        exec(code)
    except SystemExit as end:
        status = end.code or 0
    except BaseException:
        import traceback
        traceback.print_exc()
        status = 70
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)
"""


def forked(before: str, codes: list[str], folder: Path) -> list[tuple[int, str]]:
    """Exit status and output of scripts, each in a fork of one bare Python that ran ``before``."""
    given = [sys.executable, "-c", FORK, before, json.dumps(codes)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(given, cwd=folder, env=environment, capture_output=True, text=True)
    status = [int(line) for line in done.stdout.split()]
    assert len(status) == len(codes), done.stderr
    return [(code, (folder / str(number)).read_text()) for number, code in enumerate(status)]


def wait_for(path: Path, process: Running | subprocess.Popen[bytes]) -> None:
    """Until the process has written this file."""
    deadline = time.monotonic() + 120
    while not path.is_file():
        assert process.poll() is None, f"ended before it wrote {path}"
        assert time.monotonic() < deadline, f"no {path}"
        time.sleep(0.05)


def become(job: dict[str, Any]) -> None:
    """What the forked process does."""
    for number, stream in ((1, "out"), (2, "err")):
        file = os.open(job[stream], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, number)
        os.close(file)
    os.environ.clear()
    os.environ.update(job["environment"])
    os.chdir(job["cwd"])
    first, *rest = job["arguments"]
    if first == "-m":
        sys.argv = rest
        runpy.run_module(rest[0], run_name="__main__", alter_sys=True)
    else:
        sys.argv = [first, *rest]
        runpy.run_path(first, run_name="__main__")


def main() -> None:
    """Fork a command per line; a parent that has started no threads may."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    for name in HEAVY:
        importlib.import_module(name)
    write = importlib.import_module("xplanes.synthetic.demo.write")
    write.VIDEO_FRAMES = VIDEO_FRAMES
    compose_plain("train", [])  # Hydra's plugins and grammars.

    answers.write("ready\n")
    while line := sys.stdin.readline():
        child = os.fork()
        if not child:
            answers.close()
            become(json.loads(line))
            return
        answers.write(f"{child}\n")
        answers.write(f"{os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])}\n")


if __name__ == "__main__":
    main()
