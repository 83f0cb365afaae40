"""What is skipped changes pictures by less than 0.05 dB, and keeps the cost of a step."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.training.runs import small_config
from xplanes.evaluation.runs import TrainedRun, load_run
from xplanes.pipeline import run
from xplanes.training.module import RadianceModule
from xplanes.training.scoring import mean, score_view

BOUND = 0.05
"""In dB."""


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> TrainedRun:
    folder = tmp_path_factory.mktemp("savings")
    # Where silhouettes forbid to look the field is what it was at the start.
    config = small_config(
        folder, "trainer.max_steps=400", "sampler.silhouettes=false", "trainer.evaluate_at=[]"
    )
    run(config, folder / "run", [], resume=False)
    return load_run(folder / "run", device="cpu")


def psnr_of(trained: TrainedRun, renderer) -> float:
    return mean(
        [
            score_view(
                trained.module.field, renderer, trained.frame, trained.views, index, torch.ones(3)
            )[0].psnr
            for index in range(len(trained.views))
        ]
    )


@pytest.mark.parametrize("off", [{"skip_empty": False}, {"occlusion": 0.0}])
def test_a_saving_costs_less_than_its_bound(trained: TrainedRun, off) -> None:
    renderer = trained.module.renderer
    whole = replace(renderer, skip_empty=False, occlusion=0.0)
    rays = trained.frame.rays(*trained.views.image_rays(0))
    given = (*rays, torch.full((len(rays[0]),), float(trained.views.times[0])), torch.ones(3))
    with torch.no_grad():
        kept = len(renderer.render(trained.module.field, *given).samples)
        without = len(replace(renderer, **off).render(trained.module.field, *given).samples)
        every = len(whole.render(trained.module.field, *given).samples)
    assert kept < without <= every
    assert psnr_of(trained, renderer) > 15
    assert abs(psnr_of(trained, renderer) - psnr_of(trained, replace(renderer, **off))) <= BOUND


def test_rays_of_a_step_follow_its_samples(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[int, int]] = []
    count = RadianceModule._count

    def watched(self, samples, rays) -> None:
        seen.append((rays, len(samples)))
        count(self, samples, rays)

    monkeypatch.setattr(RadianceModule, "_count", watched)
    config = small_config(
        tmp_path,
        "trainer.max_steps=120",
        "trainer.rays_per_batch=2048",
        "trainer.samples_per_batch=6000",
        "trainer.evaluate_at=[]",
    )
    run(config, tmp_path / "run", [], resume=False)
    first, last = seen[15:35], seen[-50:]
    assert mean([rays for rays, _ in last]) > 1.3 * mean([rays for rays, _ in first])
    for _, samples in seen[20:]:
        assert 0.6 * 6000 < samples < 1.5 * 6000
