"""Skipped samples change images by less than 0.05 dB."""

from dataclasses import replace

import pytest
import torch

from tests.training.runs import scores, small_config
from xplanes.metrics import mean
from xplanes.run import run
from xplanes.tools.runs import load_run
from xplanes.training.scores import score_view

BOUND = 0.05
"""In dB."""


@pytest.mark.slow
def test_a_saving_costs_less_than_its_bound(scenes, tmp_path):
    # Outside the silhouettes the field keeps its initial values.
    config = small_config(
        scenes,
        *("model.sampler.silhouettes=false", "model.decoder_lr=0.02", "trainer.max_steps=200"),
        *("model.rays.per_batch=2048", "model.rays.samples_per_batch=6000"),
        "callbacks.evaluation.at=[0]",
    )
    run(config, tmp_path / "run", [], resume=False)
    first, last = scores(tmp_path / "run")
    assert last > first + 8
    trained = load_run(tmp_path / "run")
    field, views, white = trained.module.field, trained.views, torch.ones(3)
    rays = trained.frame.rays(*views.image_rays(0))
    times = torch.full((len(rays[0]),), float(views.times[0]))

    def look(**changes) -> tuple[int, float]:
        """Samples of a view, and the PSNR of all."""
        renderer = replace(trained.module.renderer, **changes)
        with torch.no_grad():
            samples = len(renderer.render(field, *rays, times, white).samples)
        found = [
            score_view(field, renderer, trained.frame, views, index, white)[0].psnr
            for index in range(len(views))
        ]
        return samples, mean(found)

    kept, psnr = look()
    every, _ = look(skip_empty=False, occlusion=0.0)
    assert psnr > 15
    for off in ({"skip_empty": False}, {"occlusion": 0.0}):
        without, other = look(**off)
        assert kept < without <= every, off
        assert abs(psnr - other) <= BOUND, off
