"""Does a better LRM give a better radiance field? Checkpoints of one model, and the bundled ones.

    python benchmarks/lrm_quality.py [--lengths 30 100 300 1000] [--objects 1024] [--held-out 32]
        [--scenes excavator walker balls] [--seconds 15] [--seeds 3] [--together 1] [--work FOLDER]

Writes docs/results/lrm_quality.md, .csv and .png. A model of `tiny`'s size is pretrained and kept
after each of --lengths steps (its planes at half the resolution, which quarters the time); `tiny`
and `mini` follow. Each is scored by what it does alone, on held-out objects that it sees from one
side, and by the six planes that start from it. Demo scenes, 100 pixels; seconds are CPU time of one
core and leave the preparation out, so that all starts train equally long.
"""

import argparse
import os
import shutil
import statistics
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from figures import panels, save
from runner import CPU_CLOCK, RESULTS, Measured, command, machine, markdown, run_apart

from xplanes.files import read_json, write_rows, write_text

COLUMNS = (
    *("LRM", "pretraining steps", "IoU", "LRM's PSNR on novel views, dB"),
    *("PSNR before the first step, dB", "PSNR after training, dB"),
)


class Start(NamedTuple):
    """What a field starts from: the settings of the LRM, and what the LRM does alone."""

    name: str
    steps: str
    overrides: tuple[str, ...]
    scores: dict[str, float] | None


def pretrained(args: argparse.Namespace) -> list[Start]:
    """One model after each of the lengths."""
    folder = args.work.absolute() / "pretraining"
    found = []
    for steps in args.lengths:
        kept = folder / f"{steps}" / "tiny.safetensors"
        if not kept.is_file():
            settings = [
                *("pretrain=tiny", f"run={folder / 'run'}", "model.low_resolution=8"),
                *(f"pool.objects={args.objects}", f"pool.root={folder / 'pool'}"),
                *(f"schedule.max_steps={steps}", "schedule.max_seconds=null"),
                *("schedule.decay_share=0", "schedule.warmup_steps=20"),
                "schedule.score_seconds=1e9",
            ]
            subprocess.run([sys.executable, "-m", "xplanes", "pretrain-lrm", *settings], check=True)
            kept.parent.mkdir(parents=True, exist_ok=True)
            for file in (folder / "run").glob("tiny.*"):
                shutil.copy2(file, kept.with_name(file.name))
        given = ("lrm=tiny", f"lrm.weights={kept}")
        found.append(Start("planes of 16 x 16", f"{steps}", given, scores(str(kept), args)))
    return found


def scores(model: str, args: argparse.Namespace) -> dict[str, float]:
    """Scores of an LRM on the held-out objects."""
    out = args.work.absolute() / "scores" / (Path(model).parent.name if "/" in model else model)
    file = out / "scores.json"
    if not file.is_file():
        words = ["score-lrm", model, "--objects", str(args.held_out), "--out", str(out)]
        subprocess.run([sys.executable, "-m", "xplanes", *words], check=True)
    return next(iter(read_json(file)["mean"].values()))


def train(start: Start, scene: str, seed: int, args: argparse.Namespace) -> Measured:
    """Six planes from a start."""
    given = [*start.overrides, f"data.scene={scene}", "data.resolution=100", f"seed={seed}"]
    given += [f"trainer.max_seconds={args.seconds:g}", "trainer.max_steps=1000000"]
    given += ["callbacks.evaluation.at=[0.0]", "media=false", "logger=none"]
    given += ["trainer.accelerator=cpu"]
    name = f"{start.name.replace(' ', '_')}_{start.steps}_{scene}_{seed}"
    return run_apart(given, args.work.absolute() / name, CPU_CLOCK)


def across(runs: list[list[Measured]], first: bool) -> tuple[float, float]:
    """Mean over scenes of PSNR in dB, and its standard deviation over the seeds."""
    means = [
        statistics.mean(
            float(run.curve[0]["psnr"]) if first else run.metrics["test"]["psnr"] for run in seed
        )
        for seed in runs
    ]
    return statistics.mean(means), statistics.stdev(means) if len(means) > 1 else 0.0


def plot(starts: list[Start], trained: list[tuple[float, float]]) -> None:
    """PSNR after training against the LRM's own; random initialisation as a line."""
    figure, (axes,) = panels(1, 3.8)
    axes.margins(x=0.1)
    for number, (start, (mean, spread)) in enumerate(zip(starts, trained, strict=True)):
        if start.scores is None:
            axes.axhline(mean, color="0.5", linewidth=1)
            axes.axhspan(mean - spread, mean + spread, color="0.5", alpha=0.2)
            axes.annotate("random initialisation", (0.02, mean), xycoords=("axes fraction", "data"))
            continue
        novel = start.scores["psnr_novel"]
        axes.errorbar(novel, mean, yerr=spread, fmt="o", color="C0", capsize=3)
        label = start.name if start.steps == "" else f"{start.steps} steps"
        # Neighbours may be close: labels stand above and below in turns.
        where = (5, 6 if number % 2 else -14)
        axes.annotate(label, (novel, mean), xytext=where, textcoords="offset points")
    axes.set(xlabel="novel views of the LRM alone, dB", ylabel="field after training, dB")
    save(figure, "lrm_quality")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--lengths", type=int, nargs="+", default=[30, 100, 300, 1000])
    parser.add_argument("--objects", type=int, default=1024, help="of the pretraining")
    parser.add_argument("--held-out", type=int, default=32, help="objects that score an LRM")
    parser.add_argument("--scenes", nargs="+", default=["excavator", "walker", "balls"])
    parser.add_argument("--seconds", type=float, default=15)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--together", type=int, default=1, help="runs side by side")
    parser.add_argument("--work", type=Path, default=Path("outputs/benchmarks/lrm_quality"))
    args = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    starts = [Start("none", "", ("lrm=none",), None), *pretrained(args)]
    starts += [Start(name, "", (f"lrm={name}",), scores(name, args)) for name in ("tiny", "mini")]
    jobs = [(s, scene, seed) for s in starts for seed in range(args.seeds) for scene in args.scenes]
    with ThreadPoolExecutor(args.together) as pool:
        runs = iter(list(pool.map(lambda job: train(job[0], job[1], job[2], args), jobs)))
    rows, trained = [], []
    for start in starts:
        seeds = [[next(runs) for _ in args.scenes] for _ in range(args.seeds)]
        trained.append(across(seeds, first=False))
        found = start.scores
        alone = ("", "") if found is None else (f"{found['iou']:.3f}", f"{found['psnr_novel']:.2f}")
        mean, spread = trained[-1]
        before = across(seeds, first=True)[0]
        rows.append(
            (start.name, start.steps, *alone, f"{before:.2f}", f"{mean:.2f} ± {spread:.2f}")
        )
    write_rows(RESULTS / "lrm_quality.csv", COLUMNS, rows)
    plot(starts, trained)
    text = f"""# Does a better LRM give a better field?

    {command()}

Six planes on {", ".join(args.scenes)} at 100 pixels, {args.seconds:g} s of one core's CPU time
without the preparation; means over the scenes, ± the standard deviation of {args.seeds} seeds. The
LRM alone is scored on {args.held_out} held-out objects, each from one input view. The planes of
16 x 16 are those of one model at several steps of its pretraining on {args.objects} objects; `tiny`
and `mini` were pretrained on 16,384 objects at 32 x 32, for hours with a different schedule. All of
them see 16 frames of a fixed camera's video, which `none` does not ([effect of these
frames](initialisation.md)). {machine()}.

![PSNR after training against the LRM's own](lrm_quality.png)

{markdown(COLUMNS, rows)}
"""
    write_text(RESULTS / "lrm_quality.md", text)


if __name__ == "__main__":
    main()
