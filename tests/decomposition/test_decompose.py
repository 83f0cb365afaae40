import functools

import pytest
import torch

from tests.refusals import assert_refused
from xplanes.decomposition import decompose, robust_pca
from xplanes.fields.xplanes import SPACE_PLANES


def sequence(frames=6, channels=4, height=8, width=10, seed=0):
    generator = torch.Generator().manual_seed(seed)
    static = torch.randn(1, 3, channels, height, width, generator=generator)
    moving = torch.zeros(frames, 3, channels, height, width)
    for frame in range(frames):
        moving[frame, :, :, frame : frame + 2, 3:5] = 3.0
    return static + moving


def test_each_orientation_is_its_own_matrix():
    triplanes = sequence()
    parts = decompose(triplanes, sparsity_weight="auto")
    for index, name in enumerate(SPACE_PLANES):
        alone = robust_pca(triplanes[:, index].reshape(6, -1).mT, sparsity_weight="auto")
        low = alone.low_rank.mT.reshape(6, 4, 8, 10)
        assert torch.allclose(parts.low_rank[:, index], low, atol=1e-5)
        for key, value in alone.report().items():
            expected = value if isinstance(value, str) else pytest.approx(value, rel=1e-2)
            assert parts.reports[name][key] == expected


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32, torch.float64])
def test_parts_have_the_shape_of_the_input_and_add_up(dtype):
    triplanes = sequence(width=20).to(dtype)[..., ::2]
    copy = triplanes.clone()
    parts = decompose(triplanes, sparsity_weight="auto", tolerance=1e-5)
    assert parts.low_rank.shape == parts.sparse.shape == triplanes.shape
    assert parts.low_rank.dtype == (dtype if dtype == torch.float64 else torch.float32)
    assert parts.low_rank.is_contiguous()
    gap = (parts.low_rank + parts.sparse - triplanes).norm()
    assert gap < 1e-5 * triplanes.norm()
    assert torch.equal(triplanes, copy)


def test_refuses_other_shapes_and_says_what_is_wrong_in_the_values():
    for shape in [(6, 3, 4, 8), (6, 2, 4, 8, 8), (0, 3, 4, 8, 8)]:
        call = functools.partial(decompose, torch.ones(shape))
        assert_refused(ValueError, r"\[T, 3, C, H, W\]", call, shape)
    triplanes = sequence()
    triplanes[2, 1, 0, 3, 3] = float("nan")
    with pytest.raises(ValueError, match="NaN"):
        decompose(triplanes)
