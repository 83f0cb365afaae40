"""First calls of the inner loops, which load and compile them."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import torch

from xplanes.backend import COMPILING, warm_up
from xplanes.rendering.base import RayRenderer
from xplanes.rendering.box import Field

PATIENCE = 3.0
"""Seconds of warming up after which the user is told what takes so long."""


@cache
def say_why() -> None:
    """Once in a process, though loops are warmed up at several places."""
    print(f"compiling the inner loops: about {COMPILING} s ...", flush=True)


@contextmanager
def warming_up() -> Iterator[None]:
    """Count what is done inside as warming up, and say so where it takes long."""
    notice = threading.Timer(PATIENCE, say_why)
    notice.start()
    try:
        with warm_up.timed():
            yield
    finally:
        notice.cancel()


@torch.no_grad()
def render_one_ray(field: Field, renderer: RayRenderer) -> None:
    """Render a ray from the middle of the cube, as a first call of all that pictures need."""
    with warming_up():
        device = renderer.device
        origin, direction = torch.zeros(1, 3, device=device), torch.eye(3, device=device)[:1]
        renderer.render(
            field, origin, direction, origin[:, 0], background=torch.ones(3, device=device)
        )
