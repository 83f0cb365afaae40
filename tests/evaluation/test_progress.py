"""Progress is silent when quick, plain when piped."""

import io

from xplanes.evaluation import progress as module
from xplanes.evaluation.progress import progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_short_waits_say_nothing():
    stream = io.StringIO()
    assert list(progress(range(5), 5, "views", stream)) == [0, 1, 2, 3, 4]
    assert stream.getvalue() == ""


def test_a_pipe_gets_plain_lines(monkeypatch):
    monkeypatch.setattr(module, "PATIENCE_SECONDS", 0.0)
    monkeypatch.setattr(module, "PIPED_SECONDS", 0.0)
    stream = io.StringIO()
    list(progress(range(3), 3, "views", stream))
    assert stream.getvalue() == "views 1/3  0:00 left\nviews 2/3  0:00 left\n"


def test_a_terminal_is_left_clean(monkeypatch):
    monkeypatch.setattr(module, "PATIENCE_SECONDS", 0.0)
    stream = Terminal()
    list(progress(range(3), 3, "views", stream))
    assert stream.getvalue().startswith("\rviews 1/3")
    assert stream.getvalue().endswith(" \r")
