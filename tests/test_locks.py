"""Two processes never write into one run directory."""

import subprocess
import sys

import pytest

from xplanes.errors import ConfigError
from xplanes.locks import alone_in, in_turn

HOLD = """
import sys, time
from pathlib import Path
from xplanes.locks import alone_in
from xplanes.training.record import RunRecord
with alone_in(Path(sys.argv[1])):
    RunRecord(Path(sys.argv[1]), seed=0, resume=False)
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_second_process_is_refused_until_the_first_is_killed(tmp_path):
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    assert holder.stdout is not None
    assert holder.stdout.readline() == "held\n"
    try:
        with pytest.raises(ConfigError, match=f"in use by process {holder.pid}: wait"):
            alone_in(tmp_path).__enter__()
    finally:
        holder.kill()
        holder.wait()
    with alone_in(tmp_path):
        assert (tmp_path / ".lock").is_file()


def test_turns_are_free_when_nobody_holds_them(tmp_path):
    with in_turn(tmp_path / "a.lock") as waited:
        assert not waited
    with in_turn(None) as waited:
        assert not waited
