"""What a baseline's loss adds up, with which weights, and how its schedules run."""

import itertools
import math
from dataclasses import replace

import pytest
import torch

from tests.balls import ball_scene
from tests.baselines import oracles
from tests.baselines.runs import KPLANES, NEUS, PROPOSAL, TENSOR4D, TINEUVOX, baseline_config, under
from tests.baselines.test_kplanes_field import products
from xplanes.baselines.products import PlaneTerms
from xplanes.baselines.proposal import UpdateSchedule, histogram_loss
from xplanes.baselines.tensor4d.model import eikonal_error, masked_colour_error, silhouette_error
from xplanes.baselines.tineuvox.model import light_entropy, sample_colour_error
from xplanes.models.base import warm_cosine
from xplanes.streams import TrainingState
from xplanes.training.module import RadianceModule

FIRST = TrainingState(seed=0, step=0, batch=0, rank=0)


def module_of(tmp_path, *overrides):
    module = RadianceModule(baseline_config(tmp_path, *overrides))
    module.build(ball_scene())
    return module, rays_of(module.frame)


def rays_of(frame, count=24):
    """Rays from 4 away at the ball around the origin, in the field's frame."""
    generator = torch.Generator().manual_seed(3)
    aim = 0.3 * torch.randn(count, 3, generator=generator)
    origins = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1) * 4
    directions = torch.nn.functional.normalize(aim - origins, dim=1)
    origins, directions = frame.rays(origins, directions)
    return {
        "origins": origins,
        "directions": directions,
        "times": torch.linspace(0, 1, count),
        "background": torch.ones(count, 3),
        "target": torch.rand(count, 3, generator=generator),
        "alpha": (torch.arange(count) % 2).float(),
        "jitter": torch.rand(count, generator=generator),
    }


def error_of(rendering, rays):
    return (rendering.colour - rays["target"]).square().mean()


TERMS = ("total_variation", "time_smoothness", "time_identity")


def check_planes(products, weights, add, variation="coded"):
    """What ``add`` leaves in the gradients is autograd's of the weighted terms."""
    values = PlaneTerms(1.0, variation, 1.0, 1.0).values(products)
    planes = [plane for _, plane in products.planes()]
    total = sum(weight * values[name] for weight, name in zip(weights, TERMS, strict=True))
    expected = torch.autograd.grad(total, planes)
    add()
    tolerance = {} if planes[0].dtype == torch.float64 else {"atol": 1e-7, "rtol": 1e-4}
    for plane, wanted in zip(planes, expected, strict=True):
        assert wanted.abs().sum() > 0
        torch.testing.assert_close(plane.grad, wanted, **tolerance)


@pytest.mark.parametrize("time", [4, None])
@pytest.mark.parametrize("variation", ["coded", "corrected"])
def test_terms_of_planes_and_their_gradients_are_those_of_the_formulas(variation, time):
    planes = products(time).double()
    arrays = [(name, plane.detach()[0].numpy()) for name, plane in planes.planes()]
    total_variation = getattr(oracles, f"{variation}_variation")
    values = PlaneTerms(1.0, variation, 1.0, 1.0).values(planes)
    for name, oracle in zip(
        TERMS, (total_variation, oracles.bend, oracles.distance_from_one), strict=True
    ):
        expected = pytest.approx(oracle(arrays), rel=1e-9)
        assert float(values[name].detach()) == expected, name
    weights = 0.3, 0.7, 0.2
    terms = PlaneTerms(weights[0], variation, *weights[1:])
    check_planes(planes, weights, lambda: terms.add_gradients(planes), variation)


@pytest.mark.parametrize(("every", "warmup", "steps"), [(5, 5000, 9000), (3, 50, 200), (1, 1, 40)])
def test_density_fields_learn_at_the_published_steps(every, warmup, steps):
    schedule = UpdateSchedule(every, warmup)
    expected = oracles.learning_steps(every, warmup, steps)
    assert [step for step in range(steps) if schedule.learns(step)] == expected
    # A resumed run asks in the middle, and an earlier step may follow.
    fresh = UpdateSchedule(every, warmup)
    assert fresh.learns(expected[-1])
    assert fresh.learns(expected[3])


def test_kplanes_regularises_its_planes_and_those_of_the_density_fields(tmp_path):
    module, _ = module_of(
        tmp_path,
        *("model=kplanes", *KPLANES, *PROPOSAL),
        *under("model.loss", total_variation=0.3, time_smoothness=0.7, time_identity=0.2),
        *under("model.sampler", total_variation=0.5, time_smoothness=0.1, time_identity=0.4),
    )
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    planes = module.field.products
    check_planes(planes, (0.3, 0.7, 0.2), lambda: module.model.regularise(FIRST))
    proposals = module.sampler.renderer.proposals
    assert len(proposals) == 2
    for proposal in proposals:
        module.zero_grad()
        check_planes(
            proposal.products,
            (0.5, 0.1, 0.4),
            lambda: module.sampler.regularise(module.field, FIRST),
        )


def test_density_fields_learn_by_the_weighted_histogram_term(tmp_path):
    module, rays = module_of(
        tmp_path, "model=kplanes", *KPLANES, *PROPOSAL, "model.sampler.histogram=0.3"
    )
    rendering = module.sampler.render(module.field, rays, FIRST)
    (found,) = (term.detach() for term in module.sampler.losses(rendering).values())
    assert float(found) == pytest.approx(0.3 * histogram_loss(rendering.levels).item(), rel=1e-6)
    assert float(found) > 0
    (total,) = module.model.losses(rendering, rays, FIRST).values()
    assert total.item() == pytest.approx(error_of(rendering, rays).item(), rel=1e-6)
    late = next(s for s in range(6000, 6006) if not module.sampler.schedule.learns(s))
    undisturbed = module.sampler.render(module.field, rays, replace(FIRST, step=late))
    assert module.sampler.losses(undisturbed) == {}


def test_annealing_rises_as_published_and_stays_for_images(tmp_path):
    small = [override for override in PROPOSAL if "anneal" not in override]
    module, rays = module_of(tmp_path, "model=kplanes", *KPLANES, *small)
    sampler = module.sampler
    for step in (0, 1, 100, 500, 999, 1000, 30000):
        share = min(step / 1000, 1)
        expected = 10 * share / (9 * share + 1)
        assert sampler.anneal(step) == pytest.approx(expected)
        sampler.render(module.field, rays, replace(FIRST, step=step))
        assert float(sampler.renderer.exponent) == pytest.approx(expected)
    # With an exponent of 0 all bins weigh the same, whatever the density fields hold.
    sampler.render(module.field, rays, FIRST)
    keys = ("origins", "directions", "times", "background")
    flat = sampler.renderer.render(module.field, *(rays[key] for key in keys))
    for level in flat.levels:
        gap = level.edges.diff(dim=1)
        torch.testing.assert_close(gap, gap.mean().expand_as(gap), atol=1e-5, rtol=1e-4)
    assert "proposals.exponent" in module.state_dict()


def test_rates_rise_and_fall_as_published(tmp_path):
    for warmup, final in itertools.product([1, 512, 2000], [0.0, 0.1]):
        for step in (0, warmup // 2, warmup - 1, warmup, 10 * warmup):
            for progress in (0.0, 0.25, 0.5, 1.0):
                down = final + (1 - final) * (1 + math.cos(math.pi * progress)) / 2
                expected = down * min(1, (step + 1) / warmup)
                found = warm_cosine(step, progress, warmup=warmup, final=final)
                case = warmup, final, step, progress
                assert found == pytest.approx(expected, abs=1e-12), case
    kplanes, _ = module_of(tmp_path, "model=kplanes", *KPLANES, *PROPOSAL, "model.warmup_steps=512")
    assert kplanes.model.rate_factor(255, 0.5) == pytest.approx(0.25)
    assert kplanes.model.rate_factor(10**4, 1.0) == pytest.approx(0)


def test_tineuvox_adds_up_colours_decided_rays_and_single_samples(tmp_path):
    totals = {}
    for entropy, spread in ((0.0, 0.0), (0.3, 0.0), (0.0, 0.7), (0.001, 0.01)):
        module, rays = module_of(
            tmp_path,
            *("model=tineuvox_s", *TINEUVOX, "model.sampler.threshold=1e-30"),
            *under("model.loss", entropy=entropy, sample_colour=spread),
        )
        seen = module.sampler.render(module.field, rays, FIRST)
        losses = module.model.losses(seen, rays, FIRST)
        total, error = sum(losses.values()).detach(), error_of(seen, rays).detach()
        assert losses["colour"].item() == pytest.approx(float(error), rel=1e-6)
        single = sample_colour_error(seen.colours, rays["target"], seen.weights, seen.ray).detach()
        terms = entropy * light_entropy(seen.opacity).detach() + spread * single
        assert float(total) == pytest.approx(float(error + terms), rel=1e-5)
        totals[entropy, spread] = float(total)
    assert len(set(totals.values())) == 4


def test_tensor4d_adds_up_its_terms(tmp_path, monkeypatch):
    distance = 0.02
    for weights in [(0.2, 0, 0, True), (0, 0.3, 0, True), (0, 0, 5, True), (0, 0, 0, False)]:
        eikonal, opacity, smoothness, masked = weights
        module, rays = module_of(
            tmp_path,
            *("model=tensor4d", *TENSOR4D, *NEUS),
            *under("model.loss", eikonal=eikonal, opacity=opacity, masked=str(masked).lower()),
            *under("model.loss", smoothness=smoothness, smoothness_distance=distance),
        )
        # Features that change by 3 per unit of length, whichever way.
        monkeypatch.setattr(module.field, "features", lambda places: 3 * places)
        monkeypatch.setattr(
            module.field, "distance", lambda places: (places.norm(dim=1) - 0.5, places.repeat(1, 8))
        )
        seen = module.sampler.render(module.field, rays, FIRST)
        total = sum(module.model.losses(seen, rays, FIRST).values())
        mask = rays["alpha"]
        expected = masked_colour_error(
            seen.colour, rays["target"], mask if masked else torch.ones_like(mask)
        )
        expected = expected + eikonal * eikonal_error(seen.slopes, len(seen.samples))
        expected = expected + opacity * silhouette_error(seen.opacity, mask)
        change = (3 * distance) ** 2 / 3 * float(seen.weights.sum()) / len(mask)
        expected = expected.item() + smoothness * change
        assert float(total) == pytest.approx(expected, rel=1e-4), weights
        assert change > 0, weights
