"""Processes of their own, where the process is what is tested."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

VIDEO_FRAMES = 16
"""Frames of a demo scene's video in tests."""


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


def python(
    *arguments: str, cwd: Path = ROOT, env: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """``python ARGUMENTS`` as a process of its own, to its good end."""
    whole = os.environ | dict(env or {})
    command = [sys.executable, *arguments]
    done = subprocess.run(command, cwd=cwd, env=whole, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done


def wait_for(path: Path, process: subprocess.Popen[bytes]) -> None:
    """Until the process has written this file."""
    deadline = time.monotonic() + 120
    while not path.is_file():
        assert process.poll() is None, f"ended before it wrote {path}"
        assert time.monotonic() < deadline, f"no {path}"
        time.sleep(0.05)
