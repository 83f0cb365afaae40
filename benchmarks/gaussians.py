"""Gaussians against six planes after equal seconds of one core.

    python benchmarks/gaussians.py [--lego FOLDER] [--seconds 30] [--work FOLDER] [--only CASE]

Writes docs/results/gaussians.md and gaussians.csv. Seconds are those that the process
has computed in training, on one thread, so that other programs on the machine do not count. Runs
kept in the work folder are not repeated; ``--only`` makes the runs of one case and no tables.
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
from lightning import LightningModule
from lightning.pytorch.callbacks import Callback
from runner import RESULTS, command, lego, machine, markdown

from xplanes.config import compose_plain
from xplanes.files import write_json, write_rows, write_text
from xplanes.scenes.datamodule import SceneDataModule
from xplanes.training.evaluation import mean_scores, render_view, score_view
from xplanes.training.fit import Trainer
from xplanes.training.module import RadianceModule

MODELS = {
    "six_planes, random": ("model=six_planes", "lrm=none"),
    "gaussians_hexplane": ("model=gaussians_hexplane",),
    "gaussians_hexplane, random points": ("model=gaussians_hexplane", "model.points=random"),
}
COLUMNS = ("scene", "model", "psnr", "ssim", "steps", "seconds", "ms per view", "parameters")


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

    def on_train_start(self, trainer: Any, pl_module: LightningModule) -> None:
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
        module.build(data.scene)
        trainer.train(module, data)
        spent = clock.spent
    views = data.read_split(data.test_split)
    seen = (module.field, module.renderer, module.frame, views)
    scores = [score_view(*seen, index, data.scene.background)[0] for index in range(len(views))]
    began = time.process_time()
    for index in range(len(views)):
        render_view(*seen, index, data.scene.background)
    return {
        **mean_scores(scores),
        "steps": trainer.global_step,
        "seconds": spent,
        "ms per view": 1000 * (time.process_time() - began) / len(views),
        "parameters": sum(p.numel() for p in module.parameters()),
    }


def cases(folder: Path | None) -> dict[str, list[str]]:
    """Overrides of the scenes by name."""
    found = {}
    if folder is not None:
        found |= {f"lego, {px} px": [*lego(folder), f"data.resolution={px}"] for px in (100, 200)}
    for scene in ("excavator", "walker"):
        found[f"{scene}, 100 px"] = [f"data.scene={scene}", "data.resolution=100"]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lego", type=Path)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--work", type=Path, default=Path(tempfile.gettempdir()) / "gaussians")
    parser.add_argument("--only")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for scene, where in cases(options.lego).items():
        for model, how in MODELS.items():
            case = f"{scene}, {model}"
            if options.only not in (None, case):
                continue
            path = options.work / f"{case}, {options.seconds:g} s.json"
            if not path.is_file():
                write_json(path, measure([*where, *how], options.seconds))
            rows.append({"scene": scene, "model": model, **json.loads(path.read_text())})
    if options.only is not None:
        return
    digits = {"psnr": 2, "ssim": 4, "seconds": 1, "ms per view": 0}
    table = [
        tuple(f"{row[c]:.{digits[c]}f}" if c in digits else f"{row[c]}" for c in COLUMNS)
        for row in rows
    ]
    write_rows(RESULTS / "gaussians.csv", COLUMNS, table)
    text = (
        f"# Gaussians against six planes\n\n{options.seconds:g} s of one core for each training, "
        "random initialisation, seed 0; scored on the test split of demo scenes and the val split "
        f"of lego.\n\n{markdown(COLUMNS, table)}\n\n{machine()}\n\n    {command()}\n"
    )
    write_text(RESULTS / "gaussians.md", text)


if __name__ == "__main__":
    main()
