"""Chooses the implementation of the inner loops: numba, Triton or PyTorch."""

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

from xplanes.errors import ConfigError, DeviceError
from xplanes.files import require_writable

logger = logging.getLogger(__name__)

COMPILING = 20
"""Seconds that numba takes to compile the loops of training and rendering."""


@dataclass
class WarmUp:
    """Time spent loading and compiling the inner loops; the stages of a run exclude it.

    Attributes:
        seconds: Total in this process.
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


CONSEQUENCES = {
    "numba": "PyTorch computes the same on the CPU, several times more slowly. "
    "To install it: `pip install --upgrade numba`.",
    "triton": "PyTorch computes the same on the GPU, more slowly. "
    "To install it: `pip install --upgrade triton` (PyTorch for CUDA on Linux includes it).",
}
"""Effect of a missing package, and the remedy."""


@functools.cache
def _found(package: str) -> bool:
    """Whether a package can be imported; logs the consequence once if not."""
    consequence = CONSEQUENCES[package]
    if importlib.util.find_spec(package) is None:
        logger.warning("%s is not installed: %s", package, consequence)
        return False
    try:
        with warm_up.timed():
            importlib.import_module(package)
    except Exception as error:
        # The import can fail if another package has an incompatible version.
        reason = str(error).strip().split("\n")[0]
        logger.warning("%s cannot be imported (%s): %s", package, reason, consequence)
        return False
    return True


def cpu_loops(tensor: Tensor) -> bool:
    """Whether compiled CPU loops apply to ``tensor``: on the CPU, in float32 or float64."""
    return (
        tensor.device.type == "cpu"
        and tensor.dtype in (torch.float32, torch.float64)
        and os.environ.get("XPLANES_CPU_LOOPS", "1") != "0"
        and _found("numba")
    )


@functools.cache
def _settle_triton() -> None:
    """Give triton a temporary folder for compiled kernels if it cannot write to its own."""
    home = os.environ.get("TRITON_HOME") or "~"
    folder = os.environ.get("TRITON_CACHE_DIR") or f"{home}/.triton/cache"
    try:
        require_writable(Path(folder).expanduser())
    except (OSError, RuntimeError):  # RuntimeError: the user has no home directory.
        own = tempfile.mkdtemp(prefix="xplanes_triton_")
        atexit.register(shutil.rmtree, own, ignore_errors=True)
        os.environ["TRITON_CACHE_DIR"] = own
        logger.warning(
            "triton cannot write to %s: each GPU kernel is compiled again at every start, which "
            "takes some seconds. TRITON_CACHE_DIR=FOLDER keeps them in FOLDER",
            folder,
        )


def gpu_kernels(tensor: Tensor) -> bool:
    """Whether Triton kernels apply to ``tensor``: on CUDA, unless the run must be deterministic.

    Threads add to a gradient in varying order, so results are not bit-identical.
    """
    if (
        tensor.device.type != "cuda"
        or os.environ.get("XPLANES_GPU_KERNELS", "1") == "0"
        or torch.are_deterministic_algorithms_enabled()
    ):
        return False
    _settle_triton()
    return _found("triton")


def in_group() -> bool:
    """Whether this process trains together with others, which must stay consistent."""
    return torch.distributed.is_available() and torch.distributed.is_initialized()


def waves(device: torch.device, *shape: int) -> Tensor:
    """Test input from -1 to 1, made without any random generator."""
    count = torch.arange(torch.Size(shape).numel(), device=device, dtype=torch.float32)
    return count.mul(0.7).sin().view(shape)


_refused: set[str] = set()
"""Operations whose Triton kernels failed their trial."""


def proven(
    what: str,
    device: torch.device,
    attempt: Callable[[Callable[..., Any], torch.dtype], Sequence[Tensor]],
    kernels: Callable[..., Any],
    reference: Callable[..., Any],
    dtype: torch.dtype,
) -> bool:
    """Whether kernels compile, run and agree with their reference implementation; logs if not.

    Callers cache the result: the trial compiles the kernels and waits for the device.

    Args:
        what: Name of the operation, for the message.
        device: Device of the trial.
        attempt: Calls a function on a small input of a dtype; returns values and gradients.
        kernels: The kernels on trial.
        reference: The reference implementation.
        dtype: Dtype of the planes; the reference computes in float32 or higher.

    Raises:
        DeviceError: If the device no longer responds.
    """
    exact = torch.promote_types(dtype, torch.float32)
    tolerance = 1e-4 if dtype == exact else 0.05
    try:
        with torch.inference_mode(False), torch.enable_grad():
            pairs = zip(attempt(kernels, dtype), attempt(reference, exact), strict=True)
            for ours, theirs in pairs:
                torch.testing.assert_close(
                    ours.to(exact), theirs, atol=tolerance, rtol=tolerance, check_dtype=False
                )
    except Exception as error:
        # The run continues with the PyTorch implementation.
        reason = str(error).strip().split("\n")[0] or "no reason given"
        reason = f"{type(error).__name__}: {reason}"
        _require_alive(device, what, reason)
        logger.warning(
            "the Triton kernels for %s are not used: %s. PyTorch computes the same, more slowly; "
            "XPLANES_GPU_KERNELS=0 hides this message.",
            what,
            reason,
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
            f"{device}: the GPU stopped responding in a trial of the Triton kernels for {what} "
            f"({reason}). Start again with XPLANES_GPU_KERNELS=0, which disables them"
        ) from error


def find_device(accelerator: str) -> torch.device:
    """The device of ``trainer.accelerator``; auto: a CUDA GPU if there is one, else the CPU.

    Raises:
        ConfigError: If a GPU is requested but not found, or for another accelerator.
    """
    if accelerator not in ("auto", "cpu", "gpu", "cuda"):
        raise ConfigError(f"accelerator={accelerator}: must be one of auto, cpu, gpu")
    if accelerator in ("gpu", "cuda") and not torch.cuda.is_available():
        raise ConfigError(
            f"accelerator={accelerator}: no GPU found; set trainer.accelerator=cpu or auto"
        )
    if accelerator == "cpu" or not torch.cuda.is_available():
        return torch.device("cpu")
    return torch.device("cuda")


def memory_left(device: torch.device) -> float:
    """Free memory of a GPU in bytes; infinite for other devices."""
    return torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else math.inf


def fast_bf16(device: torch.device) -> bool:
    """Whether a device multiplies bfloat16 matrices faster than float32 ones, in hardware."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    if device.type == "cpu":
        return torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
    return False


def njit(*, exact: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit` with an on-disk cache if numba finds a writable folder.

    Args:
        exact: Whether results must equal those of other code: no fused multiply-add, which rounds
            differently.
        options: As for `numba.njit`.
    """
    numba = importlib.import_module("numba")
    fastmath = False if exact else {"contract"}
    options = {"nogil": True, "error_model": "numpy", "fastmath": fastmath} | options

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(cache=True, **options)(function)
        except RuntimeError:  # A container may have no writable folder.
            _warn_not_cached()
            return numba.njit(**options)(function)

    return decorate


@functools.cache
def _warn_not_cached() -> None:
    logger.warning(
        "numba finds no folder that it can write to: the inner loops are compiled again at every "
        "start, which takes about %d s. NUMBA_CACHE_DIR=FOLDER keeps them in FOLDER",
        COMPILING,
    )


def compiled(module: str) -> Any:
    """Import numba loops, which compile on first use; the first import takes about a second."""
    _start_threads()
    return importlib.import_module(module)


def synchronize(device: torch.device) -> None:
    """Wait until a device has finished its work; returns at once for the CPU."""
    if device.type != "cpu":
        torch.get_device_module(device).synchronize(device)


@functools.cache
def _start_threads() -> None:
    """Start numba with PyTorch's number of threads, and keep PyTorch's number unchanged.

    If both use OpenMP, starting numba's threads resets PyTorch's number to all cores, against the
    user's choice. Sums before and after the first loop would then differ.
    """
    count = torch.get_num_threads()
    importlib.import_module("numba")
    use_threads(count)


def use_threads(count: int) -> None:
    """Use ``count`` threads in PyTorch and, if they are loaded, in the compiled loops."""
    if numba := sys.modules.get("numba"):
        numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))
    if torch.get_num_threads() != count:  # Setting it recreates PyTorch's thread pool.
        torch.set_num_threads(count)


@contextmanager
def threads(count: int) -> Iterator[None]:
    """`use_threads` within the block."""
    before = torch.get_num_threads()
    use_threads(count)
    try:
        yield
    finally:
        use_threads(before)


def name(device: torch.device) -> str:
    """Implementation of the inner loops on a device, and kernels that failed their trial."""
    probe = torch.empty(0, device=device)
    if gpu_kernels(probe):
        failed = f" (torch for {', '.join(sorted(_refused))})" if _refused else ""
        return f"Triton kernels{failed}"
    return "compiled loops" if cpu_loops(probe) else "torch"
