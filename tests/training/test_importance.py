"""Importance sampling in training: from its first step on, resumed, and only where it is wanted."""

import pytest
import torch

from tests.balls import ball_scene
from tests.training.runs import also, gone_on, same_state, small_config
from xplanes.scenes import importance
from xplanes.training import module
from xplanes.training.module import RadianceModule


@pytest.fixture
def soon(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, bool]]:
    """Importance sampling from the fourth batch on; batches and whether their rays are weighted."""
    monkeypatch.setattr(module, "START", 3)
    monkeypatch.setattr(importance, "REFRESH", 3)
    drawn: list[tuple[int, bool]] = []

    def noted(module: RadianceModule, batch, _):
        drawn.append((module.batches, "weight" in batch))
        if "weight" in batch:
            assert len(batch["weight"]) == len(batch["times"])
            assert float(batch["weight"].mean()) == pytest.approx(1, abs=0.3)

    also(monkeypatch, RadianceModule, "training_step", noted, first=True)
    return drawn


def test_rays_are_weighted_from_its_first_batch_on_and_a_resumed_run_draws_the_same(tmp_path, soon):
    whole, parts = gone_on(ball_scene(), small_config(tmp_path), tmp_path, 11, 5)
    assert soon == [(batch, batch >= 3) for batch in (*range(11), *range(5, 11))]
    same_state(whole["state_dict"], parts["state_dict"])
    assert torch.equal(whole["error_map"]["sums"], parts["error_map"]["sums"])
    assert whole["error_map"]["sums"][:, 1].sum() > 0


@pytest.mark.parametrize("override", ["model.rays.error_share=0", "recipe=fair"])
def test_without_it_no_ray_is_weighted(tmp_path, soon, override):
    (end,) = gone_on(ball_scene(), small_config(tmp_path, override), tmp_path, 5)
    assert soon == [(batch, False) for batch in range(5)]
    assert end["error_map"]["sums"].numel() == 0
