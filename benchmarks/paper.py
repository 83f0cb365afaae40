"""The paper's tables and figures at small scale, and ablations: sweeps of a few hundred steps.

    python benchmarks/paper.py [--together 1] [--only NAME ...] [--work FOLDER]

Writes docs/results/paper.md, and what each sweep writes below docs/results/paper. Each sweep is a
process of its own with one thread, and seconds are its CPU time (cpu_clock.py); ``--together`` so
many run side by side. Finished sweeps in the work folder are not repeated.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from runner import CPU_CLOCK, RESULTS, machine, markdown

from xplanes.files import read_rows, write_text

OUT = RESULTS / "paper"
WRITTEN = (
    *("table.md", "table.csv", "table_seeds.csv"),
    *("sheet.png", "curves.png", "against.png"),
)
"""Files of a sweep that are kept, where it writes them."""

Row = dict[str, str]

METHODS = {
    "kplanes": "K-Planes",
    "tensor4d_density": "Tensor4D's planes with a density",
    "tineuvox_s": "TiNeuVox-S",
    "gaussians_hexplane": "4D-GS, CPU size",
    "gaussians_spacetime": "Spacetime Gaussians, CPU size",
    "six_planes": "X-Planes, six",
    "nine_planes": "X-Planes, nine",
}
LRMS = {"none": "random", "tiny": "`tiny`", "mini": "`mini`"}
PLANES = {"six_planes": "six", "nine_planes": "nine"}
CHANGES = {
    ("model.decoder.freeze", "true"): "decoder frozen",
    ("model.loss.sparse_weight", "0.0"): "without L_r",
    ("decomposition.static", "middle"): "space planes of the middle frame",
    ("decomposition.static", "median"): "space planes of the median",
    ("decomposition.dynamic", "ones"): "time planes of 1",
    ("decomposition.dynamic", "random"): "time planes near zero",
    ("decomposition.dynamic", "rank1"): "time planes of rank-1 products",
    ("lrm.name", "none"): "random initialisation",
    ("data.train_on_video", "true"): "the LRM's 16 frames among the training views",
}
"""What a value that differs from the first row's means."""


def number(row: Row, key: str, digits: int = 2) -> str:
    """A value with its standard deviation over the seeds, where there are several."""
    spread = f" ± {float(row[f'{key}_std']):.{digits}f}" if row.get(f"{key}_std") else ""
    return f"{float(row[key]):.{digits}f}{spread}"


def method(row: Row) -> str:
    """A model with its initialisation, as far as a table's columns say what they are."""
    model, lrm = row.get("model.name", ""), row.get("lrm.name")
    name = METHODS.get(model, "PSNR")
    return f"{name}, {LRMS[lrm]}" if model in PLANES and lrm else name


def compared(rows: list[Row]) -> str:
    """Methods, a row each."""
    columns = ("method", "PSNR before the first step", "PSNR", "SSIM", "seconds of one core")
    lines = []
    for row in rows:
        seconds = float(row["prepare_seconds"]) + float(row["train_seconds"])
        scores = (number(row, "start_psnr"), number(row, "psnr"), number(row, "ssim", 3))
        lines.append((method(row), *scores, f"{seconds:.0f}"))
    return markdown(columns, lines)


def sizes(rows: list[Row]) -> str:
    """LRMs, a row for each with six or nine planes."""
    columns = ("planes", "LRM", "PSNR before the first step", "PSNR", "SSIM")
    return markdown(
        columns,
        [
            (
                PLANES[row["model.name"]],
                LRMS[row["lrm.name"]],
                *(number(row, "start_psnr"), number(row, "psnr"), number(row, "ssim", 3)),
            )
            for row in rows
        ],
    )


def crossed(rows: list[Row], down: str, title: str) -> str:
    """PSNR: a setting's values down, methods across."""
    across = list(dict.fromkeys(method(row) for row in rows))
    cells = {(row[down], method(row)): number(row, "psnr") for row in rows}
    values = list(dict.fromkeys(row[down] for row in rows))
    lines = [(value, *(cells[value, name] for name in across)) for value in values]
    return markdown((title, *across), lines)


def initialised(rows: list[Row]) -> str:
    """Scores before the first step and at the end."""
    columns = ("initialisation", "PSNR before the first step", "PSNR after 500 steps")
    lines = [
        (LRMS[row["lrm.name"]], number(row, "start_psnr"), number(row, "psnr")) for row in rows
    ]
    return markdown(columns, lines)


def ablated(rows: list[Row]) -> str:
    """What each row changes of the first one."""
    lines = []
    for row in rows:
        names = [
            text
            for (key, value), text in CHANGES.items()
            if row[key] == value and rows[0][key] != value
        ]
        scores = (number(row, "start_psnr"), number(row, "psnr"), number(row, "ssim", 3))
        lines.append((", ".join(names) or "none", *scores))
    return markdown(("change", "PSNR before the first step", "PSNR", "SSIM"), lines)


@dataclass(frozen=True)
class Sweep:
    """A section of the page.

    Attributes:
        title: Heading, with its level.
        given: Arguments of train.py.
        text: What the runs are.
        show: From the rows of the sweep's table to Markdown; None: no table here.
        pictures: Words for the pictures shown, by file.
    """

    title: str
    given: tuple[str, ...]
    text: str = ""
    show: Callable[[list[Row]], str] | None = None
    pictures: tuple[tuple[str, str], ...] = ()


def small(name: str, *given: str) -> tuple[str, ...]:
    """Arguments of a sweep at small scale."""
    return ("-m", f"sweep={name}", "experiment=demo", *given)


SWEEPS = {
    "table1": Sweep(
        "## Table 1, figures 5, 7, 9 and 10",
        small("table1"),
        """\
Nine planes use Tensor4D's learning rates, a quarter of K-Planes' for planes and a twentieth
for the decoder, and train slowly at first. Gaussians are initialised from silhouettes. The linked
table has the published one beside it.""",
        compared,
        (("sheet.png", "One view of the excavator by all methods"),),
    ),
    "tables2_3": Sweep(
        "## Tables 2 and 3",
        small("tables2_3"),
        "Sizes of the LRM:",
        sizes,
        (("sheet.png", "The excavator, initialised from both LRMs"),),
    ),
    "table4": Sweep(
        "## Table 4",
        small("table4"),
        "Resolution of the planes:",
        lambda rows: crossed(rows, "model.resolution", "texels per side"),
    ),
    "figure6": Sweep(
        "## Figure 6",
        small("figure6"),
        """\
Nine planes. The initial green comes from the time planes: they are initialised to 1, as in
K-Planes, and shift the features that the LRM's decoder expects.""",
        initialised,
        (("sheet.png", "Before the first step, after 20, 200 and 500 steps"),),
    ),
    "few_shot": Sweep(
        "## Figure 8, few views",
        small("few_shot"),
        """\
With 5, 10 and 20 views the planes have 3, 5 and 10 rows of time, half the number of
timesteps and fewer than the LRM's 16 frames. K-Planes does not see these frames of the scene's
video; `data.train_on_video=true` gives them to all methods. PSNR:""",
        lambda rows: crossed(rows, "data.views", "training views"),
        (("against.png", "PSNR against the number of training views"),),
    ),
    "fair": Sweep(
        "## Equal rays, silhouettes and steps",
        small("fair"),
        """\
All methods have their published sizes and the same rays, samples, silhouettes, background
and 300 steps. None is supervised by alpha. Each keeps its own field, learning rates, regularisers
and initialisation, with a hundredth of its schedule; X-Planes' own schedule, made for minutes, is
unchanged. The baselines' published trainings have 20,000 to 200,000 steps: the table only shows how
far each method gets in the first 300. Gaussians are not included, as they render whole images
instead of rays. Means of three seeds; the image is of the first.""",
        compared,
        (("sheet.png", "One view by all methods"),),
    ),
    "ablation": Sweep(
        "## Ablation of the initialisation",
        small("ablation"),
        "Default settings, six planes, one change at a time, three seeds:",
        ablated,
    ),
    "ablation_paper": Sweep(
        "### With the paper's settings",
        small("ablation", "recipe=paper", "lrm=tiny"),
        show=ablated,
    ),
    "rank": Sweep(
        "## Rank, figure 3",
        small("rank"),
        """\
See also [rank against lambda and mu](rank_curve.md). In the image, the rows of each scene are xy,
xz and yz. For each timestep, the low-rank part is on the left and the sparse part, with a separate
colour scale, on the right.""",
        pictures=(("sheet.png", "Low-rank and sparse parts at four timesteps"),),
    ),
    "time_planes": Sweep(
        "## Time planes of 1 or near zero",
        (
            *("-m", "recipe=paper", "lrm=tiny", "decomposition.dynamic=ones,random"),
            *("data.resolution=64", "data.eval_views=4", "preparation.fixed_view=auto"),
            *("preparation.frames=16", "model.resolution=32", "model.rays.per_batch=512"),
            *("model.sampler.proposal_samples=[64,32]", "model.sampler.resolutions=[24,32]"),
            *("model.sampler.time_resolution=16", "model.sampler.samples=24"),
            *("trainer.max_steps=300", "callbacks.evaluation.at=[0,0.1,0.3,0.6,1]"),
            *("hydra.callbacks.table.sheet=steps", "media=false"),
        ),
        "Steps 0, 30, 90, 180 and 300.",
        lambda rows: crossed(rows, "decomposition.dynamic", "time planes"),
        (("sheet.png", "Time planes of 1 above, near 0 below"),),
    ),
}
"""By folder."""

LONGEST = ("fair", "ablation_paper", "ablation")


def late(name: str) -> int:
    """When a sweep is begun."""
    return LONGEST.index(name) if name in LONGEST else len(LONGEST)


def train(name: str, work: Path) -> None:
    """Run a sweep, and keep what it writes."""
    folder = work / name
    if not (folder / "done").is_file():
        print(name, flush=True)
        shutil.rmtree(folder, ignore_errors=True)
        line = [*SWEEPS[name].given, "logger=none", f"hydra.sweep.dir={folder}"]
        done = subprocess.run(
            [sys.executable, str(CPU_CLOCK), *line], capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise RuntimeError(f"{name} failed:\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}")
        (folder / "done").touch()
    (OUT / name).mkdir(parents=True, exist_ok=True)
    for file in WRITTEN:
        (OUT / name / file).unlink(missing_ok=True)
        if (folder / file).is_file():
            shutil.copyfile(folder / file, OUT / name / file)


def ranks(folder: Path) -> str:
    """Mean rank of the low-rank part over the runs of a sweep, and the ranges of the rest."""
    found = []
    for path in sorted(folder.glob("*/metrics.json")):
        parts = json.loads(path.read_text(encoding="utf-8"))["decomposition"]
        found += [parts[plane] for plane in ("xy", "xz", "yz")]
    rank = fmean(part["rank"] for part in found)
    drifts, energies = ([part[key] for part in found] for key in ("drift", "sparse_energy"))
    return (
        f"The mean rank of L is {rank:.2f} of 16; the paper reports 2.53. Frames of L differ from "
        f"the middle one by {min(drifts):.0%} to {max(drifts):.0%} of its norm, and S holds "
        f"{100 * min(energies):.2f}% to {100 * max(energies):.2f}% of the energy, over "
        f"{len(found)} planes."
    )


def section(name: str, work: Path) -> list[str]:
    """The lines of a sweep."""
    sweep, folder = SWEEPS[name], OUT / name
    given = " ".join(f'"{word}"' if "[" in word else word for word in sweep.given)
    lines = [sweep.title, "", f"    python train.py {given}", ""]
    lines += [sweep.text, ""] if sweep.text else []
    if name == "rank":
        lines += [ranks(work / name), ""]
    if sweep.show is not None:
        seeds = folder / "table_seeds.csv"
        lines += [sweep.show(read_rows(seeds if seeds.is_file() else folder / "table.csv")), ""]
    for file, words in sweep.pictures:
        lines += [f"![{words}](paper/{name}/{file})", ""]
    return [*lines, f"[All runs](paper/{name}/table.md).", ""]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--together", type=int, default=1, help="sweeps side by side")
    parser.add_argument("--only", nargs="+", choices=SWEEPS, default=list(SWEEPS))
    parser.add_argument("--work", type=Path, default=Path("outputs/benchmarks/paper"))
    args = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    work = args.work.absolute()
    with ThreadPoolExecutor(args.together) as pool:
        # The longest first, so that those side by side end together.
        list(pool.map(lambda name: train(name, work), sorted(args.only, key=late)))
    head = f"""# The paper's tables and figures at small scale

    python benchmarks/paper.py

A procedural scene of 64 pixels and the bundled LRMs (`experiment=demo`). Sweeps with the paper's
recipe have reduced baselines, planes of 32 texels, float32, and schedules shortened to a hundredth.
Budgets are 300 steps unless stated otherwise. PSNR is in dB, over six views of the test split; one
seed unless a table has a standard deviation. Seconds are CPU time of one core. {machine()}. The
linked tables state each protocol and the paper's figures, which are from other data and sizes.

These pages show what each sweep writes. They do not rank methods: 300 steps are a hundredth of
a full training, and the LRM sees 16 frames of the scene's own video that random initialisations and
baselines do not see. The actual comparison, the sweeps without `experiment=demo`, has not been run.
The fixed-view video is the scene's own, not rendered by K-Planes.
"""
    lines = [line for name in args.only for line in section(name, work)]
    write_text(RESULTS / "paper.md", "\n".join([head, *lines]).rstrip() + "\n")


if __name__ == "__main__":
    main()
