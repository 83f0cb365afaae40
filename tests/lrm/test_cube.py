"""Padding and cropping triplanes: the field is unchanged inside both cubes."""

from itertools import product

import pytest
import torch
import torch.nn.functional as F

from tests.lrm.reference import compare
from xplanes.lrm.alignment import MOST, fit_cube

SIZE = 10


def planes(frames=2, channels=3, size=SIZE):
    generator = torch.Generator().manual_seed(0)
    return torch.randn(frames, 3, channels, size, size, generator=generator)


def read(triplanes, half_side, points):
    """Values of every plane at points in units of the frame. [T 3, C, N]"""
    grid = (points / half_side).expand(len(triplanes) * 3, 1, -1, -1)
    return F.grid_sample(triplanes.flatten(0, 1), grid, align_corners=False)[:, :, 0]


def test_the_field_stays_the_same_inside_both_cubes():
    own = planes()
    for half_side, share in product((1.0, 0.87), (0.35, 0.7, 0.99, 1.01, 1.3, 1.9)):
        case = f"half side {half_side}, share {share}"
        found, reached = fit_cube(own, half_side, share * half_side)
        texel = 2 * half_side / SIZE
        assert share * half_side - 1e-6 <= reached < share * half_side + texel, case
        assert found.shape[-1] == found.shape[-2] == round(2 * reached / texel), case
        # Half a texel from a border the values already fade.
        inside = min(reached, half_side) - texel
        points = torch.rand(200, 2, generator=torch.Generator().manual_seed(1))
        points = (points * 2 - 1) * inside
        before, after = read(own, half_side, points), read(found, reached, points)
        compare(after, before, atol=2e-5, rtol=0, case=case)


def test_what_is_added_continues_the_border():
    own = planes()
    found, reached = fit_cube(own, 1.0, 1.5)
    corner = torch.tensor([[0.9 * reached, 0.9 * reached]])
    torch.testing.assert_close(read(found, reached, corner)[..., 0], own[..., -1, -1].flatten(0, 1))


def test_the_same_cube_is_left_alone_and_none_grows_without_end():
    own = planes()
    for wanted in (1.0, 1.0 - 1e-9, 1 - 1.9 / SIZE):
        found, reached = fit_cube(own, 1.0, wanted)
        assert found is own
        assert reached == 1.0
    _, reached = fit_cube(own, 1.0, 50.0)
    assert reached == pytest.approx(MOST)
