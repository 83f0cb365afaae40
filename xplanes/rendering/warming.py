"""Warm-up of the inner loops: their first calls load and compile them."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import torch

from xplanes.backend import COMPILING, warm_up
from xplanes.rendering.base import RayRenderer
from xplanes.rendering.box import Field

PATIENCE = 3.0
"""Seconds of warm-up after which a message explains the delay."""


@cache
def say_why() -> None:
    """Print the message once per process."""
    print(f"loading the inner loops; compiling them takes about {COMPILING} s ...", flush=True)


@contextmanager
def warming_up() -> Iterator[None]:
    """Count the block as warm-up, and print a message if it takes long."""
    notice = threading.Timer(PATIENCE, say_why)
    notice.start()
    try:
        with warm_up.timed():
            yield
    finally:
        notice.cancel()


@torch.no_grad()
def render_one_ray(field: Field, renderer: RayRenderer) -> None:
    """Render a ray from the centre of the cube, to load and compile all loops for images."""
    with warming_up():
        device = renderer.device
        origin, direction = torch.zeros(1, 3, device=device), torch.eye(3, device=device)[:1]
        renderer.render(
            field, origin, direction, origin[:, 0], background=torch.ones(3, device=device)
        )
