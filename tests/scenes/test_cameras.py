"""Cameras: pixel centres, directions and poses against hand-made numbers and projection."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.utils._python_dispatch import TorchDispatchMode

from tests.oracles import project
from xplanes.scenes.cameras import cast_rays, focal_length, look_at, orbit
from xplanes.scenes.frame import Frame

EYE = torch.eye(4)


def test_focal_length_of_a_right_angle_is_half_the_width():
    assert focal_length(math.pi / 2, 100) == pytest.approx(50)
    assert focal_length(0.6911112070083618, 800) == pytest.approx(1111.1110311937682)


def test_pixel_centres_by_hand():
    # Two rows of four pixels, focal length 1: centres at +0.5 from the corner.
    rows, columns = torch.tensor([0.0, 0, 1, 1]), torch.tensor([0.0, 3, 0, 3])
    origins, directions = cast_rays(EYE, rows, columns, focal=1.0, centre=(2.0, 1.0))
    expected = torch.tensor([[-1.5, 0.5, -1], [1.5, 0.5, -1], [-1.5, -0.5, -1], [1.5, -0.5, -1]])
    expected = expected / expected.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(directions, expected)
    assert (origins == 0).all()


@settings(max_examples=25, deadline=None)
@given(
    place=st.tuples(*[st.floats(-4, 4, width=32)] * 3).filter(lambda p: np.linalg.norm(p) > 0.1),
    row=st.integers(0, 8),
    column=st.integers(0, 12),
    distance=st.floats(0.5, 9),
)
def test_points_on_a_ray_project_into_its_pixel(place, row, column, distance):
    pose = look_at(torch.tensor([place], dtype=torch.float64))[0]
    pixel = torch.tensor([row]).double(), torch.tensor([column]).double()
    origins, directions = cast_rays(pose, *pixel, focal=11.0, centre=(6.5, 4.5))
    point = (origins + distance * directions)[0].numpy()
    assert project(point, pose.numpy(), 11.0, 9, 13) == (row, column, True)


PLACES = torch.tensor([[3.0, 0, 0], [0, -2, 1], [1, 1, -5], [0, 0, 4], [0, 0, -4]])


@pytest.mark.parametrize("target", [None, (0.5, 0.25, -1.0)], ids=str)
def test_look_at_makes_rigid_right_handed_poses_that_see_their_target(target):
    aim = torch.tensor(target or (0.0, 0.0, 0.0))
    poses = look_at(PLACES, aim if target else None)
    for pose, place in zip(poses, PLACES, strict=True):
        rotation = pose[:3, :3]
        torch.testing.assert_close(rotation.T @ rotation, torch.eye(3), atol=1e-6, rtol=0)
        assert float(rotation.det()) == pytest.approx(1, abs=1e-5), place
        assert torch.equal(pose[:3, 3], place), place
        assert pose[3].tolist() == [0, 0, 0, 1], place
        torch.testing.assert_close(-rotation[:, 2], (aim - place) / (aim - place).norm())
        assert rotation[2, 0] == pytest.approx(0, abs=1e-6), f"no roll from {place}"
        assert rotation[2, 1] >= -1e-6, f"up is up from {place}"


def test_straight_up_and_down_take_y_as_up():
    poses = look_at(torch.tensor([[0.0, 0, 4], [0, 0, -4]]))
    assert poses.isfinite().all()
    for pose in poses:
        torch.testing.assert_close(pose[:3, 1], torch.tensor([0.0, 1, 0]))


def test_orbit_is_a_circle_that_starts_at_minus_y():
    target = torch.tensor([1.0, 2, 3])
    poses = orbit(8, radius=2.0, elevation=30.0, target=target)
    offset = poses[:, :3, 3] - target
    torch.testing.assert_close(offset.norm(dim=-1), torch.full((8,), 2.0))
    torch.testing.assert_close(offset[:, 2], torch.full((8,), 1.0))
    assert offset[0].tolist() == pytest.approx([0, -math.sqrt(3), 1], abs=1e-6)
    assert offset[2].tolist() == pytest.approx([math.sqrt(3), 0, 1], abs=1e-6)
    assert orbit(0, radius=1.0, elevation=0.0).shape == (0, 4, 4)
    assert orbit(1, radius=1.0, elevation=90.0).isfinite().all()


class _Operations(TorchDispatchMode):
    """Takes down the names of all operations."""

    def __init__(self) -> None:
        super().__init__()
        self.names: set[str] = set()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.names.add(func.overloadpacket.__name__)
        return func(*args, **(kwargs or {}))


def test_rays_are_turned_without_matrix_products_which_a_gpu_may_round() -> None:
    generator = torch.Generator().manual_seed(0)
    poses = torch.eye(4).repeat(50, 1, 1)
    poses[:, :3, :3] = torch.linalg.qr(torch.randn(50, 3, 3, generator=generator)).Q
    frame = Frame(0.3, poses[0, :3, :3], torch.tensor([1.0, -2.0, 0.5]))
    rows, columns = (torch.rand(50, generator=generator) * 40 for _ in range(2))
    pinhole = {"focal": (40.0, 30.0), "centre": (20.0, 20.0)}
    with _Operations() as seen:
        origins, directions = frame.rays(*cast_rays(poses, rows, columns, **pinhole))
        back = frame.to_world(origins)
    assert not seen.names & {"mm", "bmm", "addmm", "baddbmm", "matmul", "einsum"}, seen.names
    assert "addcmul_" in seen.names
    local = cast_rays(torch.eye(4), rows, columns, **pinhole)[1].double()
    turns = frame.rotation.double() @ poses[:, :3, :3].double()
    exact = (turns @ local[..., None])[..., 0]
    torch.testing.assert_close(directions.double(), exact, atol=5e-7, rtol=0)
    torch.testing.assert_close(back, poses[:, :3, 3], atol=2e-6, rtol=0)
