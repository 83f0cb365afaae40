"""Independent float64 references for the decomposition, written from the formulas alone."""

import numpy as np


def oracle(matrix, weight, penalty=None, iterations=3000, stop=1e-11):
    """Plain ADMM with a full SVD in float64 numpy. Returns L, S."""
    y = matrix.detach().double().cpu().numpy()
    penalty = penalty or 0.1 / max(np.sqrt((y**2).mean()), 1e-300)
    sparse, multiplier = np.zeros_like(y), np.zeros_like(y)
    for _ in range(iterations):
        u, s, v = np.linalg.svd(y - sparse - multiplier / penalty, full_matrices=False)
        low = (u * np.maximum(s - 1 / penalty, 0)) @ v
        rest = y - low - multiplier / penalty
        new = np.sign(rest) * np.maximum(np.abs(rest) - weight / penalty, 0)
        gap = low + new - y
        multiplier += penalty * gap
        step = np.linalg.norm(gap) + np.linalg.norm(new - sparse)
        sparse = new
        if step < stop * np.linalg.norm(y):
            break
    return low, sparse


def objective(low, matrix, weight):
    low = np.asarray(low, dtype=np.float64)
    y = matrix.detach().double().cpu().numpy()
    return np.linalg.svd(low, compute_uv=False).sum() + weight * np.abs(y - low).sum()


def relative(value, truth):
    value = np.asarray(value, dtype=np.float64)
    return np.linalg.norm(value - truth) / max(np.linalg.norm(truth), 1e-300)
