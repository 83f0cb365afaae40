"""Preprocessing of images for the models, and crops."""

import pytest
import torch

from tests.lrm.reference import compare
from xplanes.lrm import LRMError
from xplanes.lrm.images import Crop, composite_on, foreground_crop, prepare, square_crop


def picture(height=20, width=30, seed=0):
    return torch.rand(1, 4, height, width, generator=torch.Generator().manual_seed(seed))


def test_composite():
    rgba = torch.tensor([0.2, 0.4, 0.6, 0.25]).view(1, 4, 1, 1)
    compare(composite_on(rgba, 1.0).flatten(), torch.tensor([0.8, 0.85, 0.9]))
    bytes_ = torch.tensor([255, 0, 51, 255], dtype=torch.uint8).view(1, 4, 1, 1)
    compare(composite_on(bytes_, 0.5).flatten(), torch.tensor([1.0, 0.0, 0.2]))


def test_windows_cut_and_pad():
    rgba = picture()
    assert torch.equal(Crop(2, 3, 10).apply(rgba), rgba[..., 2:12, 3:13])
    padded = Crop(-5, -2, 40).apply(rgba)
    assert torch.equal(padded[..., 5:25, 2:32], rgba)
    assert padded.sum() == pytest.approx(float(rgba.sum()), rel=1e-5)
    assert not Crop(100, 0, 5).apply(rgba).any()
    kept = Crop(0, 0, 20, kept=(5, 5, 8, 9)).apply(rgba)
    assert int((kept != 0).sum()) == 4 * 3 * 4


def test_squares_are_centred():
    for height, width, zoom in ((20, 30, 1.0), (400, 400, 0.54), (64, 64, 2)):
        crop, case = square_crop(height, width, zoom), f"{height} x {width} at zoom {zoom}"
        assert crop.side == pytest.approx(max(height, width) / zoom, abs=1), case
        assert 2 * crop.top + crop.side == pytest.approx(height, abs=1), case
        assert 2 * crop.left + crop.side == pytest.approx(width, abs=1), case


def test_foreground_fills_its_share():
    alpha = torch.zeros(60, 80)
    alpha[10:31, 20:61] = 1
    crop = foreground_crop(alpha)
    assert crop.side == int(40 / 0.85)
    assert crop.kept == (10, 20, 30, 60)
    opaque = crop.apply(alpha.expand(1, 4, 60, 80))[0, 3].nonzero()
    middle = (opaque.amin(0) + opaque.amax(0) + 1) / 2
    compare(middle, torch.full((2,), crop.side / 2), atol=1)


def test_other_tensors_than_images_are_refused():
    with pytest.raises(LRMError, match=r"\[N, 4, H, W\]"):
        prepare(torch.zeros(1, 3, 5, 5), "triposr", 5)
    for alpha in (torch.zeros(5, 5), torch.eye(5)[:1]):
        with pytest.raises(LRMError, match="empty"):
            foreground_crop(alpha)
