"""Small runs of the baselines, composed like the command line."""

from pathlib import Path
from typing import Any

from tests.training.runs import changed, under

SCENE = (
    *under("data", resolution=12, train_views=8, test_views=2, val_views=1),
    *under("trainer", accelerator="cpu", max_seconds="null"),
    *("model.precision=32", "media=false"),
    *("callbacks.checkpoints.every=10", "callbacks.evaluation.at=[0,0.5]"),
)

KPLANES = (
    *under("model", resolution=8, scales=[1, 2], channels=4, width=16, warmup_steps=10),
    "model.rays.per_batch=128",
)

PROPOSAL = (
    *under("model.sampler", resolutions=[8, 12], time_resolution=4, channels=4, width=16),
    *under("model.sampler", proposal_samples=[32, 24], samples=16, anneal_steps=20),
)

OCCUPANCY = under("model.sampler", grid_resolution=16, samples=48, update_cells=256)

TINEUVOX = (
    *under("model", resolution=20, width=16, grow_at=[8, 30]),
    *("model.sampler.step=1.0", "model.rays.per_batch=128"),
)

TENSOR4D = (
    *under("model", resolution=12, fine_resolution=16, time_resolution=6, channels=4),
    *under("model", fine_channels=4, width=24, point_octaves=3, fine_from=15, blur_until=30),
    *under("model", blur_resolution=8, warmup_steps=10),
    *under("model", learning_rate=0.003, plane_learning_rate=0.02),
)

NEUS = ("model.rays.per_batch=64", *under("model.sampler", samples=16, more_samples=9))


def baseline_config(root: Path, *overrides: str) -> dict[str, Any]:
    """A configuration that trains in seconds, as plain builtins."""
    return changed((), f"data.root={root}", *SCENE, *overrides)
