import functools
import itertools
import math

import pytest
import torch
from rpca_oracle import singular_value_threshold

from xplanes.decomposition.admm import add_gram, needs_double, shrinkage_from_gram


def conditioned(rows, columns, condition):
    draw = functools.partial(
        torch.randn, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    left, right = (torch.linalg.qr(draw(size, columns)).Q for size in (rows, columns))
    return (left * torch.logspace(0, -math.log10(condition), columns).double()) @ right


def through_gram(matrix, threshold):
    """The shrunk matrix and its rank, by the Gram matrix of the columns."""
    gram = torch.zeros(matrix.shape[1], matrix.shape[1], dtype=torch.float64)
    add_gram(gram, matrix, double=True)
    basis, factors, _ = shrinkage_from_gram(gram, threshold)
    return matrix @ ((basis * factors) @ basis.mT).to(matrix.dtype), len(factors)


@pytest.mark.parametrize(("dtype", "most"), [(torch.float64, 1e-8), (torch.float32, 1e-6)])
def test_gram_matches_the_exact_decomposition(dtype, most):
    for condition, threshold in itertools.product([1e1, 1e3, 1e6], [0.5, 1e-2, 1e-3, 1e-4]):
        case = f"condition={condition}, threshold={threshold}"
        matrix = conditioned(3000, 20, condition)
        fast, rank = through_gram(matrix.to(dtype), threshold)
        slow, expected = singular_value_threshold(matrix, threshold)
        assert rank == expected, case
        assert (fast.double() - slow).norm() < most * slow.norm(), case


def test_double_is_asked_for_when_squaring_would_cost_accuracy():
    assert not needs_double(100.0, 1.0, 1e-4)
    assert needs_double(1e4, 1.0, 1e-4)
    assert needs_double(100.0, 1.0, 1e-6)
