"""Gaussians and their initialisations against six planes, after equal seconds of one core.

    python benchmarks/gaussians.py [--lego FOLDER] [--seconds 12 24] [--work FOLDER] [--only CASE]

Writes docs/results/gaussians.md and gaussians.csv. Seconds are those that the process
has computed on one thread, so that other programs on the machine do not count; the initialisation's
are among them; after the second number of seconds, 4D-GS on the hull and from a field alone are
compared. Runs kept in the work folder are not repeated; ``--only`` makes the runs of one case
and no tables.
"""

import os

os.environ.update(OMP_NUM_THREADS="1", NUMBA_NUM_THREADS="1")

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.callbacks import Callback
from runner import RESULTS, command, lego, machine, markdown

from xplanes.config import compose_plain
from xplanes.fields.gaussians import Gaussians
from xplanes.files import write_json, write_rows, write_text
from xplanes.scenes.datamodule import SceneDataModule
from xplanes.scenes.views import Views
from xplanes.training.evaluation import ViewScore, mean_scores, render_view, score_view
from xplanes.training.fit import Trainer
from xplanes.training.module import RadianceModule

INITIALISATIONS = {
    "hull": ("model.points=silhouettes",),
    "random points": ("model.points=random",),
    "field": ("lrm=field",),
}
MODELS = {
    "six_planes, random planes": ("model=six_planes", "lrm=none"),
    **{
        f"{model}, {name}": (f"model={model}", *how)
        for model in ("gaussians_hexplane", "gaussians_deform", "gaussians_spacetime")
        for name, how in INITIALISATIONS.items()
    },
}
LONGER = ("gaussians_hexplane, hull", "gaussians_hexplane, field")
COLUMNS = ("scene", "model", "psnr", "ssim", "first psnr", "initialisation s", "seconds", "steps")
COLUMNS += ("gaussians", "ms per view")


class Computed(Callback):
    """Ends training after so many seconds of this process; schedules follow its ``progress``."""

    def __init__(self, seconds: float) -> None:
        self.budget, self.begun = seconds, 0.0

    @property
    def spent(self) -> float:
        return time.process_time() - self.begun

    @property
    def progress(self) -> float:
        return min(1.0, self.spent / self.budget) if self.begun else 0.0

    def begin(self) -> None:
        """Count from now on."""
        self.begun = time.process_time()

    def on_train_batch_end(self, trainer: Any, *_: Any) -> None:
        trainer.should_stop = self.spent >= self.budget


def measure(overrides: list[str], seconds: float) -> dict[str, Any]:
    """Train once, and score all views of the split."""
    config = compose_plain("train", overrides)
    data, module = SceneDataModule(config["data"], seed=0), RadianceModule(config)
    clock = Computed(seconds)
    with tempfile.TemporaryDirectory() as folder:
        trainer = Trainer(
            accelerator="cpu",
            callbacks=[clock],
            default_root_dir=folder,
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            limit_val_batches=0,
        )
        data.setup("fit")
        views = data.read_split(data.test_split)
        clock.begin()
        module.build(data.scene)
        prepared = clock.spent
        first = mean_scores(_scores(module, data, views))
        clock.begun = time.process_time() - prepared
        trainer.train(module, data)
        spent = clock.spent
    scores = _scores(module, data, views)
    seen = (module.field, module.renderer, module.frame, views)
    began = time.process_time()
    for index in range(len(views)):
        render_view(*seen, index, data.scene.background)
    return {
        **mean_scores(scores),
        "first psnr": first["psnr"],
        "initialisation s": prepared,
        "steps": trainer.global_step,
        "seconds": spent,
        "ms per view": 1000 * (time.process_time() - began) / len(views),
        "gaussians": len(module.field) if isinstance(module.field, Gaussians) else None,
    }


def _scores(module: RadianceModule, data: SceneDataModule, views: Views) -> list[ViewScore]:
    """Scores of all views of the split."""
    seen = (module.field, module.renderer, module.frame, views)
    return [score_view(*seen, index, data.scene.background)[0] for index in range(len(views))]


def cases(folder: Path | None) -> dict[str, list[str]]:
    """Overrides of the scenes by name."""
    found = {}
    if folder is not None:
        found |= {f"lego, {px} px": [*lego(folder), f"data.resolution={px}"] for px in (100, 200)}
    for scene in ("excavator", "walker"):
        found[f"{scene}, 100 px"] = [f"data.scene={scene}", "data.resolution=100"]
    return found


def _begins(rows: list[dict[str, Any]]) -> str:
    """A table of what the hull's alternatives give, scene by scene and model by model."""
    found = {(row["budget"], row["scene"], row["model"]): row["psnr"] for row in rows}
    lines = []
    for seconds, scene, name in found:
        model, _, begin = name.rpartition(", ")
        if begin == "hull":
            hull = found[seconds, scene, name]
            others = [
                found.get((seconds, scene, f"{model}, {n}")) for n in list(INITIALISATIONS)[1:]
            ]
            gains = ["" if psnr is None else f"{psnr - hull:+.2f}" for psnr in others]
            lines.append((seconds, scene, model, f"{hull:.2f}", *gains))
    return markdown(("seconds", "scene", "model", *INITIALISATIONS), lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lego", type=Path)
    parser.add_argument("--seconds", type=float, nargs="+", default=[12.0, 24.0])
    parser.add_argument("--work", type=Path, default=Path(tempfile.gettempdir()) / "gaussians")
    parser.add_argument("--only")
    options = parser.parse_args()
    torch.set_num_threads(1)
    # Loops are compiled on first use.
    measure(["model=six_planes", "lrm=none", "data.resolution=16"], 0.2)
    rows = []
    for number, seconds in enumerate(options.seconds):
        for scene, where in cases(options.lego).items():
            for model, how in MODELS.items():
                case = f"{scene}, {model}"
                if options.only not in (None, case) or (number and model not in LONGER):
                    continue
                path = options.work / f"{case}, {seconds:g} s.json"
                if not path.is_file():
                    made = [*where, *how, "preparation.cache=null"]
                    write_json(path, measure(made, seconds))
                named = {"scene": scene, "model": model, "budget": f"{seconds:g}"}
                rows.append(named | json.loads(path.read_text()))
    if options.only is not None:
        return
    digits = {"psnr": 2, "ssim": 4, "first psnr": 2, "initialisation s": 1, "seconds": 1}
    digits["ms per view"] = 0
    table = [
        tuple(
            f"{row[c]:.{digits[c]}f}" if c in digits else "" if row[c] is None else f"{row[c]}"
            for c in COLUMNS
        )
        for row in rows
    ]
    begins = _begins(rows)
    write_rows(RESULTS / "gaussians.csv", COLUMNS, table)
    text = (
        "# Gaussians against six planes\n\nSeconds are of one core, and each run's "
        "initialisation is among them; seed 0; scored on the test split of demo scenes and the val "
        "split of lego. Gaussians begin on the silhouettes' hull (`model.points=silhouettes`, the "
        "default), anywhere (`model.points=random`), or on the surfaces of a six-plane field that "
        "is trained first (`lrm=field`). `first psnr` is that of the initial model.\n\n"
        f"{markdown(COLUMNS, table)}\n\n## PSNR of each initialisation\n\n"
        f"Differences in dB from the hull.\n\n{begins}\n\n{machine()}\n\n    {command()}\n"
    )
    write_text(RESULTS / "gaussians.md", text)


if __name__ == "__main__":
    main()
