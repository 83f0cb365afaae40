"""How OpenMP's threads are told to wait."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from xplanes.process import WAIT, waiting

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("own", [{"OMP_WAIT_POLICY": "ACTIVE"}, {"GOMP_SPINCOUNT": "0"}])
def test_a_users_own_setting_stands_alone(own):
    assert waiting({"HOME": "/", **own}) == {}
    assert waiting({"HOME": "/"}) == WAIT


@pytest.mark.parametrize(
    "command", [("train.py", "hydra.run.dir=run"), ("xplanes/__main__.py", "score-lrm", "tiny")]
)
def test_commands_set_it_before_torch_reads_it(command, tmp_path):
    code = f"""
import os, runpy, sys
class Watch:
    def find_spec(self, name, path=None, target=None):
        if name == "torch":
            print(os.environ["GOMP_SPINCOUNT"])
            sys.stdout.flush()
            os._exit(0)
sys.meta_path.insert(0, Watch())
sys.argv = {list(command)!r}
sys.path.insert(0, {str(ROOT)!r})
runpy.run_path({str(ROOT / command[0])!r}, run_name="__main__")
"""
    clean = {name: value for name, value in os.environ.items() if name not in WAIT}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, cwd=tmp_path, env=clean
    )
    assert done.stdout.split() == [WAIT["GOMP_SPINCOUNT"].encode()], done.stderr.decode()
