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
    from torchmetrics.functional.image import structural_similarity_index_measure

    if min(truth.shape[:2]) < 11:
        return float("nan")
    first, second = (t.clamp(0, 1).float().permute(2, 0, 1)[None] for t in (prediction, truth))
    score = structural_similarity_index_measure(first, second, data_range=1.0)
    assert isinstance(score, Tensor)
    return float(score)
