"""The moving picture of README.md: the demo scene's truth beside its field, from step 0 to the end.

    python benchmarks/hero.py [--seconds 60] [--frames 48] [--out docs/hero.webp]

Trains with default settings on the demo scene at 256 pixels, in CPU seconds of one core. While it
trains, an orbiting camera takes one frame after the other, at times that run forwards and back: the
right picture is the field as it was then. None of these views is trained on.
"""

import argparse
import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from PIL import Image, ImageDraw, ImageFont
from runner import CPU_CLOCK, run_apart

from xplanes.files import replacing
from xplanes.rendering.pictures import to_bytes
from xplanes.scenes.cameras import PosedCamera
from xplanes.synthetic.demo.render import CAMERA_ANGLE_X, camera_at, render_image
from xplanes.synthetic.demo.scenes import build_demo_scene
from xplanes.training.clock import off_clock, training_seconds
from xplanes.training.module import RadianceModule

SCENE, SIZE = "excavator", 256
RENDERED, BOX = 336, (40, 80, 296, 336)
"""Pixels that are rendered, and what is shown of them: where the scene is."""

CAPTION, GAP, QUALITY = 34, 6, 60
"""Pixels of the caption and between the pictures; quality of WebP."""

DURATION, HELD = 110, 2500
"""Milliseconds of a frame, and of the last one."""


class Video(Callback):
    """Takes the frames of the video into the run directory.

    Args:
        frames: How many; the first is that of the initialisation.
        cycles: How often time runs forwards and back.
    """

    def __init__(self, frames: int, cycles: float = 2) -> None:
        self.frames, self.cycles, self._next = frames, cycles, 0

    def due(self, progress: float) -> bool:
        """Whether the next frame is to be taken: at shares that lie closer at the beginning."""
        return self._next < self.frames and progress >= (self._next / (self.frames - 1)) ** 2.5

    def camera(self) -> PosedCamera:
        """The camera of the next frame, which orbits by a third of a turn."""
        pose = camera_at(25 + 120 * self._next / self.frames, 24)
        return PosedCamera(
            pose, 0.5 * RENDERED / math.tan(0.5 * CAMERA_ANGLE_X), RENDERED, RENDERED
        )

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.take(trainer, pl_module)

    def on_train_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: object,
        batch: object,
        batch_idx: int,
    ) -> None:
        self.take(trainer, pl_module)

    @torch.no_grad()
    def take(self, trainer: Trainer, module: LightningModule) -> None:
        """Take the frames that are due."""
        assert isinstance(module, RadianceModule)
        assert module.frame is not None
        while self.due(module.progress):
            with off_clock(trainer):
                camera = self.camera()
                time = abs((2 * self.cycles * self._next / self.frames + 1) % 2 - 1)
                views = module.renderer.view(
                    module.field, module.frame, camera, time, torch.ones(3)
                )
                folder = Path(trainer.default_root_dir) / "video"
                folder.mkdir(exist_ok=True)
                name = f"{self._next:03d}_{time:.4f}_{training_seconds(trainer):.1f}.png"
                Image.fromarray(to_bytes(views["colour"].clamp(0, 1)).numpy()).save(folder / name)
            self._next += 1


def truth(video: Video, place: int, time: float) -> Image.Image:
    """The scene as the camera of a frame sees it, on white."""
    video._next = place
    pose = video.camera().camera_to_world
    picture = Image.fromarray(render_image(build_demo_scene(SCENE, 0).pose(time), pose, RENDERED))
    white = Image.new("RGBA", picture.size, "white")
    return Image.alpha_composite(white, picture).convert("RGB").crop(BOX)


def beside(true: Image.Image, field: Image.Image, words: Sequence[str]) -> Image.Image:
    """Two pictures under their captions."""
    sheet = Image.new("RGB", (2 * SIZE + GAP, SIZE + CAPTION), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(22)
    for place, (picture, word) in enumerate(zip((true, field), words, strict=True)):
        left = place * (SIZE + GAP)
        sheet.paste(picture, (left, CAPTION))
        draw.text((left + SIZE / 2, CAPTION / 2), word, fill="black", font=font, anchor="mm")
    return sheet


def psnr(a: Image.Image, b: Image.Image) -> float:
    error = (np.asarray(a, np.float64) - np.asarray(b, np.float64)) / 255
    return float(-10 * np.log10(np.square(error).mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--frames", type=int, default=48)
    parser.add_argument("--out", type=Path, default=Path("docs/hero.webp"))
    parser.add_argument("--work", type=Path, default=Path("outputs/benchmarks/hero"))
    args = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    folder = (args.work / f"{args.seconds:g}s_{args.frames}").absolute()
    lines = [f"data.scene={SCENE}", f"data.resolution={SIZE}", "callbacks.evaluation.at=[]"]
    lines += [f"trainer.max_seconds={args.seconds:g}", "trainer.accelerator=cpu", "plugins=[hero]"]
    lines += ["+callbacks.hero._target_=hero.Video", f"+callbacks.hero.frames={args.frames}"]
    run_apart(lines, folder, CPU_CLOCK)
    video, sheets, words = Video(args.frames), [], ""
    for path in sorted((folder / "video").glob("*.png")):
        place, time, seconds = path.stem.split("_")
        true, field = (
            truth(video, int(place), float(time)),
            Image.open(path).convert("RGB").crop(BOX),
        )
        words = f"{float(seconds):.0f} s, {psnr(true, field):.1f} dB"
        sheets.append(beside(true, field, ("truth", words)))
    durations = [DURATION] * (len(sheets) - 1) + [HELD]
    with replacing(args.out) as temporary:
        sheets[0].save(
            temporary,
            format="WEBP",
            save_all=True,
            append_images=sheets[1:],
            duration=durations,
            loop=0,
            quality=QUALITY,
            method=6,
        )
    print(f"{args.out}: {args.out.stat().st_size / 1000:.0f} KB, {len(sheets)} frames, {words}")


if __name__ == "__main__":
    main()
