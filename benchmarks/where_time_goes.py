"""Where a run's wall time goes, stage by stage, from the start of Python to its last line.

    python benchmarks/where_time_goes.py [key=value ...]

Prints JSON in its last line. The functions of each stage are timed as they are called, without
what they call in other stages; what no stage claims is shown too. The first run after an
installation compiles loops and renders the scene, which counts: run it twice.
"""

import os
import time

from xplanes.process import defaults

os.environ.update(defaults(os.environ))

import argparse
import functools
import importlib
import json
import tempfile
from collections import defaultdict
from pathlib import Path
from typing import Any

BEGAN = time.perf_counter()

STAGES = (
    ("scene", "xplanes.scenes.source", "SceneSettings.read"),
    ("preparation", "xplanes.preparation.sources", "LRMInitialiser.initialise"),
    ("preparation", "xplanes.preparation.sources", "FileInitialiser.initialise"),
    ("preparation: weights", "xplanes.preparation.sources", "BundledLRMSettings.load"),
    ("preparation: weights", "xplanes.preparation.sources", "PublishedLRMSettings.load"),
    ("building the model", "xplanes.training.module", "RadianceModule.build"),
    ("compiled loops and first call", "xplanes.rendering.grid_renderer", "render_one_ray"),
    ("compiled loops and first call", "xplanes.run", "warm_up_loops"),
    ("drawing rays", "xplanes.scenes.batches", "RayBatches.draw"),
    ("marching", "xplanes.rendering.grid_renderer", "march"),
    ("lookup", "xplanes.fields.lookup_numba", "gather"),
    ("lookup, backward", "xplanes.fields.lookup_numba", "scatter_space"),
    ("lookup, backward", "xplanes.fields.lookup_numba", "scatter_time"),
    ("lookup, backward", "xplanes.fields.lookup_numba", "product_gradients"),
    ("decoder", "xplanes.fields.decoder", "Decoder.forward"),
    ("compositing", "xplanes.rendering.grid_renderer", "composite"),
    ("rest of forward", "xplanes.rendering.grid_renderer", "GridRenderer.render"),
    ("rest of backward", "lightning.pytorch.strategies", "Strategy.backward"),
    ("optimiser", "torch.optim", "Adam.step"),
    ("regularisers", "xplanes.models.x_planes", "XPlanesModel.regularise"),
    ("occupancy grid", "xplanes.rendering.grid_renderer", "OccupancySampler.update"),
    ("occupancy grid", "xplanes.rendering.grid_renderer", "OccupancySampler.observe"),
    ("rest of the step", "xplanes.training.module", "RadianceModule.training_step"),
    ("scoring", "xplanes.training.module", "RadianceModule.validation_step"),
    ("checkpoints", "xplanes.training.checkpoints", "Checkpoints._save_checkpoint"),
    ("TensorBoard", "lightning.pytorch.loggers.tensorboard", "TensorBoardLogger.log_metrics"),
    ("video", "xplanes.evaluation.render", "write_run_video"),
    ("Lightning's loop", "xplanes.training.fit", "Trainer.train"),
)
"""Name of the stage, module and function."""

COLUMNS = ("stage", "seconds", "share", "calls")


class Watch:
    """Seconds that belong to each stage alone."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.calls: dict[str, int] = defaultdict(int)
        self._inner = [0.0]

    def watch(self, stage: str, module: str, path: str) -> None:
        """Replace a function by one that is timed."""
        owner: Any = importlib.import_module(module)
        *parts, last = path.split(".")
        for part in parts:
            owner = getattr(owner, part)
        function = getattr(owner, last)

        @functools.wraps(function)
        def timed(*args: Any, **options: Any) -> Any:
            began = time.perf_counter()
            self._inner.append(0.0)
            try:
                return function(*args, **options)
            finally:
                spent = time.perf_counter() - began
                self.seconds[stage] += spent - self._inner.pop()
                self.calls[stage] += 1
                self._inner[-1] += spent

        setattr(owner, last, timed)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("overrides", nargs="*", default=["preparation.cache=null"])
    args = parser.parse_args()

    from runner import measure

    watch = Watch()
    for stage in STAGES:
        watch.watch(*stage)
    imported = time.perf_counter() - BEGAN
    with tempfile.TemporaryDirectory() as work:
        metrics = measure(args.overrides, Path(work)).metrics
    found = {"imports": imported, **watch.seconds}
    found["not accounted for"] = time.perf_counter() - BEGAN - sum(found.values())
    about = {"steps": metrics["step"], "psnr": metrics["test"]["psnr"]}
    rows = [
        {"case": name, "seconds": spent, "calls": watch.calls.get(name), **about}
        for name, spent in found.items()
    ]
    print(json.dumps({"stages": rows}))


if __name__ == "__main__":
    main()
