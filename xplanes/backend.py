"""Which implementation of the inner loops a tensor gets."""

import functools
import importlib
import importlib.util
import logging
import os
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

logger = logging.getLogger(__name__)


@functools.cache
def numba_found() -> bool:
    """Whether the compiled CPU loops can be used; says so once where they cannot."""
    if importlib.util.find_spec("numba") is None:
        logger.warning(
            "numba is not installed: the CPU takes the plain torch path, several times slower. "
            "Install it with `pip install numba`."
        )
        return False
    return True


def cpu_loops(tensor: Tensor) -> bool:
    """Whether compiled CPU loops apply to ``tensor``: on the CPU, in float32 or float64."""
    return (
        tensor.device.type == "cpu"
        and tensor.dtype in (torch.float32, torch.float64)
        and os.environ.get("XPLANES_CPU_LOOPS", "1") != "0"
        and numba_found()
    )


@functools.cache
def triton_found() -> bool:
    """Whether triton is installed; says so once where it is not."""
    if importlib.util.find_spec("triton") is None:
        logger.warning(
            "triton is not installed: the GPU takes the plain torch path, which is slower. "
            "`pip install triton` brings it (torch for CUDA on Linux comes with it)."
        )
        return False
    return True


def gpu_kernels(tensor: Tensor) -> bool:
    """Whether Triton kernels apply to ``tensor``: on CUDA, where results may vary in the last bits.

    Which of several threads adds first to a gradient is chance, so the kernels stay out of runs
    that must be deterministic.
    """
    return (
        tensor.device.type == "cuda"
        and os.environ.get("XPLANES_GPU_KERNELS", "1") != "0"
        and not torch.are_deterministic_algorithms_enabled()
        and triton_found()
    )


def waves(device: torch.device, *shape: int) -> Tensor:
    """Numbers from -1 to 1 for a trial, which must leave all random generators alone."""
    count = torch.arange(torch.Size(shape).numel(), device=device, dtype=torch.float32)
    return count.mul(0.7).sin().view(shape)


def proven(
    what: str,
    kernels: Callable[[], Sequence[Tensor]],
    plain: Callable[[], Sequence[Tensor]],
    tolerance: float = 1e-4,
) -> bool:
    """Whether kernels compile, run and come to the numbers of their readable twin.

    Says so where they do not. Callers keep the answer: the trial compiles and waits for the device.

    Args:
        what: Name of the work, for the message.
        kernels: Runs them on a small input; returns values and gradients.
        plain: Runs the twin.
        tolerance: Largest difference, relative or absolute.
    """
    try:
        with torch.inference_mode(False), torch.enable_grad():
            for ours, theirs in zip(kernels(), plain(), strict=True):
                torch.testing.assert_close(
                    ours, theirs, atol=tolerance, rtol=tolerance, check_dtype=False
                )
    except Exception as error:
        # Whatever keeps a compiler from working is no reason to fail: there is another way.
        logger.warning(
            "the Triton kernels for %s are not used: %s: %s. Plain torch does the same, slower; "
            "XPLANES_GPU_KERNELS=0 hides this message.",
            what,
            type(error).__name__,
            str(error).strip().split("\n")[0] or "no reason given",
        )
        return False
    return True


def fast_bf16(device: torch.device) -> bool:
    """Whether a device multiplies bfloat16 matrices faster than float32 ones, in hardware."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    if device.type == "cpu":
        return torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
    return False


def compiled(module: str) -> Any:
    """A module of compiled loops; loading the first takes a second, compiling a few more, once."""
    _settle_threads()
    return importlib.import_module(module)


@functools.cache
def _settle_threads() -> None:
    """Start the loops' threads, as many as torch has, and leave torch's number as it is.

    Where both use OpenMP, starting them gives torch the number of all cores: what was asked for is
    lost, and sums come out otherwise before and after the first loop.
    """
    import numba

    count = torch.get_num_threads()
    numba.set_num_threads(min(count, numba.get_num_threads()))
    torch.set_num_threads(count)


def name(device: torch.device) -> str:
    """Name of the inner loops on a device, for the header of a run."""
    probe = torch.empty(0, device=device)
    if gpu_kernels(probe):
        return "Triton kernels"
    return "compiled loops" if cpu_loops(probe) else "torch"
