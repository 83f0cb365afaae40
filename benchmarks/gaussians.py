"""Gaussians against six planes, and their initialisations, after equal seconds of one core.

    python benchmarks/gaussians.py [--lego FOLDER] [--seconds 24] [--large 60] [--seeds 3]
        [--together 1] [--work FOLDER]

Writes docs/results/gaussians.md, gaussians.csv and gaussians.png. Seconds are those that a process
has computed on one thread, so that others do not count, and those for building the model, with its
initialisation, are among them: training and its schedules get what is left. Scenes of 400 pixels
get --large. Models are compared on test scenes of the suite and on lego with one seed (pareto.py
has demo scenes), initialisations on two demo scenes with --seeds. ``--together`` sets how many run
side by side; what the work folder holds is not repeated.
"""

import os

os.environ.update(OMP_NUM_THREADS="1", NUMBA_NUM_THREADS="1")

import argparse
import gc
import math
import statistics
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import torch
from figures import bars, panels, save
from runner import RESULTS, command, lego, machine, markdown, spread

from xplanes.baselines.gaussians.field import Gaussians
from xplanes.config import compose_plain
from xplanes.files import read_json, write_json, write_rows, write_text
from xplanes.scenes.datamodule import SceneDataModule, whole_view
from xplanes.scenes.views import Views
from xplanes.training.clock import training_seconds
from xplanes.training.fit import Trainer
from xplanes.training.module import RadianceModule
from xplanes.training.scores import ViewScore, mean_scores, render_item, score_view

time.perf_counter = time.process_time  # So that the training clock counts CPU time, too.

GAUSSIANS = ("gaussians_hexplane", "gaussians_deform", "gaussians_spacetime")
MODELS = {"six_planes": ("model=six_planes", "lrm=none")}
MODELS |= {model: (f"model={model}", "model.points=silhouettes") for model in GAUSSIANS}

INITIALISATIONS = {
    "hull": ("model.points=silhouettes",),
    "random points": ("model.points=random",),
    "field": ("lrm=field",),
}
SUITE = ("dark_test", "topology_test", "wires_test", "occlusion_test", "texture_test")
LEGO = (200, 400)
DEMOS = ("excavator", "walker")

COLUMNS = ("scene", "model", "psnr", "ssim", "first psnr", "initialisation s", "seconds", "steps")
COLUMNS += ("gaussians", "ms per view", "peak GB")
DIGITS = {"psnr": 2, "ssim": 3, "first psnr": 2, "initialisation s": 1, "seconds": 0}
DIGITS |= {"ms per view": 0, "peak GB": 1}


class Case(NamedTuple):
    """A run: what it is called, its overrides and its seconds."""

    scene: str
    model: str
    overrides: tuple[str, ...]
    seconds: float
    seed: int = 0

    @property
    def name(self) -> str:
        return f"{self.scene}, {self.model}, {self.seconds:g} s, seed {self.seed}"

    @property
    def alone(self) -> bool:
        """Whether memory is measured, in a process of its own."""
        return self.scene.startswith("lego")


def measure(
    overrides: list[str], seconds: float, seed: int = 0, *, steps: int = -1
) -> dict[str, Any]:
    """Train once, for at most this number of steps, and score all views of the split."""
    forget_peak()
    config = compose_plain("train", [*overrides, f"seed={seed}"])
    data, module = SceneDataModule(config["data"], seed=seed), RadianceModule(config)
    data.setup("fit")
    views = data.read_split(data.test_split)
    began = time.process_time()
    module.build(data.scene)
    prepared = time.process_time() - began
    first = mean_scores(_scores(module, data, views))
    with tempfile.TemporaryDirectory() as folder:
        trainer = Trainer(
            accelerator="cpu",
            max_steps=steps,
            max_seconds=seconds - prepared,
            default_root_dir=folder,
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            limit_val_batches=0,
        )
        trainer.train(module, data)
    scores = _scores(module, data, views)
    seen = (module.field, module.renderer, module.frame)
    began = time.process_time()
    for index in range(len(views)):
        render_item(*seen, whole_view(views, index, data.scene.background))
    return {
        **mean_scores(scores),
        "first psnr": first["psnr"],
        "initialisation s": prepared,
        "steps": trainer.global_step,
        "seconds": prepared + training_seconds(trainer),
        "ms per view": 1000 * (time.process_time() - began) / len(views),
        "gaussians": len(module.field) if isinstance(module.field, Gaussians) else None,
        "peak GB": None if (peak := peak_memory()) is None else peak / 1e9,
    }


def _scores(module: RadianceModule, data: SceneDataModule, views: Views) -> list[ViewScore]:
    """Scores of all views of the split."""
    seen = (module.field, module.renderer, module.frame, views)
    return [score_view(*seen, index, data.scene.background)[0] for index in range(len(views))]


def peak_memory() -> int | None:
    """Bytes that this process has held at most since `forget_peak`; None where Linux is not."""
    status = Path("/proc/self/status")
    if not status.is_file():
        return None
    lines = dict(line.split(":", 1) for line in status.read_text(encoding="utf-8").splitlines())
    return 1024 * int(lines["VmHWM"].split()[0])


def forget_peak() -> None:
    """Let `peak_memory` begin with what is held now."""
    gc.collect()
    if (file := Path("/proc/self/clear_refs")).is_file():
        file.write_text("5", encoding="utf-8")


def comparison(args: argparse.Namespace) -> list[Case]:
    """Each model on each scene."""
    scenes: dict[str, tuple[str, ...]] = {}
    for name in SUITE:
        scenes[f"{name}, 100 px"] = ("data=suite", f"data.scene={name}", "data.resolution=100")
    if args.lego is not None:
        for px in LEGO:
            scenes[f"lego (val), {px} px"] = (*lego(args.lego.resolve()), f"data.resolution={px}")
    return [
        Case(scene, model, (*where, *how), args.large if "400 px" in scene else args.seconds)
        for scene, where in scenes.items()
        for model, how in MODELS.items()
    ]


def beginnings(args: argparse.Namespace) -> list[Case]:
    """Each initialisation of Gaussians on two scenes."""
    found = []
    for scene in DEMOS:
        where = (f"data.scene={scene}", "data.resolution=100")
        for model in GAUSSIANS:
            for name, how in INITIALISATIONS.items():
                given = (*where, f"model={model}", *how)
                found += [
                    Case(f"{scene}, 100 px", f"{model}, {name}", given, args.seconds, seed)
                    for seed in range(args.seeds)
                ]
    return found


def warm() -> None:
    """What a process does before its first run: loops are compiled on first use."""
    torch.set_num_threads(1)
    measure(["model=six_planes", "lrm=none", "data.resolution=16"], math.inf, steps=20)
    measure(["model=gaussians_hexplane", "data.resolution=16"], math.inf, steps=20)


def result(case: Case, work: Path) -> dict[str, Any]:
    """What a case measured, now or before."""
    path = work / f"{case.name}.json"
    if not path.is_file():
        print(case.name, flush=True)
        made = [*case.overrides, "preparation.cache=null"]
        measured = measure(made, case.seconds, case.seed)
        write_json(path, measured if case.alone else measured | {"peak GB": None})
    return read_json(path)


def shown(case: Case, row: dict[str, Any]) -> tuple[str, ...]:
    named = {"scene": case.scene, "model": case.model} | row
    return tuple(
        "" if named[c] is None else f"{named[c]:.{DIGITS[c]}f}" if c in DIGITS else f"{named[c]}"
        for c in COLUMNS
    )


def begins(found: dict[Case, dict[str, Any]]) -> str:
    """PSNR of each initialisation: mean and standard deviation over the seeds."""
    groups: dict[tuple[str, str], dict[str, list[float]]] = {}
    for case, row in found.items():
        model, _, name = case.model.partition(", ")
        group = groups.setdefault((case.scene, model), {})
        group.setdefault(name, []).append(row["psnr"])
    lines = []
    for key, group in groups.items():
        cells = [
            f"{statistics.mean(group[name]):.2f}{spread(group[name])}" for name in INITIALISATIONS
        ]
        lines.append((*key, *cells))
    return markdown(("scene", "model", *INITIALISATIONS), lines)


def plot(models: list[Case], found: dict[Case, dict[str, Any]]) -> None:
    """PSNR and SSIM of each model of Gaussians less those of six planes, on each scene."""
    scenes = list(dict.fromkeys(case.scene for case in models))
    figure, axes = panels(2, 10, 5.4, sharey=True)
    for key, unit, axis in zip(("psnr", "ssim"), ("PSNR, dB", "SSIM"), axes, strict=True):
        scores = {(case.scene, case.model): found[case][key] for case in models}
        bars(
            axis,
            scenes,
            {
                model: [scores[scene, model] - scores[scene, "six_planes"] for scene in scenes]
                for model in GAUSSIANS
            },
        )
        axis.set_xlabel(f"{unit}: Gaussians minus six planes")
    axes[1].legend(fontsize=8)
    save(figure, "gaussians")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--lego", type=Path)
    parser.add_argument("--seconds", type=float, default=24.0)
    parser.add_argument("--large", type=float, default=60.0)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--together", type=int, default=1, help="runs side by side")
    parser.add_argument("--work", type=Path, default=Path("outputs/benchmarks/gaussians"))
    args = parser.parse_args()
    models, starts = comparison(args), beginnings(args)
    cases = list(dict.fromkeys([*models, *starts]))
    found: dict[Case, dict[str, Any]] = {}
    # Processes keep what runs leave behind: those whose memory is shown have one of their own.
    for alone in (False, True):
        some = [case for case in cases if case.alone == alone]
        with ProcessPoolExecutor(
            args.together,
            get_context("spawn"),
            initializer=warm,
            max_tasks_per_child=1 if alone else None,
        ) as pool:
            found |= zip(some, pool.map(result, some, [args.work] * len(some)), strict=True)
    rows = [shown(case, found[case]) for case in models]
    plot(models, found)
    write_rows(RESULTS / "gaussians.csv", COLUMNS, rows)
    text = f"""# Gaussians against six planes

    {command()}

Seconds are CPU time of one core and include building the model, with its initialisation; learning
rates and stages begin after it and end with the budget. One seed. Scores are on the test split of
the suite's scenes and on the val split of lego; [PSNR against time](pareto.md) has demo scenes and
smaller images. Six planes are initialised at random, Gaussians on the visual hull of the
silhouettes; `first psnr` is the initial model's, and `peak GB` is given for runs in a process of
their own.
{machine()}.

![PSNR and SSIM of Gaussians minus those of six planes](gaussians.png)

{markdown(COLUMNS, rows)}

## Initialisations of Gaussians

PSNR in dB after {args.seconds:g} s, means of {args.seeds} seeds. The first points lie on the visual
hull (`model.points=silhouettes`, the default), at random positions (`model.points=random`), or on
the surfaces of a six-plane field that is trained beforehand (`lrm=field`).

{begins({case: found[case] for case in starts})}
"""
    write_text(RESULTS / "gaussians.md", text)


if __name__ == "__main__":
    main()
