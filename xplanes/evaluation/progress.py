"""How far a loop is, for waits of more than two seconds."""

import sys
import time
from collections.abc import Iterable, Iterator
from typing import TextIO, TypeVar

Item = TypeVar("Item")

PATIENCE_SECONDS = 2.0
LIVE_SECONDS = 0.2
PIPED_SECONDS = 30.0


def progress(
    items: Iterable[Item], total: int, what: str, stream: TextIO | None = None
) -> Iterator[Item]:
    """Hand on ``items`` and say how many have passed, after two seconds.

    On a terminal one line is redrawn and taken away at the end; elsewhere a plain line appears
    every 30 s, without control codes.

    Args:
        items: What to hand on.
        total: How many there will be.
        what: Their name in the plural.
        stream: Where to write; standard error when None.
    """
    out: TextIO = sys.stderr if stream is None else stream
    live = out.isatty()
    began = time.monotonic()
    due = began + PATIENCE_SECONDS
    width = 0
    try:
        for done, item in enumerate(items, start=1):
            now = time.monotonic()
            if now >= due and done < total:
                left = (now - began) * (total - done) / done
                line = f"{what} {done}/{total}  {int(left) // 60}:{int(left) % 60:02d} left"
                out.write("\r" + line.ljust(width) if live else line + "\n")
                out.flush()
                width = len(line)
                due = now + (LIVE_SECONDS if live else PIPED_SECONDS)
            yield item
    finally:
        if live and width:
            out.write("\r" + " " * width + "\r")
            out.flush()
