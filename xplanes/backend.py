"""Which implementation of the inner loops a tensor gets."""

import functools
import importlib
import importlib.util
import logging
import os
from pathlib import Path
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


def loops_on_disk() -> bool:
    """Whether the compiled loops of an earlier process can be loaded instead of compiled."""
    folder = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(__file__).parent)
    return any(folder.rglob("cpu.gather-*.nbi"))


def name(device: torch.device) -> str:
    """Name of the inner loops on a device, for the header of a run."""
    return "compiled loops" if cpu_loops(torch.empty(0, device=device)) else "torch"
