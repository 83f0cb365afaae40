"""Skipped samples change images by less than 0.05 dB."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from xplanes.evaluation.runs import load_run
from xplanes.training.scores import mean, score_view

BOUND = 0.05
"""In dB."""


@pytest.mark.parametrize("off", [{"skip_empty": False}, {"occlusion": 0.0}], ids=str)
def test_a_saving_costs_less_than_its_bound(trained_run: Path, off: dict) -> None:
    trained = load_run(trained_run, device="cpu")
    field, renderer, views = trained.module.field, trained.module.renderer, trained.views
    # The grid of a short run has seen little: here it is that of the field.
    for _ in range(3):
        renderer.grid.sweep(field, torch.Generator().manual_seed(0))
    rays = trained.frame.rays(*views.image_rays(0))
    times = torch.full((len(rays[0]),), float(views.times[0]))
    white = torch.ones(3)

    def look(renderer) -> tuple[int, float]:
        """Samples of a view, and the PSNR of all."""
        with torch.no_grad():
            samples = len(renderer.render(field, *rays, times, white).samples)
        scores = [
            score_view(field, renderer, trained.frame, views, index, white)[0].psnr
            for index in range(len(views))
        ]
        return samples, mean(scores)

    (kept, psnr), (without, other) = look(renderer), look(replace(renderer, **off))
    assert kept <= without
    assert "skip_empty" not in off or kept < without
    assert abs(psnr - other) <= BOUND
