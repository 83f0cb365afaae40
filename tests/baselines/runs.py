"""Small runs of the baselines, composed like the command line."""

from pathlib import Path
from typing import Any

from tests.training.runs import changed

SCENE = (
    "data.resolution=12",
    "data.train_views=8",
    "data.test_views=2",
    "data.val_views=1",
    "trainer.accelerator=cpu",
    "model.precision=32",
    "trainer.max_seconds=null",
    "callbacks.checkpoints.every=10",
    "callbacks.evaluation.at=[0,0.5]",
    "media=false",
)

KPLANES = (
    "model.resolution=8",
    "model.scales=[1,2]",
    "model.channels=4",
    "model.width=16",
    "model.warmup_steps=10",
    "model.rays.per_batch=128",
)

PROPOSAL = (
    "model.sampler.resolutions=[8,12]",
    "model.sampler.time_resolution=4",
    "model.sampler.channels=4",
    "model.sampler.width=16",
    "model.sampler.proposal_samples=[32,24]",
    "model.sampler.samples=16",
    "model.sampler.anneal_steps=20",
)

OCCUPANCY = (
    "model.sampler.grid_resolution=16",
    "model.sampler.samples=48",
    "model.sampler.update_cells=256",
)


def baseline_config(root: Path, *overrides: str) -> dict[str, Any]:
    """A configuration that trains in seconds, as plain builtins."""
    return changed((), f"data.root={root}", *SCENE, *overrides)


TINEUVOX = (
    "model.resolution=20",
    "model.width=16",
    "model.grow_at=[8,30]",
    "model.sampler.step=1.0",
    "model.rays.per_batch=128",
)

TENSOR4D = (
    "model.resolution=12",
    "model.fine_resolution=16",
    "model.time_resolution=6",
    "model.channels=4",
    "model.fine_channels=4",
    "model.width=24",
    "model.point_octaves=3",
    "model.fine_from=15",
    "model.blur_until=30",
    "model.blur_resolution=8",
    "model.warmup_steps=10",
    "model.learning_rate=0.003",
    "model.plane_learning_rate=0.02",
)

NEUS = ("model.rays.per_batch=64", "model.sampler.samples=16", "model.sampler.more_samples=9")
