"""Commands and benchmarks in this process, as if it were one of their own."""

import atexit
import contextlib
import importlib
import io
import logging
import os
import runpy
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hydra.core.singleton import Singleton

from tests.warm import ROOT


@contextlib.contextmanager
def restored() -> Iterator[None]:
    """Afterwards Hydra, loggers and the environment are as they were."""
    root, environment = logging.getLogger(), dict(os.environ)
    handlers, level, state = [*root.handlers], root.level, Singleton.get_state()
    try:
        yield
    finally:
        Singleton.set_state(state)
        root.handlers[:] = handlers
        root.setLevel(level)
        os.environ.clear()
        os.environ.update(environment)


@contextlib.contextmanager
def ending() -> Iterator[None]:
    """What xplanes leaves for the end of the process is done at the end of the block."""
    left: list[Callable[[], Any]] = []
    register, unregister = atexit.register, atexit.unregister

    def keep(function: Callable[..., Any], *given: Any, **named: Any) -> Any:
        if not (function.__module__ or "").startswith("xplanes."):
            return register(function, *given, **named)
        left.append(function)
        return function

    def forget(function: Callable[..., Any]) -> None:
        (left.remove if function in left else unregister)(function)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(atexit, "register", keep)
        patch.setattr(atexit, "unregister", forget)
        yield
        for function in reversed([*left]):
            function()


def train(*arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """``python train.py ARGUMENTS`` to its end, see `run`."""
    return run(str(ROOT / "train.py"), *arguments, **options)


def run(*arguments: str, cwd: Path = ROOT, code: int = 0) -> subprocess.CompletedProcess[str]:
    """``python ARGUMENTS``, of which the first is a script, to its end, with this exit status."""
    out, err, ended = io.StringIO(), io.StringIO(), 0
    with (
        restored(),
        contextlib.chdir(cwd),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        ending(),
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setattr(sys, "argv", [*arguments])
        try:
            runpy.run_path(arguments[0], run_name="__main__")
        except SystemExit as end:
            ended = end.code if isinstance(end.code, int) else int(end.code is not None)
            if isinstance(end.code, str):
                print(end.code, file=err)
    assert ended == code, err.getvalue()
    return subprocess.CompletedProcess(arguments, code, out.getvalue(), err.getvalue())


@contextlib.contextmanager
def benchmark(name: str) -> Iterator[Any]:
    """A module of ``benchmarks/``; afterwards it and those that it imported are forgotten."""
    folder, before = str(ROOT / "benchmarks"), {*sys.modules}
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        for variable, value in {"OMP_WAIT_POLICY": "PASSIVE", "OMP_NUM_THREADS": "1"}.items():
            patch.setenv(variable, value)  # So that importing changes none.
        yield importlib.import_module(name)
    for module in {*sys.modules} - before:
        if (getattr(sys.modules[module], "__file__", None) or "").startswith(folder):
            del sys.modules[module]
