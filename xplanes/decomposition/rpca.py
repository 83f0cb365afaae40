"""Robust PCA: a matrix, or a triplane sequence, as a low-rank plus a sparse part."""

import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from xplanes.decomposition.admm import CHANGE_OVER_TOLERANCE, Progress, block_rows, minimise
from xplanes.fields.xplanes import SPACE_PLANES

METHODS = ("adaptive", "admm")
SCALES = ("rms", "none")


@dataclass(frozen=True)
class RobustPCA:
    """Result of `robust_pca` for a matrix Y.

    Attributes:
        low_rank: L, in float32 or float64. [M, T]
        sparse: S, of the same type. [M, T]
        rank: Rank of L.
        iterations: Iterations made.
        residual: ``|L + S - Y| / |Y|``, Frobenius norms, measured on the result.
        converged: Whether the tolerance was reached within the maximum number of iterations.
        change: Relative step size at the last check (see ``admm.Progress``). A small residual
            with a large change means that the split is feasible but not yet optimal.
        sparsity: Share of non-zero entries in S.
        low_rank_energy: ``|L|^2 / |Y|^2``.
        sparse_energy: ``|S|^2 / |Y|^2``.
        drift: ``|L - L(T/2)| / |L|`` with the middle column L(T/2): 0 if L is constant over time.
        sparsity_weight: The weight used.
        penalty: The final penalty, in units of ``1 / unit``.
        unit: Unit of Y for the penalty: its root mean square, or 1 with ``scale="none"``.
        method: The method used.
    """

    low_rank: Tensor
    sparse: Tensor
    rank: int
    iterations: int
    residual: float
    converged: bool
    change: float
    sparsity: float
    low_rank_energy: float
    sparse_energy: float
    drift: float
    sparsity_weight: float
    penalty: float
    unit: float
    method: str

    def report(self) -> dict[str, int | float | bool | str]:
        """All attributes except the two matrices, by name, as plain Python values."""
        names = [field.name for field in fields(self)]
        return {name: getattr(self, name) for name in names if name not in ("low_rank", "sparse")}


@torch.no_grad()
def robust_pca(
    matrix: Tensor,
    *,
    sparsity_weight: float | str = 0.009,
    penalty: float = 0.05,
    tolerance: float = 1e-4,
    max_iterations: int = 500,
    method: str = "adaptive",
    scale: str = "rms",
    progress: bool = True,
    out: tuple[Tensor, Tensor] | None = None,
) -> RobustPCA:
    """Split Y into L + S, minimising ``|L|_* + sparsity_weight |S|_1`` (X-Planes, Eq. 10-12).

    The paper prints a Frobenius norm for L, but its update (Eq. 24-25) is singular value
    thresholding, the proximal operator of the nuclear norm. The nuclear norm is minimised here.

    Both norms scale with Y, so the optimal weight does not depend on the scale of Y. The optimal
    penalty does: with ``scale="rms"``, ``penalty`` is divided by the root mean square of Y.
    "adaptive" always divides it and uses it only as the initial value.

    Memory use is the two results, each of the size of Y, and four cache-sized blocks. A matrix that
    is neither float32 nor float64, or not contiguous in rows or columns, is copied.

    Args:
        matrix: Y, of any floating-point type; not modified. Half precision is computed and returned
            in float32. [M, T]
        sparsity_weight: Weight of S, above 0; "auto" is ``1 / sqrt(max(M, T))`` (Candes et al.
            2011).
        penalty: Penalty of ADMM, above 0; the initial one for "adaptive".
        tolerance: Bound on ``|L + S - Y| / |Y|``, above 0; "adaptive" also requires a relative step
            below ten times this. float32 cannot reach much below 1e-6.
        max_iterations: Maximum number of iterations, at least 1. Warns if they do not reach the
            tolerance.
        method: "adaptive" (over-relaxed ADMM that balances the penalty between residual and change)
            or "admm" (the paper's Algorithm 1).
        scale: Unit of Y for the penalty: "rms" (root mean square) or "none" (1).
        progress: Show a progress bar after two seconds.
        out: Output tensors for L and S, with the computation type and layout of the matrix; new
            tensors when None. [M, T], [M, T]

    Raises:
        ValueError: If the matrix is not two-dimensional, is empty or holds NaN or infinity, or an
            option is out of range.
        TypeError: If the matrix is not of a floating-point type.
    """
    if isinstance(sparsity_weight, str) and sparsity_weight != "auto":
        raise ValueError(f"sparsity_weight is {sparsity_weight!r}: allowed are 'auto' or a number")
    numbers = {"sparsity_weight": sparsity_weight, "penalty": penalty, "tolerance": tolerance}
    for name, value in numbers.items():
        if not isinstance(value, str) and not 0 < value < math.inf:
            raise ValueError(f"{name} is {value}: it must be positive and finite")
    if max_iterations < 1:
        raise ValueError(f"max_iterations is {max_iterations}: it must be at least 1")
    for name, value, allowed in (("method", method, METHODS), ("scale", scale, SCALES)):
        if value not in allowed:
            raise ValueError(f"{name} is {value!r}: allowed are {', '.join(allowed)}")
    peak = _check_matrix(matrix)
    work = _computable(matrix.detach())
    weight = sparsity_weight
    if isinstance(weight, str):
        weight = 1 / math.sqrt(max(work.shape))
    low_rank, sparse = out or (_like(work), _like(work))
    adaptive, unit, factor = method == "adaptive", 1.0, 1.0
    if peak == 0:
        low_rank.zero_()
        sparse.zero_()
        end = Progress(0, 0, penalty, 0.0, 0.0)
    else:
        # Squares of extreme values overflow or underflow: take a copy scaled by a power of two.
        factor = 1.0 if 1e-12 < peak < 1e12 else 2.0 ** -math.frexp(peak)[1]
        if factor != 1:
            work = work * factor
        norm, root = _norm(work), math.sqrt(work.numel())
        unit = norm / root if scale == "rms" else factor
        with (
            _full_precision(work.device),
            tqdm(None, "robust PCA", max_iterations, False, delay=2, disable=not progress) as bar,
        ):

            def show(state: Progress) -> None:
                bar.set_postfix(residual=f"{state.residual:.0e}", rank=state.rank, refresh=False)
                bar.update()

            end = minimise(
                work,
                low_rank,
                sparse,
                sparsity_weight=weight,
                penalty=penalty * root / norm if adaptive else penalty / unit,
                adaptive=adaptive,
                tolerance=tolerance,
                max_iterations=max_iterations,
                on_iteration=show,
            )
    whole, low_energy, sparse_energy, gap, drift, count = _energies(work, low_rank, sparse)
    if factor != 1:
        low_rank /= factor
        sparse /= factor
    residual = math.sqrt(gap / whole) if whole else 0.0
    settled = not adaptive or end.change <= CHANGE_OVER_TOLERANCE * tolerance
    result = RobustPCA(
        low_rank=low_rank,
        sparse=sparse,
        rank=end.rank,
        iterations=end.iterations,
        residual=residual,
        converged=residual <= tolerance and settled,
        change=end.change,
        sparsity=count / matrix.numel(),
        low_rank_energy=low_energy / whole if whole else 0.0,
        sparse_energy=sparse_energy / whole if whole else 0.0,
        drift=math.sqrt(drift / low_energy) if low_energy else 0.0,
        sparsity_weight=weight,
        penalty=end.penalty * unit,
        unit=unit / factor,
        method=method,
    )
    if not result.converged:
        warnings.warn(
            f"robust PCA stopped at {end.iterations} iterations with residual "
            f"{result.residual:.1e} and step {result.change:.1e} (tolerance {tolerance:.1e}, ten "
            "times that for the step): raise max_iterations or tolerance",
            stacklevel=2,
        )
    return result


def _check_matrix(matrix: Tensor) -> float:
    if not matrix.is_floating_point():
        raise TypeError(f"robust_pca needs a floating-point matrix, not {matrix.dtype}")
    if matrix.dim() != 2 or not matrix.numel():
        raise ValueError(f"robust_pca needs a non-empty matrix [M, T], not {tuple(matrix.shape)}")
    low, high = torch.aminmax(matrix)
    peak = max(abs(low.item()), abs(high.item()))
    # Both checks fail for NaN.
    if not (math.isfinite(low.item()) and math.isfinite(high.item())):
        raise ValueError(
            "the input of robust_pca contains NaN or infinity: check the triplanes or features "
            f"(smallest value {low.item()}, largest {high.item()})"
        )
    return peak


def _computable(matrix: Tensor) -> Tensor:
    """The matrix itself if it can be read in place, else a copy."""
    rows, columns = matrix.shape
    if matrix.dtype not in (torch.float32, torch.float64):
        matrix = matrix.float()
    by_row = matrix.stride(1) == 1 and matrix.stride(0) >= columns
    by_column = matrix.stride(0) == 1 and matrix.stride(1) >= rows
    return matrix if by_row or by_column else matrix.contiguous()


def _like(matrix: Tensor) -> Tensor:
    rows, columns = matrix.shape
    if matrix.stride(0) == 1 and columns > 1:
        return matrix.new_empty(columns, rows).mT
    return matrix.new_empty(rows, columns)


def _norm(matrix: Tensor) -> float:
    return math.hypot(
        *(torch.linalg.vector_norm(b).item() for b in matrix.split(block_rows(matrix)))
    )


def _energies(matrix: Tensor, low_rank: Tensor, sparse: Tensor) -> list[float]:
    """Squared norms of Y, L, S, ``L + S - Y`` and ``L - L(T/2)``, and entries of S that are not 0.

    All in one pass.
    """
    middle = matrix.shape[1] // 2
    sums = torch.zeros(6, dtype=torch.float64, device=matrix.device)
    blocks = (part.split(block_rows(matrix)) for part in (matrix, low_rank, sparse))
    for y, low, part in zip(*blocks, strict=True):
        measured = (y, low, part, low + part - y, low - low[:, middle : middle + 1])
        for index, block in enumerate(measured):
            sums[index] += torch.linalg.vector_norm(block).double().square()
        sums[5] += part.count_nonzero()
    return sums.tolist()


@contextmanager
def _full_precision(device: torch.device) -> Iterator[None]:
    """Disable reduced-precision matrix products (TF32, bfloat16, autocast)."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")
    try:
        with torch.autocast(device.type, enabled=False):
            yield
    finally:
        torch.set_float32_matmul_precision(before)


@dataclass(frozen=True)
class Decomposition:
    """Low-rank and sparse parts of a triplane sequence, with reports of robust PCA.

    Attributes:
        low_rank: The static part. [T, 3, C, H, W]
        sparse: The dynamic part. [T, 3, C, H, W]
        reports: Output of `RobustPCA.report` for each of "xy", "xz" and "yz".
    """

    low_rank: Tensor
    sparse: Tensor
    reports: dict[str, dict[str, Any]]


def decompose(triplanes: Tensor, **options: Any) -> Decomposition:
    """Apply robust PCA to each orientation, with one column per frame (X-Planes, Eq. 8-12).

    The columns are read in place. The tensor is copied only if it has half precision or its planes
    are not contiguous.

    Args:
        triplanes: One triplane per frame: planes xy, xz, yz, the first axis along W. Any
            floating-point type; not modified. [T, 3, C, H, W]
        **options: Options of `robust_pca` except ``out``.

    Raises:
        ValueError: If the shape is wrong, a value is NaN or infinite, or an option is out of range.
        TypeError: If the tensor is not of a floating-point type.
    """
    check_triplanes(triplanes, "triplanes")
    kind = triplanes.dtype if triplanes.dtype == torch.float64 else torch.float32
    low_rank = torch.empty(triplanes.shape, dtype=kind, device=triplanes.device)
    sparse = torch.empty_like(low_rank)
    reports = {}
    for index, name in enumerate(SPACE_PLANES):
        parts = low_rank[:, index].flatten(1).mT, sparse[:, index].flatten(1).mT
        matrix = triplanes[:, index].flatten(1).mT
        reports[name] = robust_pca(matrix, out=parts, **options).report()
    return Decomposition(low_rank, sparse, reports)


def check_triplanes(triplanes: Tensor, name: str) -> None:
    """Check that a tensor is a non-empty triplane sequence.

    Args:
        triplanes: The tensor. [T, 3, C, H, W]
        name: Its name in error messages.

    Raises:
        ValueError: For a wrong shape.
    """
    if triplanes.dim() != 5 or triplanes.shape[1] != 3 or not triplanes.numel():
        raise ValueError(
            f"{name} must be [T, 3, C, H, W] and not empty, not {tuple(triplanes.shape)}"
        )
