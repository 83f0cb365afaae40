"""Small runs for tests: composed like the command line, trained in this process."""

from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir

from xplanes.config import CONF, register_schemas, to_plain

SMALL = (
    "lrm=none",
    "data.resolution=32",
    "data.train_views=10",
    "data.test_views=3",
    "data.val_views=2",
    "model.resolution=24",
    "model.channels=8",
    "model.decoder.width=32",
    "sampler.grid_resolution=24",
    "sampler.samples=64",
    "sampler.update_cells=512",
    "sampler.coarse_steps=10",
    "sampler.sweep_at=[15]",
    "trainer.accelerator=cpu",
    "trainer.rays_per_batch=256",
    "trainer.samples_per_batch=4096",
    "trainer.max_seconds=null",
    "trainer.max_steps=40",
    "trainer.checkpoint_every=10",
    "trainer.evaluate_at=[0,0.5]",
    "trainer.media=false",
)


def small_config(root: Path, *overrides: str) -> dict[str, Any]:
    """A configuration that trains in seconds, as plain builtins."""
    register_schemas()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("train", [f"data.root={root}", *SMALL, *overrides])
    return to_plain(config)
