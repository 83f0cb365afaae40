"""The page "The paper": its tables and figures at small scale, and what its constants give."""

import itertools
import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
import yaml
from figures import curves, panels, save
from runner import CPU_CLOCK, markdown
from sections import Row, Section, number, settings_of
from torch import Tensor

from xplanes.config import CONF, compose_plain
from xplanes.decomposition import robust_pca
from xplanes.experiment import Experiment
from xplanes.files import read_rows
from xplanes.models.initialisation import Place
from xplanes.preparation.cache import StageCache
from xplanes.preparation.reconstruct import ImageLRMSettings, reconstruct
from xplanes.scenes.datamodule import SceneDataModule
from xplanes.sweeps import jobs

METHODS = {
    "kplanes": "K-Planes",
    "kplanes_reduced": "K-Planes, reduced",
    "tensor4d_density": "Tensor4D's planes with a density",
    "tensor4d_reduced": "Tensor4D, reduced",
    "tineuvox_s": "TiNeuVox-S",
    "tineuvox_reduced": "TiNeuVox-S, reduced",
    "gaussians_hexplane": "4D-GS, CPU size",
    "gaussians_spacetime": "Spacetime Gaussians, CPU size",
    "six_planes": "X-Planes, six",
    "nine_planes": "X-Planes, nine",
}
LRMS = {"none": "random", "tiny": "`tiny`", "mini": "`mini`"}
PLANES = {"six_planes": "six", "nine_planes": "nine"}
CHANGES = {
    "model.loss.sparse_weight=0.0": "without L_r",
    "model.decoder.freeze=true": "decoder frozen",
    "decomposition.static=middle": "space planes of the middle frame",
    "decomposition.static=median": "space planes of the median",
    "decomposition.dynamic=ones": "time planes of 1",
    "decomposition.dynamic=random": "time planes near zero",
    "decomposition.dynamic=rank1": "time planes of rank-1 products",
    "lrm=none": "random initialisation",
    "data.train_on_video=true": "the LRM's 16 frames among the training views",
}


def methods(rows: list[Row]) -> str:
    """Scores and seconds, a row for each method."""
    columns = ("method", "PSNR before the first step", "PSNR", "SSIM", "seconds")
    lines = [(method(row), *scores(row), number(row, "train", 0)) for row in rows]
    return markdown(columns, lines)


def method(row: Row) -> str:
    name = METHODS[row["model"]]
    return f"{name}, {LRMS[row['lrm']]}" if row["model"] in PLANES else name


def scores(row: Row) -> tuple[str, str, str]:
    return number(row, "first"), number(row, "psnr"), number(row, "ssim", 3)


def sizes(rows: list[Row]) -> str:
    """A row for each LRM, with six and nine planes."""
    columns = ("planes", "LRM", "PSNR before the first step", "PSNR", "SSIM")
    lines = [(PLANES[row["model"]], LRMS[row["lrm"]], *scores(row)) for row in rows]
    return markdown(columns, lines)


def crossed(rows: list[Row], key: str, title: str) -> str:
    """PSNR: values of a setting down, methods across."""
    across = list(dict.fromkeys(method(row) for row in rows))
    cells = {(row[key], method(row)): number(row, "psnr") for row in rows}
    down = list(dict.fromkeys(row[key] for row in rows))
    lines = [(each, *(cells[each, name] for name in across)) for each in down]
    return markdown((title, *across), lines)


def resolutions(rows: list[Row]) -> str:
    return crossed(rows, "texels", "texels per side")


def initialised(rows: list[Row]) -> str:
    columns = ("initialisation", "PSNR before the first step", "PSNR", "seconds to 20 dB")
    lines = [(LRMS[row["lrm"]], *scores(row)[:2], number(row, "to_20", 1)) for row in rows]
    return markdown(columns, lines)


def few_views(rows: list[Row]) -> str:
    figure, (axes,) = panels(1, 3)
    names = dict.fromkeys(method(row) for row in rows)
    curves(
        axes,
        {
            name.replace("`", ""): [
                (row["views"], row["psnr"], 0.0) for row in rows if method(row) == name
            ]
            for name in names
        },
    )
    axes.set(xlabel="training views", ylabel="PSNR, dB", xticks=[5, 10, 20])
    save(figure, "few_shot")
    table = crossed(rows, "views", "training views")
    return f"![PSNR against the number of training views](few_shot.png)\n\n{table}"


def ablated(rows: list[Row]) -> str:
    """What each row changes of the first one."""
    columns = ("change", "PSNR before the first step", "PSNR", "SSIM")
    lines = [(row["change"] or "none", *scores(row)) for row in rows]
    return markdown(columns, lines)


NOT_IN_NAMES = ("sweep", "experiment", "seed", "data.scene", "trainer.max_steps", "callbacks")


def sweep(name: str, given: str, show: Callable[[list[Row]], str], quick: str) -> Section:
    """A section of a sweep at small scale.

    Args:
        name: Of the record.
        given: Arguments of train.py.
        show: Draws and returns the table.
        quick: Arguments that select a part of its runs with one seed.
    """
    words = given.split()

    def settings() -> dict[str, Row]:
        return {case: settings_of(tuple(job)) for case, job in cases(words).items()}

    def measure(work: Path, short: bool) -> list[Row]:
        return run([*words, *quick.split()] if short else words, work)

    return Section(name=name, settings=settings, measure=measure, show=show)


def cases(words: list[str]) -> dict[str, list[str]]:
    """Overrides of the jobs of a sweep that differ in more than their seeds, by name."""
    name = next(word.partition("=")[2] for word in words if word.startswith("sweep="))
    content = yaml.safe_load((CONF / "sweep" / f"{name}.yaml").read_text(encoding="utf-8"))
    hydra = {"sweeper": content["hydra"]["sweeper"], "overrides": {"task": words}}
    found, known = {}, []
    for job in jobs(hydra):
        own = [text for text in job if not text.split("=")[0].lstrip("+").startswith(NOT_IN_NAMES)]
        line = [text for text in job if not text.startswith("seed=")]
        # Tables show once what several rows set alike, such as a default and its explicit value.
        if (settings := settings_of(tuple(line))) not in known:
            known.append(settings)
            found[" ".join(own) or "complete"] = line
    return found


def run(words: list[str], work: Path) -> list[Row]:
    """Run a sweep in a process with one thread; a row for each of its cases."""
    shutil.rmtree(work, ignore_errors=True)
    line = [sys.executable, str(CPU_CLOCK), "-m", *words, "logger=none"]
    done = subprocess.run(
        [*line, f"hydra.sweep.dir={work.absolute()}"], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"{' '.join(words)}:\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}")
    seeds = work / "table_seeds.csv"
    table = read_rows(seeds if seeds.is_file() else work / "table.csv")
    return [
        row_of(case, job, row) for (case, job), row in zip(cases(words).items(), table, strict=True)
    ]


def row_of(case: str, job: list[str], row: dict[str, str]) -> Row:
    """A row of a sweep's table as one of a record."""

    def figure(key: str) -> float | None:
        return float(row[key]) if row.get(key) else None

    settings = settings_of(tuple(job))
    count = int(row.get("seeds") or 1)
    found = {
        "case": case,
        "model": settings["model.name"],
        "lrm": settings["lrm.name"],
        "views": settings.get("data.views"),
        "texels": settings.get("model.resolution"),
        "change": ", ".join(CHANGES[text] for text in case.split() if text in CHANGES),
        "seeds": count,
        "first": figure("start_psnr"),
        "psnr": figure("psnr"),
        "psnr_std": figure("psnr_std"),
        "ssim": figure("ssim"),
        "ssim_std": figure("ssim_std"),
        "train": (figure("prepare_seconds") or 0) + (figure("train_seconds") or 0),
        "to_20": figure("seconds_to_20"),
    }
    found["cpu"] = count * found["train"]
    return {key: value for key, value in found.items() if value is not None}


PUBLISHED, LAMBDA, MU = 2.53, 0.009, 0.05
"""The paper's mean rank, and its constants."""

LAMBDAS = (0.001, 0.002, 0.0025, 0.003, 0.0035, 0.004, 0.006, 0.009, 0.02)
SCALES = (0.0001, 0.0003, 0.001, 0.0014, 0.002, 0.003, 0.01, 0.1, 1.0, 10.0)
"""Root mean squares of features."""

TOLERANCE = 3e-3
"""Relative residual at which the paper's ADMM stops in recipe=paper."""

SCENES, MODELS = ("excavator", "walker", "balls", "windmill"), ("tiny", "mini")
SPLIT = {"method": "admm", "scale": "none", "penalty": MU, "tolerance": TOLERANCE}


def given(scene: str, lrm: str) -> tuple[str, ...]:
    return (f"data.scene={scene}", f"lrm={lrm}", "data.resolution=64")


def matrices(scene: str, lrm: str) -> Iterator[Tensor]:
    """One column per timestep, for xy, xz and yz. [C H W, T] each"""
    experiment = Experiment.read(compose_plain("train", given(scene, lrm)))
    data = SceneDataModule(experiment.data, seed=0)
    data.setup("fit")
    settings = experiment.method.lrm
    assert isinstance(settings, ImageLRMSettings)
    frame = experiment.method.model.frame(data.scene.splits["train"])
    place = Place(data.scene, frame, torch.device("cpu"))
    cache = StageCache(Path("data/cache"))
    model = settings.load_model(print)
    made = reconstruct(experiment.method, settings, place, model, cache)
    for index in range(3):
        yield made.sequence.triplanes[:, index].float().flatten(1).mT


def measure_rank(work: Path, quick: bool) -> list[Row]:
    """Ranks against lambda and against mu times scale, means over scenes and planes."""
    warnings.simplefilter("ignore")  # A column of the table says what did not converge.
    found: dict[tuple[str, str, float], list[dict[str, Any]]] = {}
    for lrm, scene in itertools.product(MODELS[: 1 if quick else 2], SCENES[: 1 if quick else 4]):
        for matrix in matrices(scene, lrm):
            unit = float(matrix.square().mean().sqrt())

            def note(sweep: str, value: float, data: Tensor, **options: Any) -> None:
                report = robust_pca(data, progress=False, **options).report()
                found.setdefault((sweep, lrm, value), []).append(report | {"rms": unit})  # noqa: B023

            note("as they are", 1, matrix, **SPLIT, sparsity_weight=LAMBDA)
            for weight in LAMBDAS:
                note("lambda", weight, matrix, sparsity_weight=weight, tolerance=1e-4)
            for scale in SCALES:
                note("scale", scale, matrix / unit * scale, **SPLIT, sparsity_weight=LAMBDA)
    rows = []
    for (kind, lrm, value), reports in found.items():
        row: Row = {"case": f"{lrm}, {kind} {value:g}", "lrm": lrm, "sweep": kind, "value": value}
        for key in ("rank", "sparse_energy", "drift", "iterations", "converged"):
            row[key] = fmean(float(report[key]) for report in reports)
        for key in ("sparse_energy", "drift", "rms"):
            row[f"{key}_range"] = [f(report[key] for report in reports) for f in (min, max)]
        rows.append(row)
    return rows


def show_rank(rows: list[Row]) -> str:
    figure, (left, right) = panels(2, 5)
    for axes, kind in ((left, "lambda"), (right, "scale")):
        lines = {
            lrm: [
                (row["value"], row["rank"], 0.0)
                for row in rows
                if row["lrm"] == lrm and row["sweep"] == kind
            ]
            for lrm in MODELS
        }
        axes.set_xscale("log")
        axes.axhline(PUBLISHED, color="0.4", linestyle="--")
        axes.annotate("published", (0.02, PUBLISHED + 0.3), xycoords=("axes fraction", "data"))
        curves(axes, lines)
        axes.set_ylabel("mean rank, of 16")
    left.set_xlabel("lambda, solved to the end")
    right.set_xlabel(f"rms of the features, lambda {LAMBDA} and mu {MU}, paper's ADMM")
    save(figure, "rank")
    own = [row for row in rows if row["sweep"] == "as they are"]
    drifts, energies, sizes = (
        [f(row[f"{key}_range"][place] for row in own) for f, place in ((min, 0), (max, 1))]
        for key in ("drift", "sparse_energy", "rms")
    )
    mean = fmean(row["rank"] for row in own)
    words = [
        f"The mean rank is {mean:.2f} of 16 with the paper's constants, {PUBLISHED} in the paper,",
        f"which does not state the scale of its features (here {sizes[0]:.2f} to {sizes[1]:.2f}).",
        f"Frames of L differ from the middle one by {drifts[0]:.0%} to {drifts[1]:.0%} of its",
        f"norm, and S holds {100 * energies[0]:.2f}% to {100 * energies[1]:.2f}% of the energy.",
    ]
    columns = (
        "lambda",
        *(f"`{lrm}`: {name}" for lrm in MODELS for name in ("rank", "energy of S, %")),
    )
    cells = {(row["value"], row["lrm"]): row for row in rows if row["sweep"] == "lambda"}
    lines = [
        (
            f"{weight:g}",
            *itertools.chain.from_iterable(
                (
                    number(cells[weight, lrm], "rank", 1),
                    number(cells[weight, lrm], "sparse_energy", 2, 100),
                )
                for lrm in MODELS
            ),
        )
        for weight in LAMBDAS
    ]
    picture = "![Rank against lambda and against the scale of the features](rank.png)"
    return f"{chr(10).join(words)}\n\n{picture}\n\n{markdown(columns, lines)}"


def rank_settings() -> dict[str, Row]:
    return {
        f"{scene}, {lrm}": {
            key: value
            for key, value in settings_of(given(scene, lrm)).items()
            if key.startswith(("data", "lrm", "preparation", "version"))
        }
        for scene, lrm in itertools.product(SCENES, MODELS)
    }


SMALL = "experiment=demo"
SECTIONS: tuple[Section, ...] = (
    sweep("table1", f"sweep=table1 {SMALL}", methods, "model=six_planes"),
    sweep("tables2_3", f"sweep=tables2_3 {SMALL}", sizes, "model=six_planes lrm=tiny"),
    sweep("table4", f"sweep=table4 {SMALL}", resolutions, "model=six_planes model.resolution=64"),
    sweep("figure6", f"sweep=figure6 {SMALL}", initialised, "lrm=tiny"),
    sweep("few_shot", f"sweep=few_shot {SMALL}", few_views, "data.views=5 model=six_planes"),
    sweep("fair", f"sweep=fair {SMALL}", methods, "model=six_planes lrm=none seed=0"),
    sweep("ablation", f"sweep=ablation {SMALL}", ablated, "seed=0"),
    sweep(
        "ablation_paper",
        f"sweep=ablation {SMALL} recipe=paper_small lrm=tiny",
        ablated,
        "seed=0",
    ),
    Section(
        name="rank",
        settings=rank_settings,
        measure=measure_rank,
        show=show_rank,
        checks={"rank": 0.05},
    ),
)
