"""What captures and other scenes of the suite reach, in variants and in other models.

    python benchmarks/captures.py [--scenes phone,rig,phone_test,rig_test] [--resolution 100]
        [--steps 1000 | --seconds 120] [--variants NAMES] [--seeds 1] [--together 1]
        [--name captures] [--title TITLE] [--work FOLDER] [KEY=VALUE ...]

Writes docs/results/NAME.md, NAME.csv and NAME.png. The scenes are procedural captures of the suite,
whose masks are known: scores are those of whole images, and of the pixels that show the foreground
object. Scenes with silhouettes have the former alone. `MEANINGS` describes the variants. The
baselines `kplanes` and `tineuvox_s` have a background field too, and as many rays per step as
X-Planes; K-Planes has one scale, few samples and a short warm-up, as it learns nothing in a minute
of a CPU otherwise. Each run is a process of its own with one thread, and seconds are its CPU time
(cpu_clock.py); ``--together`` runs this number side by side.
"""

import argparse
import math
import os
import statistics
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from figures import bars, panels, save
from runner import CPU_CLOCK, RESULTS, Measured, command, machine, markdown, run_apart

from xplanes.files import write_rows, write_text
from xplanes.synthetic.demo.suite import SUITE_SCENES

VARIANTS = {
    "plain": ["lrm=none", "model.background=null"],
    "sky": ["lrm=none", "model.background.samples=0"],
    "world": ["lrm=none"],
    "masks": ["lrm=none", "data.mask_use=alpha"],
    "world_tiny": ["lrm=tiny"],
    "cut_tiny": ["lrm=tiny", "data.mask_use=lrm"],
    "masks_tiny": ["lrm=tiny", "data.mask_use=alpha"],
    "rough_world": ["lrm=none", "model.background.total_variation=0"],
    "rough_field": [
        "lrm=none",
        "model.loss.total_variation_with_background=0",
        "model.loss.time_variation=0",
    ],
    "thin_fog": ["lrm=none", "model.sampler.threshold_with_background=0.001"],
    "even_rays": ["lrm=none", "model.rays.skip_background=false"],
    "kplanes": [
        *("model=kplanes", "model.scales=[2]", "model.warmup_steps=50"),
        *("model.rays.per_batch=1024", "model.sampler.proposal_samples=[64,48]"),
        *("model.sampler.samples=32", "model.sampler.anneal_steps=100"),
    ],
    "tineuvox_s": ["model=tineuvox_s", "model.rays.per_batch=1024"],
}
MEANINGS = {
    "plain": "no background field",
    "sky": "a background whose colour depends on direction alone",
    "world": "six planes, the default",
    "world_tiny": "the default, initialised from `tiny`",
    "cut_tiny": "the same, with the object cut out by masks for the LRM",
    "masks": "masks used as alpha, in front of white",
    "masks_tiny": "the same, initialised from `tiny`",
    "rough_world": "the default without smoothness of the background",
    "rough_field": "the default without smoothness of the field",
    "thin_fog": "the default with the occupancy threshold of scenes with alpha",
    "even_rays": "the default with all pixels drawn uniformly",
    "kplanes": "K-Planes with one scale, fewer samples and a short warm-up",
    "tineuvox_s": "TiNeuVox-S",
}
VIEWS = {"phone": 60, "rig": 96}
COLUMNS = (
    *("scene", "variant", "PSNR, dB", "PSNR of the object, dB", "SSIM", "floaters, %"),
    *("steps", "seconds", "ms per step", "memory, GB"),
)


def overrides(scene: str, variant: str, seed: int, args: argparse.Namespace) -> list[str]:
    """The command line of a run."""
    steps, seconds = (args.steps, None) if args.seconds is None else (None, args.seconds)
    return [
        *("data=suite", f"data.scene={scene}", f"data.resolution={args.resolution}"),
        *(
            f"data.root={args.root}",
            f"data.train_views={VIEWS.get(scene.removesuffix('_test'), 50)}",
        ),
        *VARIANTS[variant],
        *(f"trainer.max_steps={steps or -1}", f"trainer.max_seconds={seconds or 'null'}"),
        *("callbacks.evaluation.at=[]", "trainer.limit_val_batches=1", "logger=none"),
        *("media=false", f"seed={seed}", *args.overrides),
    ]


def row(scene: str, variant: str, runs: list[Measured]) -> list[str]:
    """Means over the seeds, with the standard deviation of scores."""

    def values(*path: str) -> list[float]:
        found = []
        for run in runs:
            value = run.metrics
            for key in path:
                value = value[key]
            found.append(float(value))
        return found

    def mean(*path: str) -> float:
        return statistics.mean(values(*path))

    def score(name: str, scale: int = 1, digits: int = 2) -> str:
        if name not in runs[0].metrics["test"]:
            return ""
        found = [scale * value for value in values("test", name)]
        spread = f" ± {statistics.stdev(found):.{digits}f}" if len(runs) > 1 else ""
        return f"{statistics.mean(found):.{digits}f}{spread}"

    steps, seconds = mean("step"), mean("seconds", "train")
    whole = [score("psnr"), score("psnr_foreground"), score("ssim", digits=3)]
    if variant.startswith("masks"):
        whole = ["", whole[1], ""]
    scores = [*whole, score("floaters", 100)]
    times = [f"{steps:.0f}", f"{seconds:.0f}", f"{1000 * seconds / steps:.0f}"]
    return [scene, variant, *scores, *times, f"{mean('peak_memory_bytes') / 2**30:.1f}"]


def legend(variants: list[str]) -> list[str]:
    """What the variants are, a line each."""
    return [f"* `{variant}`: {MEANINGS[variant]}" for variant in variants]


def plot(found: dict[tuple[str, str], list[Measured]], name: str) -> None:
    """PSNR of the whole picture of each variant, and of the thing where its mask is known."""
    scenes, variants = (list(dict.fromkeys(key[place] for key in found)) for place in (0, 1))

    def score(scene: str, variant: str, key: str) -> float:
        if key == "psnr" and variant.startswith("masks"):
            return math.nan
        runs = found[scene, variant]
        return statistics.mean(run.metrics["test"].get(key, math.nan) for run in runs)

    figure, axes = panels(2, 9, 0.45 * len(variants) + 1.6, sharey=True)
    keys = {"psnr": "PSNR, dB", "psnr_foreground": "PSNR of the foreground object, dB"}
    for axis, (key, label) in zip(axes, keys.items(), strict=True):
        groups = {s: [score(s, variant, key) for variant in variants] for s in scenes}
        bars(axis, variants, groups)
        axis.set_xlabel(label)
    axes[0].legend(fontsize=8)
    save(figure, name)


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
    parser.add_argument("--work", type=Path, default=Path("outputs/benchmarks/captures"))
    parser.add_argument("--name", default="captures", help="of the results")
    parser.add_argument("--title", default="Captures with a world behind", help="of the page")
    parser.add_argument("overrides", nargs="*", help="settings of train.py")
    args = parser.parse_intermixed_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    names = [(s, v) for s in args.scenes.split(",") for v in args.variants.split(",")]
    jobs = [(scene, variant, seed) for scene, variant in names for seed in range(args.seeds)]
    work = args.work.absolute() / args.name
    with ThreadPoolExecutor(args.together) as pool:

        def measure(job: tuple[str, str, int]) -> Measured:
            folder = work / "_".join(map(str, job))
            return run_apart(overrides(*job, args), folder, CPU_CLOCK)

        found: dict[tuple[str, str], list[Measured]] = {}
        for (scene, variant, _), run in zip(jobs, pool.map(measure, jobs), strict=True):
            runs = found.setdefault((scene, variant), [])
            runs.append(run)
            if len(runs) == args.seeds:
                print("  ".join(row(scene, variant, runs)), flush=True)
    rows = [row(*key, runs) for key, runs in found.items()]
    budget = f"{args.steps} steps" if args.seconds is None else f"{args.seconds:g} s"
    plot(found, args.name)
    write_rows(RESULTS / f"{args.name}.csv", COLUMNS, rows)
    text = [
        f"# {args.title}",
        "",
        f"After {budget} at {args.resolution} pixels, "
        f"{f'means of {args.seeds} seeds' if args.seeds > 1 else 'one seed'}. {machine()}. "
        "`PSNR of the object` is that of the pixels that show the foreground object.",
        "",
        f"    {command()}",
        "",
        f"![PSNR of each variant]({args.name}.png)",
        "",
        markdown(COLUMNS, rows),
        "",
        "Seconds are CPU time of training with one thread, without the preparation of `_tiny`. "
        "Memory is the peak over the whole run.",
        "",
        *legend(args.variants.split(",")),
    ]
    write_text(RESULTS / f"{args.name}.md", "\n".join(text) + "\n")


if __name__ == "__main__":
    main()
