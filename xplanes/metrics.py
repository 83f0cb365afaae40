"""Image quality, one number per view.

Scores of several views are means of the views' scores: pooling the error first gives other numbers
than the field's papers print.
"""

import torch
from torch import Tensor


def psnr(prediction: Tensor, truth: Tensor) -> float:
    """Peak signal-to-noise ratio in dB of one image in [0, 1], at most 100. [H, W, 3]"""
    error = (prediction.clamp(0, 1).double() - truth.double()).square().mean()
    return float(-10 * torch.log10(error.clamp_min(1e-10)))


def ssim(prediction: Tensor, truth: Tensor) -> float:
    """Structural similarity of one image in [0, 1], Gaussian window of 11 with sigma 1.5. [H, W, 3]

    Images below 11 pixels a side have no window to slide and score NaN.
    """
    if min(truth.shape[:2]) < 11:
        return float("nan")
    return float(_similarity(prediction.clamp(0, 1), truth.clamp(0, 1)))


def dissimilarity(prediction: Tensor, truth: Tensor) -> Tensor:
    """1 - SSIM as a term of a loss, differentiable; 0 for images below 11 pixels a side. []"""
    if min(truth.shape[:2]) < 11:
        return prediction.new_zeros(())
    return 1 - _similarity(prediction, truth)


def _similarity(prediction: Tensor, truth: Tensor) -> Tensor:
    from torchmetrics.functional.image import structural_similarity_index_measure

    first, second = (t.float().permute(2, 0, 1)[None] for t in (prediction, truth))
    score = structural_similarity_index_measure(first, second, data_range=1.0)
    assert isinstance(score, Tensor)
    return score
