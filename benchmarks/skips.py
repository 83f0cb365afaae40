"""What each saving saves, and what it costs: same steps and rays, one saving off at a time.

    python benchmarks/skips.py [--lego FOLDER] [--steps 400] [--resolution 100]

Writes results/skips.md and results/skips.csv beside this file. Seconds are the training clock of
one process with nothing else running; compare them within one scene only.
"""

import os

from xplanes.threads import waiting

os.environ.update(waiting(os.environ))

import argparse
import tempfile
from pathlib import Path

from runner import RESULTS, Measured, lego, machine, markdown, measure

from xplanes.files import write_rows, write_text

SWITCHES = {
    "all savings": (),
    "empty space off": ("sampler.skip_empty=false",),
    "occlusion off": ("sampler.skip_occluded=false",),
    "silhouettes off": ("sampler.silhouettes=false",),
    "background off": ("data.skip_background=false",),
    "coarse start off": ("sampler.coarse_steps=0",),
    "all off": (
        "sampler.skip_empty=false",
        "sampler.skip_occluded=false",
        "sampler.silhouettes=false",
        "data.skip_background=false",
        "sampler.coarse_steps=0",
    ),
}

COLUMNS = (
    "scene",
    "savings",
    "steps",
    "seconds",
    "times slower",
    "psnr",
    "psnr change",
    "samples a ray",
    "empty",
    "occluded",
    "background",
)


def train(scene: list[str], switches: tuple[str, ...], work: Path, args) -> Measured:
    """One run with equal rays at equal steps."""
    overrides = [
        *scene,
        "lrm=none",
        f"data.resolution={args.resolution}",
        f"trainer.max_steps={args.steps}",
        "trainer.max_seconds=null",
        "trainer.rays_per_batch=512",
        # No limit on samples, so that every run sees the same rays at the same step.
        "trainer.samples_per_batch=1000000",
        "trainer.evaluate_at=[]",
        "trainer.media=false",
        "trainer.accelerator=cpu",
        *switches,
    ]
    return measure(overrides, work)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--lego", type=Path, default=Path("../shared/scenes/lego"))
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--resolution", type=int, default=100)
    args = parser.parse_args()
    scenes = {
        "demo excavator": ["data.scene=excavator"],
        "demo balls": ["data.scene=balls"],
    }
    if args.lego.is_dir():
        scenes["lego (val)"] = lego(args.lego)
    rows = []
    with tempfile.TemporaryDirectory() as work:
        for name, scene in scenes.items():
            base: dict = {}
            for label, switches in SWITCHES.items():
                metrics = train(scene, switches, Path(work), args).metrics
                base = base or metrics
                seconds, psnr = metrics["seconds"]["train"], metrics["test"]["psnr"]
                rows.append(
                    (
                        name,
                        label,
                        metrics["step"],
                        f"{seconds:.1f}",
                        f"{seconds / base['seconds']['train']:.2f}",
                        f"{psnr:.2f}",
                        f"{psnr - base['test']['psnr']:+.2f}",
                        f"{metrics['samples_per_ray']:.1f}",
                        *(
                            f"{100 * metrics['skipped'][kind]:.0f}%"
                            for kind in ("empty", "occluded", "background")
                        ),
                    )
                )
    write_rows(RESULTS / "skips.csv", COLUMNS, rows)
    page = f"""# Savings, one switched off at a time

{args.steps} steps of 512 rays, {args.resolution} px, six planes at random; {machine()}.
Script: `benchmarks/skips.py`.

empty and occluded: shares of the samples in the box; background: share of the pixels.

{markdown(COLUMNS, rows)}
"""
    write_text(RESULTS / "skips.md", page)


if __name__ == "__main__":
    main()
