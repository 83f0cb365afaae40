"""Where a run's wall time goes, stage by stage, from the start of Python to its last line.

    python benchmarks/where_time_goes.py [--name default] [key=value ...]

Writes results/time_NAME.md beside this file. The functions of each stage are timed as they are
called, without what they call in other stages; what no stage claims is shown too. The first run
after an installation compiles loops and renders the scene, which counts: run it twice.
"""

import os
import time

from xplanes.process import defaults

os.environ.update(defaults(os.environ))

import argparse
import functools
import importlib
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
    ("compiled loops and first call", "xplanes.training.fit", "warm_up"),
    ("drawing rays", "xplanes.scenes.batches", "RayBatches.draw"),
    ("marching", "xplanes.rendering.grid_renderer", "march"),
    ("lookup", "xplanes.fields.lookup_numba", "gather"),
    ("lookup, backward", "xplanes.fields.lookup_numba", "scatter_space"),
    ("lookup, backward", "xplanes.fields.lookup_numba", "scatter_time"),
    ("lookup, backward", "xplanes.fields.lookup_numba", "product_gradients"),
    ("decoder", "xplanes.fields.decoder", "Decoder.forward"),
    ("compositing", "xplanes.rendering.grid_renderer", "composite"),
    ("rest of forward", "xplanes.rendering.grid_renderer", "GridRenderer.render"),
    ("rest of backward", "lightning.pytorch", "Strategy.backward"),
    ("optimiser", "torch.optim", "Adam.step"),
    ("regularisers", "xplanes.models.x_planes", "XPlanesModel.regularise"),
    ("occupancy grid", "xplanes.rendering.grid_renderer", "OccupancySampler.update"),
    ("occupancy grid", "xplanes.rendering.grid_renderer", "OccupancySampler.observe"),
    ("rest of the step", "xplanes.training.module", "RadianceModule.training_step"),
    ("scoring", "xplanes.training.module", "RadianceModule.validation_step"),
    ("checkpoints", "xplanes.training.checkpoints", "Checkpoints._save_checkpoint"),
    ("TensorBoard", "xplanes.training.module", "RadianceModule._log_terms"),
    ("TensorBoard", "lightning.pytorch.loggers.tensorboard", "TensorBoardLogger.log_metrics"),
    ("video", "xplanes.evaluation.render", "write_orbit"),
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
    parser.add_argument("--name", default="default")
    parser.add_argument("overrides", nargs="*")
    args = parser.parse_args()

    from runner import RESULTS, command, machine, markdown, measure

    from xplanes.files import write_text

    watch = Watch()
    for stage in STAGES:
        watch.watch(*stage)
    imported = time.perf_counter() - BEGAN
    with tempfile.TemporaryDirectory() as work:
        metrics = measure(args.overrides, Path(work)).metrics
    whole = time.perf_counter() - BEGAN
    found = {"imports": imported, **watch.seconds}
    found["not accounted for"] = whole - sum(found.values())
    rows = [
        (name, f"{spent:.2f}", f"{100 * spent / whole:.1f}%", watch.calls.get(name, ""))
        for name, spent in sorted(found.items(), key=lambda item: -item[1])
    ]
    from figures import bars, panels, save

    figure, (axes,) = panels(1, 7, 0.22 * len(rows) + 0.6)
    bars(axes, [row[0] for row in rows], {"": [float(row[1]) for row in rows]})
    axes.set_xlabel("seconds")
    save(figure, f"time_{args.name}")
    page = f"""# Where the time goes: {args.name}

    {command()}

{whole:.1f} s in all, {metrics["step"]} steps, PSNR {metrics["test"]["psnr"]:.2f}; {machine()}.
Times exclude nested stages.

![Seconds of each stage](time_{args.name}.png)

{markdown(COLUMNS, rows)}
"""
    write_text(RESULTS / f"time_{args.name}.md", page)
    print(page)


if __name__ == "__main__":
    main()
