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
