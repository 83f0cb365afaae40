"""What a run says of itself: its first lines, metrics.json, TensorBoard, its last lines."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from xplanes import __version__, backend
from xplanes.config import TrainConfig
from xplanes.process import train_command
from xplanes.rendering.pictures import write_png
from xplanes.scenes.frame import Frame
from xplanes.scenes.views import Scene
from xplanes.training.module import RadianceModule
from xplanes.training.scorer import device_memory
from xplanes.training.scoring import ViewScore, mean


def header(
    config: TrainConfig,
    run: Path,
    scene: Scene,
    frame: Frame,
    module: RadianceModule,
    device: torch.device,
    overrides: list[str],
    start: str,
) -> str:
    """The lines printed before training: what is about to happen, on what, from what ``start``."""
    counts = " / ".join(f"{len(views)} {name}" for name, views in scene.splits.items())
    train = scene.splits["train"]
    size = sum(views.nbytes for views in scene.splits.values()) / 2**20
    trainable = sum(p.numel() for p in module.parameters() if p.requires_grad)
    frozen = sum(p.numel() for p in module.parameters()) - trainable
    moving = ""
    if not module.field.moves:
        reason = scene.still or "one moment only"
        moving = f" · trains as a still one, without planes of time: {reason}"
    budget = f"{config.trainer.max_steps} steps"
    if config.trainer.max_seconds is not None:
        budget += f" or {config.trainer.max_seconds:g} s, whichever comes first"
    lines = {
        "xplanes": f"{__version__} · torch {torch.__version__} · {device} · "
        f"up to {torch.get_num_threads()} threads · decoder {module.field.precision} · "
        f"{backend.name(device)}",
        "run": str(run),
        "data": f"{config.data.name} {scene.name} · {counts} views · "
        f"{train.width}x{train.height} px · {size:.1f} MB · cube {2 / frame.scale:.2f} wide",
        "model": f"{config.model.name} {module.field.outline} · "
        f"{trainable:,} parameters, {frozen:,} frozen{moving}",
        "start": start,
        "space": module.sampling.outline,
        "plan": budget,
        "changed": " ".join(overrides) or "(nothing)",
    }
    return "\n".join(f"{name:<9}{text}" for name, text in lines.items())


def summary(
    module: RadianceModule,
    scores: list[ViewScore],
    split: str,
    seconds: dict[str, Any],
    background_skipped: float,
) -> dict[str, Any]:
    """The content of metrics.json."""
    counts = module.counts
    candidates = max(1, counts["candidates"])
    return {
        "split": split,
        "test": {
            "psnr": mean([s.psnr for s in scores]),
            "ssim": mean([s.ssim for s in scores]),
        },
        "views": [{"file": s.file, "time": s.time, "psnr": s.psnr, "ssim": s.ssim} for s in scores],
        "step": module.global_step,
        "seconds": seconds,
        "rays_per_second": counts["rays"] / max(module.clock, 1e-9),
        "samples_per_ray": counts["samples"] / max(1, counts["rays"]),
        "skipped": {
            "empty": counts["empty"] / candidates,
            "occluded": counts["occluded"] / candidates,
            "gradients": 1 - counts["passed"] / max(1, counts["samples"]),
            "background": background_skipped,
            "static": float(not module.field.moves),
            "budget": 0.0 if module.ending is None else 1 - module.spent,
        },
        "converged": None if module.ending is None else module.ending[0],
        "steps_skipped": module.unusable,
        "threads": module.threads,
        "loops": backend.name(module.device),
        "parameters": sum(p.numel() for p in module.parameters()),
        "peak_memory_bytes": device_memory(module.device),
    }


def write_start(run: Path, pictures: Mapping[str, Tensor], *, log: bool) -> None:
    """Write the pictures of what happened before training, if anything did.

    Args:
        run: The run directory.
        pictures: By name, colours from 0 to 1. [H, W, 3] each
        log: Whether they go to TensorBoard too.
    """
    from torch.utils.tensorboard.writer import SummaryWriter

    for name, picture in pictures.items():
        write_png(run / "media" / f"{name}.png", picture)
        if log:
            with SummaryWriter(str(run / "tb")) as writer:
                writer.add_image(name, picture, 0, dataformats="HWC")


def write_hparams(run: Path, config: TrainConfig, metrics: dict[str, Any]) -> None:
    """One HParams entry per run, with its final scores."""
    from torch.utils.tensorboard.writer import SummaryWriter

    parameters = {
        "scene": config.data.scene,
        "views": config.data.views or 0,
        "model": config.model.name,
        "resolution": config.model.resolution,
        "channels": config.model.channels,
        "lrm": config.lrm.name,
        "seed": config.seed,
        "learning_rate": getattr(config.model, "learning_rate", config.trainer.plane_lr),
    }
    scores = {f"{metrics['split']}/{name}": value for name, value in metrics["test"].items()}
    scores["time/train_s"] = metrics["seconds"]["train"]
    with SummaryWriter(str(run / "tb")) as writer:
        writer.add_hparams(parameters, scores, run_name=".", global_step=metrics["step"])


def closing(run: Path, config: TrainConfig, metrics: dict[str, Any]) -> str:
    """The lines printed at the end: scores, time, paths, and what to do next."""
    seconds, skipped = metrics["seconds"], metrics["skipped"]
    more = f"trainer.max_steps={2 * metrics['step']}"
    if config.trainer.max_seconds is not None:
        more = f"trainer.max_seconds={2 * config.trainer.max_seconds:g}"
    plateau = ""
    if metrics["converged"] is not None:
        more = "trainer.plateau=null"
        plateau = (
            f"; {100 * skipped['budget']:.0f}% of the budget, as training had converged at step "
            f"{metrics['converged']}"
        )
    prepare = sum(seconds["prepare"].values())
    warm_up = f"compiling {seconds['warm_up']:.1f} s · " if seconds["warm_up"] >= 1 else ""
    return "\n".join(
        [
            "",
            f"{metrics['split']:<9}psnr {metrics['test']['psnr']:.2f}  ssim "
            f"{metrics['test']['ssim']:.4f}  over {len(metrics['views'])} views, step "
            f"{metrics['step']}",
            f"time     prepare {prepare:.1f} s + train {seconds['train']:.1f} s · {warm_up}scoring "
            f"{seconds['evaluate']:.1f} s · {seconds['total']:.1f} s in all · "
            f"{metrics['rays_per_second'] / 1000:.1f}k rays/s",
            f"skipped  {100 * skipped['empty']:.0f}% of samples in empty space, "
            f"{100 * skipped['occluded']:.0f}% behind surfaces, "
            f"{100 * skipped['background']:.0f}% of pixels as background; "
            f"{metrics['samples_per_ray']:.1f} samples a ray remained, gradients of "
            f"{100 * (1 - skipped['gradients']):.0f}% of them{plateau}",
            f"wrote    {run}",
            f"         metrics.json  curve.csv  checkpoints/last.ckpt  {metrics.get('media', '')}",
            f"next     tensorboard --logdir {run}",
            f"         xplanes render {run}",
            f"         {train_command()} resume={run} {more}",
        ]
    )
