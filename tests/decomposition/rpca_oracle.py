"""Independent references for the decomposition, written from the formulas alone."""

import numpy as np
import torch


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


def singular_value_threshold(matrix, threshold):
    """The matrix with its singular values shrunk (the paper's Eq. 24-25), and its rank."""
    left, singular, right = torch.linalg.svd(matrix, full_matrices=False)
    shrunk = (singular - threshold).clamp_min(0)
    return (left * shrunk) @ right, int((shrunk > 0).sum())


def plain_admm(matrix, *, weight, penalty, iterations):
    """Algorithm 1 of the paper as it is printed: low-rank part, sparse part and rank."""
    multiplier, sparse = torch.zeros_like(matrix), torch.zeros_like(matrix)
    for _ in range(iterations):
        low, rank = singular_value_threshold(matrix - sparse - multiplier / penalty, 1 / penalty)
        argument = matrix - low - multiplier / penalty
        sparse = argument.sign() * (argument.abs() - weight / penalty).clamp_min(0)
        multiplier = multiplier + penalty * (low + sparse - matrix)
    return low, sparse, rank
