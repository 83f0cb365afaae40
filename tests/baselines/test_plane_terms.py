"""K-Planes' regularisers: values against loops, gradients against autograd."""

import pytest
import torch

from tests.baselines import oracles
from tests.baselines.test_kplanes_field import products
from xplanes.training.plane_terms import PlaneTerms
from xplanes.training.sampling.proposal import UpdateSchedule


@pytest.mark.parametrize("variation", ["coded", "corrected"])
@pytest.mark.parametrize("time", [4, None])
def test_values_equal_loops(variation, time):
    planes = products(time).double()
    arrays = [(name, plane.detach()[0].numpy()) for name, plane in planes.planes()]
    terms = PlaneTerms(1.0, variation, 1.0, 1.0).values(planes)
    found = {name: term.detach() for name, term in terms.items()}
    expected = {"coded": oracles.coded_variation, "corrected": oracles.corrected_variation}
    assert float(found["total_variation"]) == pytest.approx(expected[variation](arrays), rel=1e-9)
    assert float(found["time_smoothness"]) == pytest.approx(oracles.bend(arrays), rel=1e-9)
    assert float(found["time_identity"]) == pytest.approx(
        oracles.distance_from_one(arrays), rel=1e-9
    )


@pytest.mark.parametrize("variation", ["coded", "corrected"])
def test_gradients_equal_autograd(variation):
    planes = products(5).double()
    terms = PlaneTerms(0.3, variation, 0.7, 0.2)
    values = terms.values(planes)
    total = (
        0.3 * values["total_variation"]
        + 0.7 * values["time_smoothness"]
        + 0.2 * values["time_identity"]
    )
    total.backward()
    expected = [plane.grad.clone() for _, plane in planes.planes()]
    planes.zero_grad()
    terms.add_gradients(planes)
    for (_, plane), wanted in zip(planes.planes(), expected, strict=True):
        torch.testing.assert_close(plane.grad, wanted)


def test_weights_of_zero_leave_no_gradient():
    planes = products(5)
    PlaneTerms(0.0, "coded", 0.0, 0.0).add_gradients(planes)
    assert all(plane.grad is None for _, plane in planes.planes())


@pytest.mark.parametrize(("every", "warmup", "steps"), [(5, 5000, 9000), (3, 50, 200), (1, 1, 40)])
def test_density_fields_learn_at_the_published_steps(every, warmup, steps):
    schedule = UpdateSchedule(every, warmup)
    expected = oracles.learning_steps(every, warmup, steps)
    assert [step for step in range(steps) if schedule.learns(step)] == expected
    # A resumed run asks in the middle, and an earlier step may follow.
    late = expected[-1]
    fresh = UpdateSchedule(every, warmup)
    assert fresh.learns(late)
    assert fresh.learns(expected[3])


def test_updates_grow_rare():
    schedule = UpdateSchedule(5, 5000)
    gaps = torch.tensor([s for s in range(9000) if schedule.learns(s)]).diff()
    assert gaps[:9].unique().tolist() == [1]
    assert gaps[20:100].unique().tolist() == [2]
    assert gaps[-100:].unique().tolist() == [6]
