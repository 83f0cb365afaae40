import itertools

import torch
from rpca_oracle import singular_value_threshold

from xplanes.decomposition.admm import add_gram, needs_double, shrinkage_from_gram


def conditioned(rows, columns, condition, dtype=torch.float64):
    generator = torch.Generator().manual_seed(0)
    left = torch.linalg.qr(torch.randn(rows, columns, generator=generator, dtype=torch.float64)).Q
    right = torch.linalg.qr(
        torch.randn(columns, columns, generator=generator, dtype=torch.float64)
    ).Q
    values = torch.logspace(0, -torch.log10(torch.tensor(condition)).item(), columns)
    return ((left * values.double()) @ right).to(dtype)


def through_gram(matrix, threshold):
    """The shrunk matrix and its rank, by the Gram matrix of the columns."""
    gram = torch.zeros(matrix.shape[1], matrix.shape[1], dtype=torch.float64)
    add_gram(gram, matrix, double=True)
    basis, factors, _ = shrinkage_from_gram(gram, threshold)
    return matrix @ ((basis * factors) @ basis.mT).to(matrix.dtype), len(factors)


def test_gram_matches_the_exact_decomposition():
    for condition, threshold in itertools.product([1e1, 1e3, 1e6], [0.5, 1e-2, 1e-4]):
        case = f"condition={condition}, threshold={threshold}"
        matrix = conditioned(3000, 20, condition)
        fast, rank = through_gram(matrix, threshold)
        slow, expected = singular_value_threshold(matrix, threshold)
        assert rank == expected, case
        assert (fast - slow).norm() < 1e-8 * slow.norm(), case


def test_float32_stays_near_the_float64_answer():
    for condition in [1e1, 1e3, 1e6]:
        matrix = conditioned(3000, 20, condition)
        fast, _ = through_gram(matrix.float(), 1e-3)
        slow, _ = singular_value_threshold(matrix, 1e-3)
        assert (fast.double() - slow).norm() < 1e-6 * slow.norm(), condition


def test_double_is_asked_for_when_squaring_would_cost_accuracy():
    assert not needs_double(100.0, 1.0, 1e-4)
    assert needs_double(1e4, 1.0, 1e-4)
    assert needs_double(100.0, 1.0, 1e-6)
