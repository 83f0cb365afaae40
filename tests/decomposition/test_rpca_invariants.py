import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from xplanes.decomposition import robust_pca

TIGHT = {"tolerance": 1e-6, "max_iterations": 3000, "progress": False}


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


weights = st.sampled_from([0.01, 0.1, 0.3, "auto"])


def objective(result, matrix):
    low = result.low_rank
    rest = (matrix - low).abs().sum()
    return torch.linalg.svdvals(low).sum() + result.sparsity_weight * rest


@settings(max_examples=40, deadline=None, derandomize=True)
@given(matrices(), weights)
def test_parts_add_up_and_no_trivial_split_is_better(matrix, weight):
    result = robust_pca(matrix, sparsity_weight=weight, **TIGHT)
    gap = (result.low_rank + result.sparse - matrix).norm()
    assert result.converged
    assert gap <= 1.001e-6 * matrix.norm()
    assert torch.isfinite(result.low_rank).all()
    assert torch.isfinite(result.sparse).all()
    value = objective(result, matrix)
    all_sparse = result.sparsity_weight * matrix.abs().sum()
    all_low = torch.linalg.svdvals(matrix).sum()
    assert value <= min(all_sparse, all_low) * (1 + 1e-4) + 1e-12


@settings(max_examples=25, deadline=None, derandomize=True)
@given(
    matrices(),
    weights,
    st.randoms(use_true_random=False),
    st.sampled_from([2.0**-40, 0.125, 2.0, 2.0**30]),
)
def test_columns_may_be_permuted_signs_flipped_and_all_scaled(matrix, weight, random, factor):
    order = list(range(matrix.shape[1]))
    random.shuffle(order)
    sign = random.choice([-1, 1])
    one = robust_pca(matrix, sparsity_weight=weight, scale="rms", **TIGHT)
    other = robust_pca(sign * matrix[:, order], sparsity_weight=weight, scale="rms", **TIGHT)
    scale = matrix.norm() + 1e-300
    assert other.iterations == one.iterations
    assert (sign * other.low_rank - one.low_rank[:, order]).norm() <= 1e-7 * scale
    assert (sign * other.sparse - one.sparse[:, order]).norm() <= 1e-7 * scale

    scaled = robust_pca(factor * matrix, sparsity_weight=weight, scale="rms", **TIGHT)
    assert (scaled.low_rank / factor - one.low_rank).norm() <= 1e-7 * scale
    assert scaled.rank == one.rank
