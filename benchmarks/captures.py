"""What captures without silhouettes reach, with and without a background behind the field's cube.

    python benchmarks/captures.py [--scenes phone,rig] [--steps 1000] [--resolution 100]
        [--variants plain,sky,world,masks,world_tiny,masks_tiny] [--seeds 1]
        [--pictures FOLDER] [KEY=VALUE ...]

Writes results/captures.md and captures.csv beside this file. The scenes are procedural captures of
the suite, whose masks of the thing are known: scores are those of whole pictures, and of the pixels
that show the thing. `plain` trains without a background, `sky` with one whose colour depends on
direction alone, `world` with the default, and `masks` is told by silhouettes what is the thing; all
begin from random values, those with `_tiny` from the LRM that is bundled.
"""

import os

from xplanes.process import waiting

os.environ.update(waiting(os.environ))

import argparse
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from runner import RESULTS, command, machine, markdown
from torch import Tensor

from xplanes.config import compose_plain
from xplanes.files import write_rows, write_text
from xplanes.metrics import psnr
from xplanes.scenes.datamodule import SceneDataModule
from xplanes.scenes.demo.write import MASKS
from xplanes.scenes.views import Scene, Views
from xplanes.training.evaluation import render_view
from xplanes.training.fit import fit_quietly
from xplanes.training.module import RadianceModule

VARIANTS = {
    "plain": ["lrm=none", "model.background=null"],
    "sky": ["lrm=none", "model.background.samples=0"],
    "world": ["lrm=none"],
    "masks": ["lrm=none"],
    "world_tiny": ["lrm=tiny"],
    "masks_tiny": ["lrm=tiny"],
}
VIEWS = {"phone": 60, "rig": 96}
COLUMNS = ("scene", "variant", "PSNR, dB", "PSNR of the thing, dB", "seconds", "ms a step")
SHOWN = 3
"""Scored views in a picture."""


def masks_of(folder: Path, views: Views) -> Tensor:
    """Share of each pixel that shows the thing. uint8 [V, H, W]"""
    files = [np.asarray(Image.open(folder / MASKS / file)) for file in views.files]
    return torch.from_numpy(np.stack(files))


def cut_out(views: Views, masks: Tensor) -> Views:
    """The views with the masks as alpha."""
    images = views.in_memory().clone()
    images[..., :3] = (images[..., :3].float() * masks[..., None] / 255).round().to(torch.uint8)
    images[..., 3] = masks
    return replace(views, images=images)


def measure(
    scene: Scene, folder: Path, variant: str, overrides: list[str], steps: int, picture: Path | None
) -> list[float]:
    """PSNR of whole pictures and of the thing, and seconds of training."""
    module = RadianceModule.compose(*VARIANTS[variant], *overrides)
    train, test = scene.splits["train"], scene.splits["test"]
    given = scene
    if variant.startswith("masks"):
        given = replace(scene, splits={"train": cut_out(train, masks_of(folder, train))})
    module.build(given)
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as work:
        fit_quietly(
            module,
            given,
            Path(work),
            device=torch.device("cpu"),
            max_steps=steps,
            max_seconds=1e6,
            checkpoint_every=10**6,
        )
    seconds = time.perf_counter() - began
    module.eval()
    assert module.frame is not None
    whole, thing, rows = [], [], []
    for index, mask in enumerate(masks_of(folder, test) >= 128):
        truth = test.composite(index, scene.background)
        found = render_view(
            module.field, module.renderer, module.frame, test, index, scene.background
        )
        colour = found["colour"].float().clamp(0, 1)
        whole.append(psnr(colour, truth))
        thing.append(psnr(colour[mask], truth[mask]))
        if index % max(1, len(test) // SHOWN) == 0:
            opacity = found["opacity"].float()[..., None].expand_as(truth)
            rows.append(torch.cat([truth, colour, opacity], dim=1))
    if picture is not None:
        pixels = (255 * torch.cat(rows)).round().to(torch.uint8).numpy()
        Image.fromarray(pixels).save(picture)
    return [statistics.mean(whole), statistics.mean(thing), seconds]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--scenes", default="phone,rig")
    parser.add_argument("--variants", default=",".join(VARIANTS))
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--resolution", type=int, default=100)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--root", type=Path, default=Path("data/suite"), help="of the scenes")
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--pictures", type=Path, help="folder of rendered views beside the truth")
    parser.add_argument("overrides", nargs="*", help="settings of train.py")
    args = parser.parse_args()
    rows = []
    for name in args.scenes.split(","):
        count = VIEWS[name.removesuffix("_test")]
        data = ["data=suite", f"data.scene={name}", f"data.resolution={args.resolution}"]
        data += [f"data.root={args.root}", f"data.train_views={count}"]
        settings = SceneDataModule(compose_plain("train", data)["data"])
        folder = settings.settings.folder
        settings.read_split("test")
        for variant in args.variants.split(","):
            picture = None
            if args.pictures is not None:
                args.pictures.mkdir(parents=True, exist_ok=True)
                picture = args.pictures / f"{name}_{variant}.png"
            found = [
                measure(
                    settings.scene,
                    folder,
                    variant,
                    [*args.overrides, f"seed={seed}"],
                    args.steps,
                    picture,
                )
                for seed in range(args.seeds)
            ]
            means = [statistics.mean(values) for values in zip(*found, strict=True)]
            row = [name, variant, f"{means[0]:.2f}", f"{means[1]:.2f}", f"{means[2]:.0f}"]
            rows.append([*row, f"{1000 * means[2] / args.steps:.0f}"])
            print("  ".join(rows[-1]), flush=True)
    write_rows(args.out / "captures.csv", COLUMNS, rows)
    text = [
        "# Captures without silhouettes",
        "",
        f"After {args.steps} steps at {args.resolution} pixels, mean over {args.seeds} "
        f"seed{'s' if args.seeds > 1 else ''}. {machine()}.",
        "",
        f"    {command()}",
        "",
        markdown(COLUMNS, rows),
    ]
    write_text(args.out / "captures.md", "\n".join(text) + "\n")


if __name__ == "__main__":
    main()
