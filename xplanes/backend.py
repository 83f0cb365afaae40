"""Which implementation of the inner loops a tensor gets."""

import atexit
import functools
import importlib
import importlib.util
import logging
import math
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from xplanes.errors import DeviceError
from xplanes.files import require_writable

logger = logging.getLogger(__name__)

COMPILING = 15
"""Seconds that numba takes to compile the loops of training and rendering."""


@dataclass
class WarmUp:
    """The time that loops took to load and compile, which no stage of a run includes.

    Attributes:
        seconds: Since the process began.
    """

    seconds: float = 0.0
    _inside: bool = False

    @contextmanager
    def timed(self) -> Iterator[None]:
        """Count the time of the block; nested blocks count once."""
        if self._inside:
            yield
            return
        began, self._inside = time.perf_counter(), True
        try:
            yield
        finally:
            self.seconds += time.perf_counter() - began
            self._inside = False


warm_up = WarmUp()


@functools.cache
def _found(package: str, consequence: str) -> bool:
    """Whether a package can be imported; logs the consequence once if not."""
    if importlib.util.find_spec(package) is None:
        logger.warning("%s is not installed: %s", package, consequence)
        return False
    try:
        with warm_up.timed():
            importlib.import_module(package)
    except Exception as error:
        # An installed package may still fail, if another is too new or too old for it.
        reason = str(error).strip().split("\n")[0]
        logger.warning("%s cannot be imported (%s): %s", package, reason, consequence)
        return False
    return True


def numba_found() -> bool:
    """Whether the compiled CPU loops can be used; logs once if not."""
    return _found(
        "numba",
        "the CPU takes the plain torch path, several times slower. "
        "`pip install --upgrade numba` brings what is needed.",
    )


def cpu_loops(tensor: Tensor) -> bool:
    """Whether compiled CPU loops apply to ``tensor``: on the CPU, in float32 or float64."""
    return (
        tensor.device.type == "cpu"
        and tensor.dtype in (torch.float32, torch.float64)
        and os.environ.get("XPLANES_CPU_LOOPS", "1") != "0"
        and numba_found()
    )


def triton_found() -> bool:
    """Whether triton is installed; logs once if not."""
    _settle_triton()
    return _found(
        "triton",
        "the GPU takes the plain torch path, which is slower. "
        "`pip install --upgrade triton` brings it (torch for CUDA on Linux comes with it).",
    )


@functools.cache
def _settle_triton() -> None:
    """Give triton a temporary folder for compiled kernels if it cannot write to its own."""
    home = os.environ.get("TRITON_HOME") or "~"
    folder = os.environ.get("TRITON_CACHE_DIR") or f"{home}/.triton/cache"
    try:
        require_writable(Path(folder).expanduser())
    except (OSError, RuntimeError):  # The latter where the user has no home.
        own = tempfile.mkdtemp(prefix="xplanes_triton_")
        atexit.register(shutil.rmtree, own, ignore_errors=True)
        os.environ["TRITON_CACHE_DIR"] = own
        logger.warning(
            "triton cannot write to %s: the GPU's kernels are compiled again at every start, which "
            "takes some seconds each. TRITON_CACHE_DIR=FOLDER keeps them in FOLDER",
            folder,
        )


def gpu_kernels(tensor: Tensor) -> bool:
    """Whether Triton kernels apply to ``tensor``: on CUDA, where results are not bit-identical.

    The order in which threads add to a gradient varies, so deterministic runs do not use them.
    """
    return (
        tensor.device.type == "cuda"
        and os.environ.get("XPLANES_GPU_KERNELS", "1") != "0"
        and not torch.are_deterministic_algorithms_enabled()
        and triton_found()
    )


def waves(device: torch.device, *shape: int) -> Tensor:
    """Numbers from -1 to 1 for a trial that leaves all random generators alone."""
    count = torch.arange(torch.Size(shape).numel(), device=device, dtype=torch.float32)
    return count.mul(0.7).sin().view(shape)


_refused: set[str] = set()
"""Work whose Triton kernels failed their trial."""


def proven(
    what: str,
    device: torch.device,
    attempt: Callable[[Callable[..., Any], torch.dtype], Sequence[Tensor]],
    kernels: Callable[..., Any],
    plain: Callable[..., Any],
    dtype: torch.dtype,
) -> bool:
    """Whether kernels compile, run and agree with their readable twin; logs if not.

    Callers keep the answer: the trial compiles and waits for the device.

    Args:
        what: Name of the work, for the message.
        device: Where they are tried.
        attempt: Runs one of them on a small input of some precision; returns values and gradients.
        kernels: What is tried.
        plain: Its twin.
        dtype: Type of the planes; the twin computes in float32 at least.

    Raises:
        DeviceError: If the device no longer responds.
    """
    exact = torch.promote_types(dtype, torch.float32)
    tolerance = 1e-4 if dtype == exact else 0.05
    try:
        with torch.inference_mode(False), torch.enable_grad():
            pairs = zip(attempt(kernels, dtype), attempt(plain, exact), strict=True)
            for ours, theirs in pairs:
                torch.testing.assert_close(
                    ours.to(exact), theirs, atol=tolerance, rtol=tolerance, check_dtype=False
                )
    except Exception as error:
        # No failure of a compiler ends the run: torch does the same.
        reason = str(error).strip().split("\n")[0] or "no reason given"
        reason = f"{type(error).__name__}: {reason}"
        _require_alive(device, what, reason)
        logger.warning(
            "the Triton kernels for %s are not used: %s. Plain torch does the same, slower; "
            "XPLANES_GPU_KERNELS=0 hides this message.",
            *(what, reason),
        )
        _refused.add(what)
        return False
    return True


def _require_alive(device: torch.device, what: str, reason: str) -> None:
    """Refuse to continue on a GPU whose context a kernel has destroyed."""
    try:
        synchronize(device)
    except Exception as error:
        raise DeviceError(
            f"{device}: the GPU stopped answering in a trial of the Triton kernels for {what} "
            f"({reason}). Start again with XPLANES_GPU_KERNELS=0, which leaves them out"
        ) from error


def memory_left(device: torch.device) -> float:
    """Bytes that a GPU has left; no limit is known for other devices."""
    return torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else math.inf


def fast_bf16(device: torch.device) -> bool:
    """Whether a device multiplies bfloat16 matrices faster than float32 ones, in hardware."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    if device.type == "cpu":
        return torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
    return False


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit` that keeps what it compiles, wherever it finds a folder for that.

    Args:
        options: As for `numba.njit`; ``cache`` is settled here.
    """
    numba = importlib.import_module("numba")

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(cache=True, **options)(function)
        except RuntimeError:  # A container may leave no folder that can be written.
            _say_not_kept()
            return numba.njit(**options)(function)

    return decorate


@functools.cache
def _say_not_kept() -> None:
    logger.warning(
        "numba finds no folder that it can write to: the inner loops are compiled again at every "
        "start, which takes about %d s. NUMBA_CACHE_DIR=FOLDER keeps them in FOLDER",
        COMPILING,
    )


def compiled(module: str) -> Any:
    """A module of compiled loops; loading the first takes a second, compiling a few more, once."""
    _settle_threads()
    return importlib.import_module(module)


def gpu_module(module: str) -> Any:
    """A module of Triton kernels, which need no numba."""
    return importlib.import_module(module)


def synchronize(device: torch.device) -> None:
    """Wait until a device has finished its work; the CPU always has."""
    if device.type != "cpu":
        torch.get_device_module(device).synchronize(device)


@functools.cache
def _settle_threads() -> None:
    """Start the loops' threads, as many as torch has, and leave torch's number as it is.

    If both use OpenMP, starting them sets torch's number to that of all cores, against the user's
    choice, and sums would differ before and after the first loop.
    """
    count = torch.get_num_threads()
    importlib.import_module("numba")
    use_threads(count)


def use_threads(count: int) -> None:
    """Let torch and the compiled loops, if they are loaded, share work among ``count`` threads."""
    if numba := sys.modules.get("numba"):
        numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))
    if torch.get_num_threads() != count:  # Setting it, torch makes a pool of threads again.
        torch.set_num_threads(count)


@contextmanager
def threads(count: int) -> Iterator[None]:
    """`use_threads` for the time of the block."""
    before = torch.get_num_threads()
    use_threads(count)
    try:
        yield
    finally:
        use_threads(before)


def name(device: torch.device) -> str:
    """Name of the inner loops on a device, with the kernels that failed their trial so far."""
    probe = torch.empty(0, device=device)
    if gpu_kernels(probe):
        failed = f" (torch for {', '.join(sorted(_refused))})" if _refused else ""
        return f"Triton kernels{failed}"
    return "compiled loops" if cpu_loops(probe) else "torch"
