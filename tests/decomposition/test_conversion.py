import functools

import pytest
import torch
from torch.nn.functional import grid_sample

from tests.refusals import assert_refused
from xplanes.decomposition import space_planes, time_planes
from xplanes.decomposition.conversion import frame_profiles, space_weights


def triplanes(frames=5, channels=3, size=8, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(frames, 3, channels, size, size, generator=generator, dtype=torch.float64)


def test_static_choices():
    for frames in [1, 4, 5]:
        low = triplanes(frames)
        for static, expected in (
            ("middle", low[frames // 2]),
            ("mean", low.mean(0)),
            ("median", low.quantile(0.5, dim=0)),
        ):
            planes = space_planes(low, static=static)
            assert torch.allclose(planes, expected.permute(0, 2, 3, 1)), (frames, static)
            assert planes.is_contiguous(), (frames, static)


def test_another_resolution_samples_the_same_function():
    for resolution in [4, 12, 16]:
        low = triplanes(1)
        planes = space_planes(low, resolution=resolution)
        centres = (torch.arange(resolution, dtype=torch.float64) + 0.5) / resolution * 2 - 1
        rows, columns = torch.meshgrid(centres, centres, indexing="ij")
        grid = torch.stack([columns, rows], -1).expand(3, -1, -1, -1)
        expected = grid_sample(low[0], grid, padding_mode="zeros", align_corners=False)
        assert torch.allclose(planes, expected.permute(0, 2, 3, 1)), resolution


def test_oblong_triplanes_become_square_planes():
    low = torch.randn(3, 3, 2, 6, 10)
    assert space_planes(low, resolution=8).shape == (3, 8, 8, 2)
    with pytest.raises(ValueError, match="set a resolution"):
        space_planes(low)


@pytest.mark.parametrize("dynamic", ["random", "rank1"])
@pytest.mark.parametrize(("plane_set", "count"), [("six", 3), ("nine", 6)])
def test_shapes_noise_and_seed(dynamic, plane_set, count):
    sizes = {"resolution": 16, "time_resolution": 9}
    make = functools.partial(time_planes, plane_set=plane_set, dynamic=dynamic, **sizes)
    planes, again, plain = (
        make(triplanes().float(), noise=noise, generator=torch.Generator().manual_seed(3))
        for noise in (0.01, 0.01, 0.0)
    )
    assert planes.shape == (count, 9, 16, 3)
    assert torch.equal(planes, again)
    assert (planes - plain).std() == pytest.approx(0.01, rel=0.1)
    assert dynamic != "random" or not plain.any()


def test_frames_own_rows_and_other_row_counts_interpolate():
    sparse = triplanes(5)
    own = time_planes(sparse, plane_set="nine", noise=0)
    fine = time_planes(sparse, plane_set="nine", noise=0, time_resolution=9)
    assert torch.allclose(fine[:, ::2], own)
    assert torch.allclose(fine[:, 1::2], (own[:, 1:] + own[:, :-1]) / 2)
    ends = time_planes(sparse, plane_set="nine", noise=0, time_resolution=2)
    assert torch.allclose(ends, own[:, [0, 4]])
    single = time_planes(sparse, plane_set="nine", noise=0, time_resolution=1)
    assert torch.allclose(single[:, 0], own[:, 2])


def test_other_resolutions_of_time_planes_sample_the_same_function():
    own = time_planes(triplanes(), plane_set="six", noise=0)
    for resolution in [4, 8, 12]:
        planes = time_planes(triplanes(), plane_set="six", noise=0, resolution=resolution)
        expected = space_weights(resolution, 8, own) @ own
        assert torch.allclose(planes, expected), resolution


@pytest.mark.parametrize("plane_set", ["six", "nine"])
def test_precision_follows_the_sparse_part(plane_set):
    for given, expected in [
        (torch.float64, torch.float64),
        (torch.float32, torch.float32),
        (torch.bfloat16, torch.float32),
    ]:
        sparse = triplanes().to(given)
        planes = time_planes(sparse, plane_set=plane_set, noise=0)
        assert planes.dtype == expected, given
        # Half precision is of the input alone.
        full = time_planes(sparse.to(expected), plane_set=plane_set, noise=0)
        assert torch.equal(planes, full), given


def test_profiles_follow_grid_sample():
    planes = torch.randn(3, 7, 12, 2, dtype=torch.float64)
    frames = torch.tensor([0, 3, 10])
    values = frame_profiles(planes, frames, 11, 8)
    width = (torch.arange(8, dtype=torch.float64) + 0.5) / 8 * 2 - 1
    time = frames.double() / 10 * 2 - 1
    # Along time align_corners=True: the same node at align_corners=False of 7 rows.
    time = time * 6 / 7
    grid = torch.stack(torch.meshgrid(width, time, indexing="xy"), -1).expand(3, -1, -1, -1)
    expected = grid_sample(planes.permute(0, 3, 1, 2), grid, align_corners=False)
    assert torch.allclose(values, expected.permute(0, 2, 3, 1))


def test_refuses_options_out_of_range():
    for options, words in [
        ({"plane_set": "four"}, "six, nine"),
        ({"plane_set": "three"}, "six, nine"),
        ({"plane_set": "six", "dynamic": "svd"}, "random, ones, rank1"),
        ({"plane_set": "six", "noise": -1.0}, "noise"),
        ({"plane_set": "six", "resolution": 0}, "resolution"),
        ({"plane_set": "six", "time_resolution": 0}, "time_resolution"),
    ]:
        call = functools.partial(time_planes, triplanes(), **options)
        assert_refused(ValueError, words, call, options)
    with pytest.raises(ValueError, match="middle, median, mean"):
        space_planes(triplanes(), static="first")
