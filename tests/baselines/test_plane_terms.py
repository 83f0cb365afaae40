"""K-Planes' regularisers: values against loops, gradients against autograd."""

import itertools

import pytest
import torch

from tests.baselines import oracles
from tests.baselines.test_kplanes_field import products
from xplanes.baselines.products import PlaneTerms
from xplanes.baselines.proposal import UpdateSchedule


def test_values_equal_loops():
    for variation, time in itertools.product(["coded", "corrected"], [4, None]):
        case = f"variation={variation}, time={time}"
        planes = products(time).double()
        arrays = [(name, plane.detach()[0].numpy()) for name, plane in planes.planes()]
        terms = PlaneTerms(1.0, variation, 1.0, 1.0).values(planes)
        variations = {"coded": oracles.coded_variation, "corrected": oracles.corrected_variation}
        for name, oracle in (
            ("total_variation", variations[variation]),
            ("time_smoothness", oracles.bend),
            ("time_identity", oracles.distance_from_one),
        ):
            found, expected = float(terms[name].detach()), oracle(arrays)
            assert found == pytest.approx(expected, rel=1e-9), (case, name)


def test_gradients_equal_autograd():
    for variation in ["coded", "corrected"]:
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
            torch.testing.assert_close(plane.grad, wanted, msg=lambda m, c=variation: f"{c}: {m}")


def test_density_fields_learn_at_the_published_steps():
    for every, warmup, steps in [(5, 5000, 9000), (3, 50, 200), (1, 1, 40)]:
        case = f"every={every}, warmup={warmup}, steps={steps}"
        schedule = UpdateSchedule(every, warmup)
        expected = oracles.learning_steps(every, warmup, steps)
        assert [step for step in range(steps) if schedule.learns(step)] == expected, case
        # A resumed run asks in the middle, and an earlier step may follow.
        late = expected[-1]
        fresh = UpdateSchedule(every, warmup)
        assert fresh.learns(late), case
        assert fresh.learns(expected[3]), case
