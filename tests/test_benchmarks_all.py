"""Which results are stale."""

import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parent.parent / "benchmarks"


@pytest.fixture
def every(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.setenv("OMP_WAIT_POLICY", "PASSIVE")
    yield importlib.import_module("all")
    for name in ("all", "runner"):
        sys.modules.pop(name, None)


def test_only_code_and_settings_make_a_result_stale(every, tmp_path):
    code, settings = tmp_path / "code.py", tmp_path / "settings.yaml"

    def digest(text: str, values: str) -> str:
        code.write_text(text)
        settings.write_text(values)
        return every.digest([code, settings])

    first = digest('"""Words."""\ndef f(x):\n    """More."""\n    return 2 * x\n', "a: 1  # One.\n")
    words = digest("# Others.\ndef f( x ):\n    return (2*x)\n", "# Else.\n\na: 1\n")
    assert words == first
    for text, values in (
        ("def f(x):\n    return 3 * x\n", "a: 1\n"),
        ("def f(x):\n    return 2 * x\n", "a: 2\n"),
    ):
        assert digest(text, values) != first


def test_what_has_changed_is_said(every):
    now = {"version": "2", "machine": "big", "parts": {"xplanes/lrm": "a", "conf": "b"}}
    assert every.why_stale(now, None) == "not recorded"
    assert every.why_stale(now, dict(now)) == ""
    then = {"version": "1", "machine": "small", "parts": {"xplanes/lrm": "a", "conf": "c"}}
    assert every.why_stale(now, then) == "made with 1; made on small; changed since: conf"
    assert "conf" in every.why_stale(now, {**now, "parts": {"xplanes/lrm": "a"}})
    assert every.kind_of("1 of 2 cores, small") == every.kind_of("2 cores, small")
    cores = {**now, "machine": "2 cores, small"}
    assert every.why_stale(cores, {**cores, "machine": "1 of 2 cores, small"}) == ""
    assert every.why_stale(cores, {**cores, "machine": "1 of 4 cores, small"}) != ""


def test_printed_commands_name_no_folder(every):
    words = ["--lego", "/there/lego", "data.root=/there", "data.scene=lego", "--seeds", "3"]
    printed = ["--lego", "FOLDER", "data.root=FOLDER", "data.scene=lego", "--seeds", "3"]
    assert sys.modules["runner"].without_folders(words) == printed


def test_every_part_and_script_exists(every):
    for name, parts in every.PARTS.items():
        assert (FOLDER / f"{name}.py").is_file(), name
        for part in parts:
            assert (FOLDER.parent / part).is_dir(), part
    assert list(every.scripts(Path("lego"))) == list(every.PARTS)


def test_what_is_made_is_recorded_and_what_fails_is_not(every, tmp_path, monkeypatch, capsys):
    ran = []
    monkeypatch.chdir(tmp_path)

    def execute(line: list[str], check: bool) -> subprocess.CompletedProcess:
        ran.append(Path(line[1]).stem)
        (every.WORK / ran[-1] / "run").touch()
        return subprocess.CompletedProcess(line, int(ran[-1] == "stages"))

    monkeypatch.setattr(every, "MADE", tmp_path / "made.json")
    monkeypatch.setattr(every, "machine", lambda: "this one")
    monkeypatch.setattr(every.subprocess, "run", execute)
    monkeypatch.setattr(sys, "argv", ["all.py", "--only", "stages", "ray_drawing"])
    assert every.main() == 1
    assert ran == ["ray_drawing", "stages"]
    assert list(json.loads((tmp_path / "made.json").read_text())) == ["ray_drawing"]
    # What a finished script kept is gone; one that failed goes on with it, unless code changed.
    assert not (every.WORK / "ray_drawing").exists()
    kept = every.WORK / "stages" / "run"
    every.keep_runs_of(every.state_of("stages"), kept.parent)
    assert kept.is_file()
    every.keep_runs_of({**every.state_of("stages"), "version": "0"}, kept.parent)
    assert not kept.exists()
    capsys.readouterr()
    monkeypatch.setattr(sys, "argv", ["all.py", "--list"])
    assert every.main() == 0
    listed = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert listed["ray_drawing"] == "up to date"
    assert listed["stages"] == "not recorded"
    assert ran == ["ray_drawing", "stages"]
