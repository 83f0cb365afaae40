import functools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rpca_oracle import objective, oracle, plain_admm, relative

from tests.refusals import assert_refused
from xplanes.decomposition import robust_pca


def mixture(rows=400, columns=12, rank=2, noise=0.01, share=0.05, seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    low = draw(rows, rank) @ draw(rank, columns) / rank**0.5
    hit = torch.rand(rows, columns, generator=generator) < share
    return (low + hit * 3 * draw(rows, columns) + noise * draw(rows, columns)).to(dtype)


@functools.cache
def solved(weight):
    """A matrix, and its low-rank and its sparse part as the oracle finds them."""
    matrix = mixture()
    return matrix, *oracle(matrix, weight)


@pytest.mark.parametrize(
    ("weight", "method"), [(0.02, "adaptive"), (0.05, "adaptive"), (0.2, "adaptive"), (0.2, "admm")]
)
def test_agrees_with_the_oracle(weight, method):
    matrix, low, sparse = solved(weight)
    options = {"tolerance": 1e-7, "max_iterations": 3000, "method": method}
    result = robust_pca(matrix, sparsity_weight=weight, **options)
    assert result.converged
    assert relative(result.low_rank, low) < 1e-4
    assert relative(result.sparse, sparse) < 1e-3
    best = objective(low, matrix, weight)
    assert abs(objective(result.low_rank, matrix, weight) / best - 1) < 1e-5


@pytest.mark.filterwarnings("ignore:.*raise max_iterations")
def test_the_fused_passes_repeat_the_plain_iteration():
    matrix = mixture()
    options = {"sparsity_weight": 0.05, "penalty": 0.1, "tolerance": 1e-15, "max_iterations": 9}
    fused = robust_pca(matrix, method="admm", scale="none", **options)
    low, sparse, rank = plain_admm(matrix, weight=0.05, penalty=0.1, iterations=9)
    assert torch.allclose(low, fused.low_rank, atol=1e-9)
    assert torch.allclose(sparse, fused.sparse, atol=1e-9)
    assert rank == fused.rank


@pytest.mark.parametrize("columns", [30, 120])
def test_several_blocks_and_both_layouts_give_the_same(monkeypatch, columns):
    matrix = mixture(rows=300, columns=columns)
    solve = functools.partial(robust_pca, sparsity_weight="auto", tolerance=0.02)
    whole = solve(matrix)
    monkeypatch.setattr("xplanes.decomposition.admm.block_rows", lambda _: 96)
    for other in (solve(matrix), solve(matrix.mT.contiguous().mT)):
        assert torch.allclose(whole.low_rank, other.low_rank, atol=1e-7)
        assert torch.allclose(whole.sparse, other.sparse, atol=1e-7)


@pytest.mark.parametrize("rank", [1, 5, 10])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_recovers_low_rank_plus_sparse(rank, dtype):
    generator = torch.Generator().manual_seed(rank)
    left, right = (torch.randn(size, rank, generator=generator) for size in (800, 80))
    low = left @ right.mT
    hit = torch.rand(low.shape, generator=generator) < 0.05
    sparse = hit * 10.0 * torch.randn(low.shape, generator=generator).sign()
    result = robust_pca((low + sparse).to(dtype), sparsity_weight="auto", tolerance=1e-5)
    assert result.converged
    assert result.rank == rank
    assert relative(result.low_rank, low.double().numpy()) < 1e-4
    assert relative(result.sparse, sparse.double().numpy()) < 1e-4


def test_every_scale_has_the_same_answer():
    matrix = mixture(dtype=torch.float32)
    unit = robust_pca(matrix, sparsity_weight=0.05)
    for exponent in [-25, -6, 6, 25]:
        scaled = robust_pca(matrix * 10.0**exponent, sparsity_weight=0.05)
        assert scaled.iterations == unit.iterations, exponent
        assert scaled.rank == unit.rank, exponent
        assert scaled.converged, exponent
        back = scaled.low_rank.double() / 10.0**exponent
        assert relative(back, unit.low_rank.double().numpy()) < 1e-5, exponent
        assert scaled.unit == pytest.approx(unit.unit * 10.0**exponent, rel=1e-5), exponent


def test_an_absolute_penalty_depends_on_the_scale():
    matrix = mixture()
    options = {"method": "admm", "max_iterations": 10, "sparsity_weight": 0.05}
    with pytest.warns(UserWarning, match="10 iterations"):
        small, same, unit = (
            robust_pca(matrix * size, scale=scale, **options)
            for size, scale in ((0.1, "none"), (0.1, "rms"), (1, "rms"))
        )
    assert small.unit == 1.0
    assert relative(same.low_rank * 10, unit.low_rank.numpy()) < 1e-9
    assert relative(small.low_rank * 10, unit.low_rank.numpy()) > 1e-3


def test_types():
    for dtype in [torch.float16, torch.bfloat16, torch.float32, torch.float64]:
        matrix = mixture(dtype=torch.float32).to(dtype)
        copy = matrix.clone()
        result = robust_pca(matrix, sparsity_weight=0.05)
        truth = robust_pca(matrix.double(), sparsity_weight=0.05)
        expected = torch.float64 if dtype == torch.float64 else torch.float32
        assert result.low_rank.dtype == result.sparse.dtype == expected, dtype
        assert relative(result.low_rank, truth.low_rank.numpy()) < 1e-4, dtype
        assert torch.equal(matrix, copy), dtype


def test_strided_and_differentiable_input():
    matrix = mixture(rows=800, columns=24)
    view = matrix[::2, ::2].requires_grad_()
    result = robust_pca(view, sparsity_weight=0.05)
    same = robust_pca(view.detach().contiguous(), sparsity_weight=0.05)
    assert torch.allclose(result.low_rank, same.low_rank, atol=1e-12)
    assert not result.low_rank.requires_grad
    expanded = torch.randn(50, 1).expand(50, 7)
    assert robust_pca(expanded, sparsity_weight=0.1).rank == 1


def test_zeros():
    result = robust_pca(torch.zeros(20, 5))
    assert (result.rank, result.iterations, result.residual, result.converged) == (0, 0, 0.0, True)
    assert not result.low_rank.any()
    assert not result.sparse.any()
    assert result.drift == result.sparsity == 0


def refused(words, matrix, case, error=ValueError, **options):
    assert_refused(error, words, functools.partial(robust_pca, matrix, **options), case)


def test_refuses_matrices_that_are_not_finite_have_another_shape_or_hold_integers():
    for bad in [float("nan"), float("inf"), -float("inf")]:
        matrix = torch.ones(10, 3)
        matrix[4, 1] = bad
        refused("NaN or infinity", matrix, bad)
    for shape in [(3,), (2, 3, 4), (0, 3), (3, 0)]:
        refused("non-empty matrix", torch.ones(shape), shape)
    refused("int64", torch.ones(3, 3, dtype=torch.int64), "int64", TypeError)


def test_refuses_options_out_of_range():
    for options, words in [
        ({"sparsity_weight": 0}, "sparsity_weight"),
        ({"sparsity_weight": -1.0}, "sparsity_weight"),
        ({"sparsity_weight": float("nan")}, "sparsity_weight"),
        ({"sparsity_weight": "best"}, "'auto'"),
        ({"penalty": 0}, "penalty"),
        ({"tolerance": -1e-3}, "tolerance"),
        ({"max_iterations": 0}, "max_iterations"),
        ({"method": "pcp"}, "adaptive, admm"),
        ({"scale": "max"}, "rms, none"),
    ]:
        refused(words, torch.ones(4, 2), options, **options)


def test_the_limit_is_reported_once():
    for method in ["adaptive", "admm"]:
        with pytest.warns(UserWarning, match="raise max_iterations") as caught:
            result = robust_pca(mixture(), tolerance=1e-9, max_iterations=3, method=method)
        assert len(caught) == 1, method
        assert not result.converged, method
        assert result.iterations == 3, method


def test_the_residual_and_the_shares_are_measured_on_the_result():
    matrix = mixture(dtype=torch.float32)
    result = robust_pca(matrix, sparsity_weight=0.05)
    low, sparse = result.low_rank.double(), result.sparse.double()
    norm = matrix.double().norm()
    assert result.residual == pytest.approx(
        ((low + sparse - matrix).norm() / norm).item(), rel=1e-2
    )
    assert result.sparsity == pytest.approx((sparse != 0).double().mean().item())
    assert result.low_rank_energy == pytest.approx((low.norm() / norm).item() ** 2)
    assert result.sparse_energy == pytest.approx((sparse.norm() / norm).item() ** 2)
    assert result.drift == pytest.approx(((low - low[:, 6:7]).norm() / low.norm()).item(), rel=1e-4)
    assert np.linalg.matrix_rank(low.numpy(), tol=1e-6 * norm.item()) == result.rank


def test_reduced_precision_settings_do_not_leak_in_or_out():
    matrix = mixture(dtype=torch.float32)
    plain = robust_pca(matrix, sparsity_weight=0.05)
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    try:
        with torch.autocast("cpu", dtype=torch.bfloat16):
            guarded = robust_pca(matrix, sparsity_weight=0.05)
        assert torch.get_float32_matmul_precision() == "medium"
    finally:
        torch.set_float32_matmul_precision(before)
    assert torch.equal(plain.low_rank, guarded.low_rank)


@st.composite
def matrices(draw):
    rows, columns = draw(st.integers(2, 60)), draw(st.integers(1, 12))
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**20)))
    rank = draw(st.integers(0, min(columns, 4)))
    low = torch.randn(rows, rank, generator=generator, dtype=torch.float64) @ torch.randn(
        rank, columns, generator=generator, dtype=torch.float64
    )
    hit = torch.rand(rows, columns, generator=generator) < draw(st.sampled_from([0.0, 0.1, 0.5]))
    noise = draw(st.sampled_from([0.0, 1e-6, 0.1]))
    return low + (5.0 * hit + noise) * torch.randn(
        rows, columns, generator=generator, dtype=torch.float64
    )


@settings(max_examples=40, deadline=None, derandomize=True)
@given(matrices(), st.sampled_from([0.01, 0.1, 0.3, "auto"]))
def test_parts_add_up_and_no_trivial_split_is_better(matrix, weight):
    tight = {"tolerance": 1e-6, "max_iterations": 3000, "progress": False}
    result = robust_pca(matrix, sparsity_weight=weight, **tight)
    gap = (result.low_rank + result.sparse - matrix).norm()
    assert result.converged
    assert gap <= 1.001e-6 * matrix.norm()
    assert torch.isfinite(result.low_rank).all()
    assert torch.isfinite(result.sparse).all()
    used = result.sparsity_weight
    splits = (objective(part, matrix, used) for part in (torch.zeros_like(matrix), matrix))
    assert objective(result.low_rank, matrix, used) <= min(splits) * (1 + 1e-4) + 1e-12
