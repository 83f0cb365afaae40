"""Refusals in a loop: the bad value shows in the report, which `pytest.raises` leaves out."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any


class Evil:
    """Runs code when it is unpickled, which shows in what is printed."""

    def __reduce__(self):
        return print, ("code was run",)


def interrupt(*_args: Any, **_options: Any) -> None:
    """Takes the place of a function during which Ctrl-C is pressed."""
    raise KeyboardInterrupt


def flip(path: Path, place: int) -> None:
    """Flip one bit of a file, which keeps its size."""
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)


def assert_refused(
    error: type[Exception], words: str, call: Callable[[], Any], case: object
) -> str:
    """A call raises an error whose message holds the words. Returns the message."""
    try:
        call()
    except error as raised:
        message = str(raised)
    else:
        raise AssertionError(f"{case} is not refused")
    assert re.search(words, message), f"{case} is refused with {message!r}, not with {words!r}"
    return message
