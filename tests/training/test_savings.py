"""Skipped samples change images by less than 0.05 dB; the cost of a step is unchanged."""

from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch

from tests.training.runs import small_config
from xplanes.evaluation.runs import TrainedRun, load_run
from xplanes.files import read_rows
from xplanes.rendering.grid_renderer import OccupancySampler
from xplanes.run import run
from xplanes.training.scores import mean, score_view

BOUND = 0.05
"""In dB."""

SAMPLES = 6000


@dataclass
class Watched:
    """A run, and the rays and samples of its steps."""

    run: TrainedRun
    steps: list[tuple[int, int]]


@pytest.fixture(scope="module")
def watched(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Watched:
    folder = tmp_path_factory.mktemp("savings")
    steps: list[tuple[int, int]] = []
    render = OccupancySampler.render

    def note(self, field, rays, state):
        found = render(self, field, rays, state)
        steps.append((len(rays["times"]), len(found.samples)))
        return found

    # Outside the silhouettes the field keeps its initial values.
    config = small_config(
        scenes,
        "model.sampler.silhouettes=false",
        "trainer.max_steps=200",
        "model.decoder_lr=0.02",
        "model.rays.per_batch=2048",
        f"model.rays.samples_per_batch={SAMPLES}",
        "callbacks.evaluation.at=[0]",
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OccupancySampler, "render", note)
        run(config, folder / "run", [], resume=False)
    return Watched(load_run(folder / "run", device="cpu"), steps)


def psnr_of(trained: TrainedRun, renderer) -> float:
    return mean(
        [
            score_view(
                trained.module.field, renderer, trained.frame, trained.views, index, torch.ones(3)
            )[0].psnr
            for index in range(len(trained.views))
        ]
    )


def test_a_saving_costs_less_than_its_bound(watched: Watched) -> None:
    trained = watched.run
    renderer = trained.module.renderer
    whole = replace(renderer, skip_empty=False, occlusion=0.0)
    rays = trained.frame.rays(*trained.views.image_rays(0))
    given = (*rays, torch.full((len(rays[0]),), float(trained.views.times[0])), torch.ones(3))
    with torch.no_grad():
        kept = len(renderer.render(trained.module.field, *given).samples)
        every = len(whole.render(trained.module.field, *given).samples)
    psnr = psnr_of(trained, renderer)
    assert psnr > 15
    for off in ({"skip_empty": False}, {"occlusion": 0.0}):
        other = replace(renderer, **off)
        with torch.no_grad():
            without = len(other.render(trained.module.field, *given).samples)
        assert kept < without <= every, off
        assert abs(psnr - psnr_of(trained, other)) <= BOUND, off


def test_training_improves_the_scored_views(watched: Watched) -> None:
    rows = read_rows(watched.run.path / "curve.csv")
    assert [int(row["step"]) for row in rows] == [0, 200]
    assert float(rows[-1]["psnr"]) > float(rows[0]["psnr"]) + 8


def test_rays_of_a_step_follow_its_samples(watched: Watched) -> None:
    first, last = watched.steps[15:35], watched.steps[-50:]
    assert mean([rays for rays, _ in last]) > 1.3 * mean([rays for rays, _ in first])
    for _, samples in watched.steps[20:]:
        assert 0.6 * SAMPLES < samples < 1.5 * SAMPLES
