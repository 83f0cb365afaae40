"""The field: names and shapes of planes, gradients to all parameters, initial values."""

import copy

import pytest
import torch

from tests.oracles import plane_features as oracle
from xplanes.fields import Decoder, XPlanes
from xplanes.fields.xplanes import FINE_PLANES, PLANE_SETS, TIME_PLANES, random_planes

SETS = tuple(PLANE_SETS)


def planes_of(plane_set, seed=0, fine=False, **changes):
    sizes = {"channels": 4, "resolution": 6, "time_resolution": 3}
    sizes |= {"space_scale": 0.3, "time_scale": 0.5, **changes}
    planes = random_planes(plane_set, **sizes, generator=torch.Generator().manual_seed(seed))
    if fine:
        generator = torch.Generator().manual_seed(seed + 1)
        planes |= {name: torch.randn(3, 13, 13, generator=generator) for name in FINE_PLANES}
    return planes


def field_of(plane_set, dtype=torch.float32, **changes):
    torch.manual_seed(0)
    decoder = Decoder(changes.get("channels", 4), width=8, hidden=2)
    field = XPlanes(planes=planes_of(plane_set, **changes), decoder=decoder, plane_set=plane_set)
    return field.to(dtype)


def scattered(count, dtype=torch.float32):
    generator = torch.Generator().manual_seed(5)
    points = 2 * torch.rand(count, 3, generator=generator) - 1
    return points.to(dtype), torch.rand(count, generator=generator).to(dtype)


@pytest.mark.parametrize("plane_set", SETS)
def test_features_come_from_the_planes_of_their_names_and_fine_ones_are_added(plane_set):
    """To the first channels of the space planes, unless they are left out."""
    field = field_of(plane_set, torch.float64, fine=True)
    points, times = scattered(20, torch.float64)
    planes = {name: plane.detach().numpy() for name, plane in field.planes.items()}
    fine = {name.removesuffix("_fine"): planes.pop(name) for name in FINE_PLANES}
    expected = torch.from_numpy(oracle(planes, plane_set, points, times))
    field.is_fine = False
    left_out = field.features(points, times)
    torch.testing.assert_close(left_out, expected.flatten(1), atol=1e-12, rtol=0)
    field.is_fine = True
    expected[..., :3] += torch.from_numpy(oracle(fine, "three", points, times))
    found = field.features(points, times)
    torch.testing.assert_close(found, expected.flatten(1), atol=1e-12, rtol=0)


def test_planes_come_back_as_they_were_given():
    for plane_set in SETS:
        given = planes_of(plane_set, fine=True)
        field = XPlanes(planes=given, decoder=Decoder(4), plane_set=plane_set)
        names = ["xy", "xz", "yz", *TIME_PLANES[plane_set], *FINE_PLANES]
        assert list(field.planes) == names, plane_set
        for name, plane in field.planes.items():
            assert torch.equal(plane, given[name]), (plane_set, name)


def test_gradients_reach_every_parameter():
    for plane_set in SETS:
        field = field_of(plane_set, fine=True)
        colour, density = field(*scattered(200))
        (colour.sum() + density.sum()).backward()
        for name, parameter in field.named_parameters():
            case = plane_set, name
            assert parameter.grad is not None, case
            assert parameter.grad.isfinite().all(), case
            if name in ("space", "time", "fine"):
                assert (parameter.grad.flatten(1).abs().amax(dim=1) > 0).all(), case
            else:
                assert parameter.grad.abs().max() > 0, case


@pytest.mark.parametrize("plane_set", SETS)
@pytest.mark.parametrize(("time_rows", "fine"), [(1, False), (3, True)])
def test_a_snapshot_shows_the_field_at_its_time(plane_set, time_rows, fine):
    field = field_of(plane_set, torch.float64, time_resolution=time_rows, fine=fine)
    points, _ = scattered(300, torch.float64)
    points = 1.3 * points  # Beyond the cube the planes fade to zero.
    for time in (0.0, 0.25, 0.6, 1.0, 1.5):
        at_once = field.snapshot(time)
        assert not at_once.moves
        times = torch.full((300,), time, dtype=torch.float64)
        for found, expected in zip(at_once(points, 1 - times), field(points, times), strict=True):
            torch.testing.assert_close(found, expected, atol=1e-12, rtol=1e-12)


def test_a_snapshot_is_the_field_itself_where_it_would_show_something_else():
    class Other(XPlanes):
        pass

    planes = planes_of("six")
    other = Other(planes=planes, decoder=Decoder(4), plane_set="six")
    finer = {**planes, **{name: torch.randn(4, 9, 11) for name in TIME_PLANES["six"]}}
    for field in (other, XPlanes(planes=finer, decoder=Decoder(4), plane_set="six")):
        assert field.snapshot(0.3) is field


TIMES, SPACES = TIME_PLANES["six"], ("xy", "xz", "yz")

MISFITS = (
    ({"yz": None}, "six", "needs xy, xz, yz, xt, yt, zt"),
    ({"qt": torch.zeros(4, 3, 6)}, "six", "qt"),
    ({"xy": torch.zeros(4, 6, 5)}, "six", "xy"),
    ({"yt": torch.zeros(4, 2, 6)}, "six", "yt"),
    ({"xy": torch.zeros(6, 6)}, "six", "xy"),
    (dict.fromkeys(SPACES, torch.zeros(4, 6, 5)), "six", "C, H, H"),
    (dict.fromkeys(TIMES, torch.zeros(5, 3, 6)), "six", "channels"),
    (dict.fromkeys(TIMES, torch.zeros(4, 0, 6)), "six", "at least one"),
    (dict.fromkeys(SPACES, torch.zeros(4, 0, 0)), "six", "at least one"),
    (dict.fromkeys(FINE_PLANES, torch.zeros(5, 8, 8)), "six", "5 channels, more than the space pl"),
    (dict.fromkeys(FINE_PLANES, torch.zeros(2, 16, 8)), "six", r"xy_fine is \[2, 16, 8\]: must be"),
    ({"yz_fine": torch.zeros(2, 8, 8)}, "six", "may have xy_fine, xz_fine, yz_fine"),
    ({}, "nine", "nine"),
    ({}, "seven", r"'seven'.*three, six, nine"),
)


@pytest.mark.parametrize(("change", "plane_set", "words"), MISFITS)
def test_planes_that_do_not_fit_are_refused_with_a_message(change, plane_set, words):
    planes = {k: v for k, v in {**planes_of("six"), **change}.items() if v is not None}
    with pytest.raises(ValueError, match=words):
        XPlanes(planes=planes, decoder=Decoder(4), plane_set=plane_set)


def test_random_planes_repeat_with_their_seed_and_have_their_scale():
    for plane_set in SETS:
        first, again, other = (planes_of(plane_set, seed, resolution=64) for seed in (0, 0, 1))
        assert all(torch.equal(first[name], again[name]) for name in first), plane_set
        assert not any(torch.equal(first[name], other[name]) for name in first), plane_set
        assert float(first["xy"].std()) == pytest.approx(0.3, rel=0.05), plane_set
        for name in TIME_PLANES[plane_set]:
            assert float(first[name].std()) == pytest.approx(0.5, rel=0.15), (plane_set, name)


def test_a_masked_field_can_be_copied():
    masked = field_of("six").masked(lambda points: points[:, 0] > 0)
    points, times = torch.tensor([[0.5, 0, 0], [-0.5, 0, 0]]), torch.zeros(2)
    found, again = (each(points, times)[1] for each in (masked, copy.copy(masked)))
    assert found[0] > found[1] == 0
    assert torch.equal(found, again)
