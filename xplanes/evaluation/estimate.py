"""How long a run will take: measured before its first step, and said in its header."""

import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from lightning.fabric.utilities import move_data_to_device

from xplanes.backend import synchronize
from xplanes.evaluation.render import run_track
from xplanes.experiment import Experiment
from xplanes.rendering.base import RayRenderer
from xplanes.rendering.behind import background_colour
from xplanes.scenes.datamodule import SceneDataModule
from xplanes.training.evaluation import affordable, scored_before_training
from xplanes.training.module import RadianceModule

LONG = 30.0  # Seconds of scores and images above which the header may say how to shorten them.


class Estimate(NamedTuple):
    """Expected durations, measured before the first step.

    Attributes:
        step: Seconds per step, once the number of rays fits the batch's budget of samples.
        first_ray: Seconds per ray of an image of the untrained field.
        later_ray: Seconds per ray once surfaces are opaque and empty space is pruned.
        pruned_at: First step at which empty space is pruned.
        early: Least share of the extra time of an untrained field that remains until that step.
        passing: Share of it that remains after that step.
    """

    step: float
    first_ray: float
    later_ray: float
    pruned_at: int
    early: float
    passing: float

    def ray(self, step: float) -> float:
        """Seconds per ray of an image after a number of steps."""
        pruned = step >= self.pruned_at
        share = self.passing if pruned else max(0.5 ** (step / HALF_OPAQUE), self.early)
        return self.later_ray + (self.first_ray - self.later_ray) * share


WHOLE_STEP = 1.45
"""Ratio of a step's time to that of rendering its rays and backpropagating.

The rest is drawing rays, the optimiser, regularisers, the occupancy grid and Lightning's loop: a
third of the training of the demo scene (docs/results/records/time.json).
"""

HALF_OPAQUE = 85
"""Steps after which the extra time per image of an untrained field halves, as surfaces form.

Measured on a capture with surroundings, in which no cell is pruned in the first 800 steps.
"""

PASSING, PASSING_PRUNED = 0.25, 0.15
"""Assumed shares of rays that meet no surface, and have samples: until empty space is pruned, and
afterwards in scenes with surroundings.

Measured until then: 0.47 on a capture in front of a black backdrop, 0 on one inside a room;
afterwards: 0.13 for a scene on a table, 0 inside the room.
"""

RIG_PASSING = 0.1
"""Added to both in rigs.

Measured on five rigs, until then: 0.5; afterwards: from 0.15 inside a room to 0.4 in the open.
"""

OPAQUE = 1000.0
"""Factor on the density that makes an untrained field about as opaque as a trained one."""

BEHIND = 0.5
"""Assumed share of an image's rays that reach the background."""


def estimate(module: RadianceModule, data: SceneDataModule) -> Estimate:
    """Time a step, and some rays of a test view.

    In a trained field surfaces are opaque, so rays end after a few samples. A copy of the field
    with a much higher density approximates it.
    """
    frame, field, renderer = module.frame, module.field, module.renderer
    assert frame is not None
    device = next(field.parameters()).device
    batches = data.batches_for(module, 0)
    rays = move_data_to_device(batches.draw(0, module.rays), device)
    if module.rays:  # Batches soon have as many rays as the budget of samples allows.
        with torch.no_grad():
            samples = module.sampler.render(field, rays, module.state).samples
        count = module.ray_settings.fitting(module.rays, int(samples.count))
        rays = move_data_to_device(batches.draw(0, count), device)
    views = data.scene.splits[data.test_split]
    camera, seen_at = views.camera(0), (float(views.times[0]), data.scene.background.to(device))
    pixels = camera.height * camera.width

    def step() -> None:
        module.sampler.render(field, rays, module.state).colour.sum().backward()
        module.zero_grad(set_to_none=True)

    taken = WHOLE_STEP * _seconds(step, device)
    if not isinstance(renderer, RayRenderer):
        ray = _seconds(lambda: renderer.view(field, frame, camera, *seen_at), device) / pixels
        return Estimate(taken, ray, ray, 0, 0.0, 0.0)
    chosen = torch.linspace(0, pixels - 1, min(renderer.rays_at_once, pixels)).long()
    origins, directions = (part[chosen].to(device) for part in frame.rays(*camera.rays()))
    first = later = _seconds(lambda: renderer.image(field, origins, directions, *seen_at), device)
    more = RIG_PASSING if module.site.is_rig else 0.0
    passing = 0.0
    if pruned_at := module.sampler.pruned_at:
        solid = field.masked(lambda points: points.new_full(points.shape[:1], OPAQUE))
        later = _seconds(lambda: renderer.image(solid, origins, directions, *seen_at), device)
        if (background := getattr(field, "background", None)) is not None:
            with torch.no_grad():
                seen = origins, directions
                later += BEHIND * _seconds(lambda: background_colour(background, *seen), device)
            passing = PASSING_PRUNED + more
    first, later = first / len(chosen), later / len(chosen)
    return Estimate(taken, first, later, pruned_at, PASSING + more, passing)


def _seconds(work: Callable[[], Any], device: torch.device) -> float:
    """The shorter of two timings: the first call allocates memory and compiles GPU kernels."""
    spent = []
    for _ in range(2):
        began = time.perf_counter()
        work()
        synchronize(device)
        spent.append(time.perf_counter() - began)
    return min(spent)


def estimated(
    experiment: Experiment,
    data: SceneDataModule,
    module: RadianceModule,
    expected: Estimate,
    spent: float,
    done: int = 0,
    trained: float = 0.0,
) -> str:
    """The run's expected duration as text, ``spent`` seconds after its start.

    Args:
        experiment: The settings.
        data: The data.
        module: The module, with its field.
        expected: Expected durations.
        spent: Seconds so far.
        done: Steps before a resume.
        trained: Seconds of training before it.
    """
    trainer = experiment.trainer
    steps = float(trainer.get("max_steps", -1)) if trainer.get("max_steps", -1) > 0 else math.inf
    seconds = trainer.get("max_seconds") or math.inf
    train = max(0.0, min((steps - done) * expected.step, seconds - trained))
    final = data.scene.splits[data.test_split]
    views = data.scene.splits[data.validation_split or data.test_split]
    at = experiment.callbacks.get("evaluation", {}).get("at", [])
    # A number of views, or a share of them.
    limit = affordable(trainer.get("limit_val_batches", 1.0), views)
    count = min(limit, len(views)) if isinstance(limit, int) else int(limit * len(views))
    pixels = views.height * views.width * count
    whole = done + train / expected.step  # Evaluations before a resume are not repeated.
    shares = {*at, 1.0} - (set() if scored_before_training(module.site) else {0.0})
    steps_at = [
        share * whole if share else 0.0 for share in shares if not done or share * whole > done
    ]
    images = sum(pixels * expected.ray(step) for step in steps_at)
    if final is not views or count < len(views):
        images += final.height * final.width * len(final) * expected.ray(whole)
    if experiment.media:
        assert module.frame is not None
        cameras = run_track(data.scene, module.frame).cameras
        images += sum(each.height * each.width for each in cameras) * expected.ray(whole)
    parts = f"{spent:.0f} s so far, {{}} of training, {images:.0f} s of scores and images"
    if train == math.inf:
        return parts.format("no end")
    text = f"{spent + train + images:.0f} s in all: {parts.format(f'{train:.0f} s')}"
    if images > max(train, LONG):
        text += (
            "\n         scores and images take longer than training; to shorten them: media=false "
            '"callbacks.evaluation.at=[1]" data.eval_views=4'
        )
    return text
