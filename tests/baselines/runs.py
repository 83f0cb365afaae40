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
    "trainer.precision=32",
    "trainer.max_seconds=null",
    "trainer.checkpoint_every=10",
    "trainer.evaluate_at=[0,0.5]",
    "trainer.media=false",
)

KPLANES = (
    "model.resolution=8",
    "model.scales=[1,2]",
    "model.channels=4",
    "model.width=16",
    "model.warmup_steps=10",
    "trainer.rays_per_batch=128",
)

PROPOSAL = (
    "sampler.resolutions=[8,12]",
    "sampler.time_resolution=4",
    "sampler.channels=4",
    "sampler.width=16",
    "sampler.proposal_samples=[32,24]",
    "sampler.samples=16",
    "sampler.anneal_steps=20",
)

OCCUPANCY = (
    "sampler.grid_resolution=16",
    "sampler.samples=48",
    "sampler.update_cells=256",
    "sampler.coarse_steps=0",
)


def baseline_config(root: Path, *overrides: str) -> dict[str, Any]:
    """A configuration that trains in seconds, as plain builtins."""
    return changed((), f"data.root={root}", *SCENE, *overrides)


TINEUVOX = (
    "model.resolution=20",
    "model.width=16",
    "model.grow_at=[8,30]",
    "sampler.step=1.0",
    "trainer.rays_per_batch=128",
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

NEUS = ("trainer.rays_per_batch=64", "sampler.samples=16", "sampler.more_samples=9")
