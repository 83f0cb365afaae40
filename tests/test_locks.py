"""Two processes never write into one run directory."""

import pytest

from tests import warm
from xplanes.errors import ConfigError
from xplanes.locks import alone_in, in_turn

HOLD = """
import sys, time
from pathlib import Path
from xplanes.locks import alone_in
from xplanes.training.record import RunRecord
with alone_in(Path(sys.argv[1])):
    RunRecord(Path(sys.argv[1]), seed=0, resume=False)
    time.sleep(60)
"""


def test_a_second_process_is_refused_until_the_first_is_killed(tmp_path):
    script, run = tmp_path / "hold.py", tmp_path / "run"
    script.write_text(HOLD)
    holder = warm.start(str(script), str(run))
    try:
        warm.wait_for(run / "run.json", holder)
        with pytest.raises(ConfigError, match=f"in use by process {holder.pid}: wait"):
            alone_in(run).__enter__()
    finally:
        holder.kill()
    with alone_in(run):
        assert (run / ".lock").is_file()


def test_turns_are_free_when_nobody_holds_them(tmp_path):
    with in_turn(tmp_path / "a.lock") as waited:
        assert not waited
    with in_turn(None) as waited:
        assert not waited
