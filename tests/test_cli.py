"""The command line after training: quick to ask, plain when something is wrong."""

import json
import sys
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import pytest

from tests import inside
from xplanes import cli
from xplanes.baselines.gaussians.rasteriser import GaussianError
from xplanes.cli import main
from xplanes.errors import DeviceError


def test_evaluate_as_a_program(trained_run, tmp_path):
    program = str(Path(cli.__file__).with_name("__main__.py"))
    assert main(["evaluate", str(trained_run), "--split", "val", "--checkpoint", "best"]) == 0
    done = inside.run(program, "evaluate", str(trained_run), "--lpips", "none", cwd=tmp_path)
    lines = done.stdout.splitlines()
    assert lines[0] == f"run         {trained_run}"
    assert lines[1].startswith("checkpoint  last.ckpt, step 40")
    scores = json.loads((trained_run / "evaluation_test.json").read_text())
    assert f"{scores['test']['psnr']:.2f}" in lines[-2]


def test_table(trained_run, tmp_path, capsys):
    assert main(["table", str(trained_run.parent), "--out", str(tmp_path)]) == 0
    assert capsys.readouterr().out == (tmp_path / "table.md").read_text()


def test_download_says_how_to_continue(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("xplanes.tools.download.download_dnerf", lambda root: root)
    assert main(["download", "dnerf", "--root", str(tmp_path)]) == 0
    assert f"data.root={tmp_path}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["evaluate", "{tmp}/missing"], "does not exist"),
        (["render", "{run}", "--time", "7"], "--time 7: must be sweep"),
        (["render", "{run}", "--out", "a.gif"], "a video must end in .webp"),
        (["table", "{tmp}"], "no runs in it"),
        (["view", "{run}", "--port", "70000"], "--port 70000"),
        (["sheet", "{run}", "--steps", "x"], "--steps x: must be numbers"),
    ],
)
def test_known_errors_are_one_line(arguments, words, trained_run, tmp_path, capsys):
    assert main([text.format(tmp=tmp_path, run=trained_run) for text in arguments]) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert words in error
    assert "Traceback" not in error


def test_a_disk_that_takes_nothing_is_said_before_anything_is_rendered(
    trained_run, tmp_path, monkeypatch, capsys
):
    never = Mock(side_effect=AssertionError("rendered first"))
    monkeypatch.setattr("xplanes.tools.render.render_path", never)
    (tmp_path / "file").write_text("in the way")
    target = tmp_path / "file" / "video.webp"
    assert main(["render", str(trained_run), "--out", str(target)]) == 1
    assert capsys.readouterr().err.startswith("error: ")


@pytest.mark.parametrize(
    ("module", "extra", "command", "options"),
    [
        ("viser", "viewer", "view", []),
        ("imageio_ffmpeg", "video", "render", ["--out", "video.mp4"]),
        ("skimage.measure", "export", "export", []),
        ("trimesh", "export", "export", ["--what", "web"]),
    ],
)
def test_a_missing_extra_is_named(
    module, extra, command, options, trained_run, monkeypatch, capsys
):
    monkeypatch.setitem(sys.modules, module, None)
    assert main([command, str(trained_run), *options]) == 1
    assert f'pip install -e ".[{extra}]"' in capsys.readouterr().err


def test_what_happens_while_rendering_is_one_line_unless_nobody_foresaw_it(
    trained_run, monkeypatch, capsys
):
    evaluate = partial(main, ["evaluate", str(trained_run)])
    for kind in (DeviceError, GaussianError, ZeroDivisionError):
        broken = Mock(side_effect=kind("what, and the way out"))
        monkeypatch.setattr("xplanes.tools.runs.load_run", broken)
        if kind is ZeroDivisionError:
            with pytest.raises(kind):
                evaluate()
        else:
            assert evaluate() == 1
            assert capsys.readouterr().err == "error: what, and the way out\n"


def test_the_view_ends_with_ctrl_c(trained_run, monkeypatch, capsys):
    pytest.importorskip("viser")
    monkeypatch.setattr("xplanes.tools.viewer.Viewer.run", Mock(side_effect=KeyboardInterrupt))
    assert main(["view", str(trained_run), "--port", "18090"]) == 0
    printed = capsys.readouterr().out
    assert "http://localhost:18090" in printed
    assert "ssh -L 18090:localhost:18090" in printed


def test_resume_is_a_verb_for_the_override(monkeypatch):
    given: list[list[str]] = []
    monkeypatch.setattr("xplanes.launch.train", lambda words, *_: given.append(list(words)))
    assert main(["resume", "runs/my run", "trainer.max_steps=9"]) == 0
    assert main(["resume", "outputs/a"]) == 0
    assert given == [["resume='runs/my run'", "trainer.max_steps=9"], ["resume=outputs/a"]]
    with pytest.raises(SystemExit):
        main(["resume"])
