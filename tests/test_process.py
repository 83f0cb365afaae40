"""What the environment tells OpenMP, oneDNN, and libraries that look for a home."""

import os
import platform
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

from tests.warm import ROOT
from xplanes.process import KEEP, NOWHERE, WAIT, defaults


@pytest.mark.parametrize("own", [{"OMP_WAIT_POLICY": "ACTIVE"}, {"GOMP_SPINCOUNT": "0"}])
def test_a_users_own_setting_stands_alone(own):
    assert defaults({"HOME": "/", **own}) == KEEP
    assert defaults({"HOME": "/"}) == WAIT | KEEP
    assert defaults(dict.fromkeys(KEEP, "7")) == WAIT


def test_who_has_no_home_gets_one_that_takes_no_folders(monkeypatch):
    problem = RuntimeError("Could not determine home directory.")
    monkeypatch.setattr(Path, "home", Mock(side_effect=problem))
    assert defaults({}) == WAIT | KEEP | NOWHERE
    with pytest.raises(OSError, match=NOWHERE["HOME"]):
        Path(NOWHERE["HOME"], ".cache").mkdir(parents=True)


@pytest.mark.parametrize(
    "command", [("train.py", "hydra.run.dir=run"), ("xplanes/__main__.py", "evaluate", "run")]
)
def test_commands_set_it_before_torch_reads_it(command, tmp_path):
    code = f"""
import os, runpy, sys
class Watch:
    def find_spec(self, name, path=None, target=None):
        if name == "torch":
            print(*(os.environ[name] for name in {sorted(WAIT | KEEP)!r}))
            sys.stdout.flush()
            os._exit(0)
sys.meta_path.insert(0, Watch())
sys.argv = {list(command)!r}
sys.path.insert(0, {str(ROOT)!r})
runpy.run_path({str(ROOT / command[0])!r}, run_name="__main__")
"""
    added = WAIT | KEEP
    clean = {name: value for name, value in os.environ.items() if name not in added}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, cwd=tmp_path, env=clean
    )
    printed = done.stdout.decode().split()
    assert printed == [added[name] for name in sorted(added)], done.stderr.decode()


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries are left alone")
def test_freed_memory_is_used_again():
    code = """
import ctypes, resource
from xplanes.process import keep_freed_memory
library = ctypes.CDLL(None)
library.malloc.restype = ctypes.c_void_p
def pages():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(8):
        block = ctypes.c_void_p(library.malloc(2**26))
        ctypes.memset(block, 1, 2**26)
        library.free(block)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
keep_freed_memory()
print(pages())
"""
    clean = {name: value for name, value in os.environ.items() if "MALLOC" not in name}

    def pages(**more: str) -> int:
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, capture_output=True, cwd=ROOT, env=clean | more, check=True)
        return int(done.stdout)

    assert 4 * pages() < pages(MALLOC_ARENA_MAX="8")  # Whose own variable leaves glibc as it is.
