"""Image quality, one number per view.

Scores of several views are means of per-view scores, as in the literature. Pooling the errors of
all views first would give different numbers.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor


def psnr(prediction: Tensor, truth: Tensor, shown: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB of one image in [0, 1], at most 100.

    Args:
        prediction: Rendered image. [H, W, 3]
        truth: True image. [H, W, 3]
        shown: Pixels that count; all when None. bool [H, W]
    """
    squares = (prediction.clamp(0, 1).double() - truth.double()).square()
    error = (squares if shown is None else squares[shown]).mean()
    return float(-10 * torch.log10(error.clamp_min(1e-10)))


def ssim(prediction: Tensor, truth: Tensor, shown: Tensor | None = None) -> float:
    """Structural similarity of one image in [0, 1]; Gaussian window of 11 pixels, sigma 1.5.

    NaN if a side of the image is shorter than the window.

    Args:
        prediction: Rendered image. [H, W, 3]
        truth: True image. [H, W, 3]
        shown: Pixels that count; all when None. bool [H, W]
    """
    if min(truth.shape[:2]) < 11:
        return math.nan
    similarity = _similarity(prediction.clamp(0, 1), truth.clamp(0, 1))
    return float(similarity.mean() if shown is None else similarity[shown].mean())


def mean(values: Sequence[float]) -> float:
    """Mean; NaN for no values."""
    return math.fsum(values) / len(values) if values else math.nan


def dissimilarity(prediction: Tensor, truth: Tensor) -> Tensor:
    """1 - SSIM as a term of a loss, differentiable; 0 if a side is below 11 pixels. []"""
    if min(truth.shape[:2]) < 11:
        return prediction.new_zeros(())
    return 1 - _similarity(prediction, truth).mean()


def _similarity(prediction: Tensor, truth: Tensor) -> Tensor:
    """SSIM of the window around each pixel, averaged over channels. [H, W]"""
    from torchmetrics.functional.image import structural_similarity_index_measure

    first, second = (t.float().permute(2, 0, 1)[None] for t in (prediction, truth))
    _, whole = structural_similarity_index_measure(
        first, second, data_range=1.0, return_full_image=True
    )
    assert isinstance(whole, Tensor)
    return whole[0].mean(dim=0)
