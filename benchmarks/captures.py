"""What captures without silhouettes reach: with and without a background, and in other models.

    python benchmarks/captures.py [--scenes phone,rig,phone_test,rig_test] [--resolution 100]
        [--steps 1000 | --seconds 120] [--variants NAMES] [--seeds 1] [--together 1]
        [--name captures] [--work FOLDER] [KEY=VALUE ...]

Writes results/NAME.md and NAME.csv beside this file. The scenes are procedural captures of the
suite, whose masks of the thing are known: scores are those of whole pictures, and of the pixels
that show the thing. Variants of X-Planes with six planes:

* `plain`: without a background;
* `sky`: a background whose colour depends on direction alone;
* `world`: the default;
* `masks`: told by silhouettes what is the thing, before white;
* `world_tiny`, `masks_tiny`: the same, initialised from the LRM that is bundled;
* `cut_tiny`: as `world_tiny`, but the LRM is shown the thing alone, cut out by masks.

`kplanes` and `tineuvox_s` are the baselines, with a world of their own. Each run is a process of
its own with one thread; ``--together`` so many run side by side.
"""

import argparse
import os
import statistics
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from runner import RESULTS, Measured, command, machine, markdown, run_apart

from xplanes.files import write_rows, write_text
from xplanes.scenes.demo.suite import SUITE_SCENES

VARIANTS = {
    "plain": ["lrm=none", "model.background=null"],
    "sky": ["lrm=none", "model.background.samples=0"],
    "world": ["lrm=none"],
    "masks": ["lrm=none", "data.mask_use=alpha"],
    "world_tiny": ["lrm=tiny"],
    "cut_tiny": ["lrm=tiny", "data.mask_use=lrm"],
    "masks_tiny": ["lrm=tiny", "data.mask_use=alpha"],
    "kplanes": ["model=kplanes"],
    "tineuvox_s": ["model=tineuvox_s"],
}
VIEWS = {"phone": 60, "rig": 96}
COLUMNS = (
    *("scene", "variant", "PSNR, dB", "PSNR of the thing, dB", "steps", "seconds"),
    *("ms a step", "memory, GB"),
)


def overrides(scene: str, variant: str, seed: int, args: argparse.Namespace) -> list[str]:
    """The command line of a run."""
    steps, seconds = (args.steps, None) if args.seconds is None else (None, args.seconds)
    return [
        *("data=suite", f"data.scene={scene}", f"data.resolution={args.resolution}"),
        *(f"data.root={args.root}", f"data.train_views={VIEWS[scene.removesuffix('_test')]}"),
        *VARIANTS[variant],
        *(f"trainer.max_steps={steps or 'null'}", f"trainer.max_seconds={seconds or 'null'}"),
        *("callbacks.evaluation.at=[]", "callbacks.evaluation.views=1", "logger=none"),
        *("media=false", f"seed={seed}", *args.overrides),
    ]


def row(scene: str, variant: str, runs: list[Measured]) -> list[str]:
    """Means over the seeds."""

    def mean(*path: str) -> float:
        values = []
        for run in runs:
            value = run.metrics
            for key in path:
                value = value[key]
            values.append(float(value))
        return statistics.mean(values)

    steps, seconds = mean("step"), mean("seconds", "train")
    whole = "" if variant.startswith("masks") else f"{mean('test', 'psnr'):.2f}"
    scores = [whole, f"{mean('test', 'psnr_thing'):.2f}"]
    times = [f"{steps:.0f}", f"{seconds:.0f}", f"{1000 * seconds / steps:.0f}"]
    return [scene, variant, *scores, *times, f"{mean('peak_memory_bytes') / 2**30:.1f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    captures = [name for name, scene in SUITE_SCENES.items() if scene.world is not None]
    parser.add_argument("--scenes", default=",".join(captures))
    parser.add_argument("--variants", default=",".join(VARIANTS))
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--seconds", type=float, help="of the training clock, in place of steps")
    parser.add_argument("--resolution", type=int, default=100)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--together", type=int, default=1, help="runs side by side")
    parser.add_argument("--root", type=Path, default=Path("data/suite"), help="of the scenes")
    parser.add_argument("--work", type=Path, help="keeps finished runs")
    parser.add_argument("--name", default="captures", help="of the results")
    parser.add_argument("overrides", nargs="*", help="settings of train.py")
    args = parser.parse_intermixed_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    names = [(s, v) for s in args.scenes.split(",") for v in args.variants.split(",")]
    jobs = [(scene, variant, seed) for scene, variant in names for seed in range(args.seeds)]
    with (
        tempfile.TemporaryDirectory() as scratch,
        ThreadPoolExecutor(args.together) as pool,
    ):
        work = args.work or Path(scratch)

        def measure(job: tuple[str, str, int]) -> Measured:
            return run_apart(overrides(*job, args), work / "_".join(map(str, job)))

        found: dict[tuple[str, str], list[Measured]] = {}
        for (scene, variant, _), run in zip(jobs, pool.map(measure, jobs), strict=True):
            runs = found.setdefault((scene, variant), [])
            runs.append(run)
            if len(runs) == args.seeds:
                print("  ".join(row(scene, variant, runs)), flush=True)
    rows = [row(*key, runs) for key, runs in found.items()]
    budget = f"{args.steps} steps" if args.seconds is None else f"{args.seconds:g} s"
    write_rows(RESULTS / f"{args.name}.csv", COLUMNS, rows)
    text = [
        "# Captures without silhouettes",
        "",
        f"After {budget} at {args.resolution} pixels, mean over {args.seeds} "
        f"seed{'s' if args.seeds > 1 else ''}. {machine()}.",
        "",
        f"    {command()}",
        "",
        markdown(COLUMNS, rows),
        "",
        "Seconds are those of training, without the preparation of `_tiny`. Memory is the peak of "
        "a whole run.",
    ]
    write_text(RESULTS / f"{args.name}.md", "\n".join(text) + "\n")


if __name__ == "__main__":
    main()
