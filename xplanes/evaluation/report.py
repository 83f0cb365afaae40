"""Reports of a run: header, metrics.json, hyperparameters, closing lines."""

import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor
from torch.utils.tensorboard.summary import hparams
from torch.utils.tensorboard.writer import SummaryWriter

from xplanes import __version__, backend
from xplanes.evaluation.estimate import Estimate, estimated
from xplanes.experiment import Experiment
from xplanes.process import resume_command
from xplanes.rendering.pictures import write_png
from xplanes.rendering.refining import RefiningSampler
from xplanes.scenes.datamodule import SceneDataModule
from xplanes.scenes.views import Views
from xplanes.training.checkpoints import LAST, training_so_far
from xplanes.training.clock import training_seconds, training_share
from xplanes.training.evaluation import log_image
from xplanes.training.fit import Trainer
from xplanes.training.module import RadianceModule
from xplanes.training.scores import ViewScore, blank_psnr, mean_colour, mean_scores

LITTLE = 0.5  # Gain in dB over background-only images below which a run has learnt nothing.
BUSY = 0.6  # CPU time per second of training on the CPU below which a run warns.

CLUTTERED = 0.2
"""Share of floaters above which a run warns; successful scenes have less than a tenth."""


def header(
    experiment: Experiment,
    run: Path,
    data: SceneDataModule,
    module: RadianceModule,
    overrides: Sequence[str],
    expected: Estimate,
    spent: float,
    checkpoint: Path | None = None,
) -> str:
    """The lines printed before training: software, data, model, budget and expected time.

    Args:
        experiment: The settings.
        run: The run directory.
        data: The data.
        module: The module, with its field.
        overrides: Overrides from the command line.
        expected: Expected durations.
        spent: Seconds since the start of this process's part of the run.
        checkpoint: The checkpoint from which training continues, if any.
    """
    assert module.frame is not None
    assert module.initialisation is not None
    scene = data.scene
    frame, device, trainer = module.frame, experiment.device, experiment.trainer
    counts = " / ".join(f"{len(views)} {name}" for name, views in scene.splits.items())
    if data.held_out:
        counts += " (held out of train)"
    train = scene.splits["train"]
    size = sum(views.nbytes for views in scene.splits.values()) / 2**20
    where = " (training views on disk)" if train.is_stored else ""
    trainable = sum(p.numel() for p in module.parameters() if p.requires_grad)
    frozen = sum(p.numel() for p in module.parameters()) - trainable
    cube = f"cube {2 / frame.scale:.2f} wide" + (f", from {frame.source}" if frame.source else "")
    moving = ""
    if not module.field.moves:
        reason = scene.static_reason or "one timestep only"
        moving = f" · static, without time planes: {reason}"
    budget = {"step": trainer.get("max_steps", -1), "epoch": trainer.get("max_epochs")}
    budget = {unit: count for unit, count in budget.items() if count is not None and count >= 0}
    limits = [f"{count} {unit}{'s' * (count != 1)}" for unit, count in budget.items()]
    if (seconds := trainer.get("max_seconds")) is not None:
        limits.append(f"{seconds:g} s")
    done, trained = (0, 0.0) if checkpoint is None else training_so_far(checkpoint)
    lines = {
        "xplanes": f"{__version__} · torch {torch.__version__} · {device} · "
        f"{torch.get_num_threads()} threads · precision {module.field.precision} · "
        f"{backend.name(device)}",
        "run": str(run),
        **({"resumed": f"after step {done}, {trained:.0f} s of training"} if done else {}),
        "data": f"{experiment.data.name} {scene.name} · {counts} views · "
        f"{train.outline} · {size:.1f} MB{where} · {cube}",
        "model": f"{experiment.method.model.name} {module.field.outline} · "
        f"{trainable:,} parameters, {frozen:,} frozen{moving}",
        "from": module.initialisation.description,
        "samples": module.sampler.outline,
        "budget": " or ".join(limits) + ", whichever comes first" * (len(limits) > 1),
        "estimate": estimated(experiment, data, module, expected, spent, done, trained),
        "changed": " ".join(overrides) or "(nothing)",
    }
    return "\n".join(f"{name:<9}{text}" for name, text in lines.items())


def summary(
    trainer: Trainer,
    module: RadianceModule,
    scores: Sequence[ViewScore],
    data: SceneDataModule,
    seconds: dict[str, Any],
) -> dict[str, Any]:
    """The content of metrics.json."""
    clock = training_seconds(trainer)
    counts = module.tally.counts
    candidates = max(1, counts["candidates"])
    # Not the module's, which Lightning moves back to the CPU at the end.
    device = trainer.strategy.root_device
    tested, blank = data.scene.splits[data.test_split], data.scene.background
    if data.scene.is_surrounded:
        blank = mean_colour(tested, blank)  # A learnt background has no constant colour.
    return {
        "split": data.test_split,
        "test": mean_scores(scores),
        "blank_psnr": blank_psnr(tested, blank),
        "views": [{"file": s.file, "time": s.time, **s.scores} for s in scores],
        "step": trainer.global_step,
        "seconds": seconds,
        "rays_per_second": counts["rays"] / max(clock, 1e-9),
        "samples_per_ray": counts["samples"] / max(1, counts["rays"]),
        "skipped": {
            "empty": counts["empty"] / candidates,
            "occluded": counts["occluded"] / candidates,
            "no_room": counts["no_room"] / max(1, counts["rays"] + counts["no_room"]),
            "background": data.batches_for(module, 0).skipped,
            "static": float(not module.field.moves),
        },
        **refined_cameras(module, data.scene.splits["train"]),
        "steps_skipped": module.tally.skipped,
        "restarts": module.restarts,
        "threads": torch.get_num_threads(),
        "cpu_share": training_share(trainer),
        "loops": backend.name(device),
        "parameters": sum(p.numel() for p in module.parameters()),
        "peak_memory_bytes": device_memory(device),
    }


def refined_cameras(module: RadianceModule, views: Views) -> dict[str, Any]:
    """Entry ``cameras``: motion and poses of the training cameras; empty if not refined."""
    frame, sampler = module.frame, module.sampler
    if frame is None or not isinstance(sampler, RefiningSampler):
        return {}
    moved = sampler.cameras.moved[sampler.cameras.index].tolist()
    poses = sampler.corrected(views.camera_to_world, frame).tolist()
    farthest = max(range(len(moved)), key=moved.__getitem__)
    return {
        "cameras": {
            "mean_px": sum(moved) / len(moved),
            "most_px": moved[farthest],
            "farthest": views.files[farthest],
            "camera_to_world": dict(zip(views.files, poses, strict=True)),
        }
    }


def rest(seconds: dict[str, Any], total: float) -> dict[str, float]:
    """``other``, the time that no stage of ``seconds`` accounts for, and ``total``."""
    # Cached stages count with their original duration, which may exceed the run's own time.
    named = sum(seconds["prepare"].values())
    named += sum(value for name, value in seconds.items() if name != "prepare")
    return {"other": max(0.0, total - named), "total": total}


def write_pictures(trainer: Trainer, pictures: Mapping[str, Tensor], *, log: bool) -> None:
    """Write images of the preparation to the run's media and, if wanted, to the loggers.

    Args:
        trainer: The Trainer, with run directory and loggers.
        pictures: By name, colours from 0 to 1. [H, W, 3] each
        log: Whether to pass them to the loggers, too.
    """
    for name, picture in pictures.items():
        write_png(Path(trainer.default_root_dir) / "media" / f"{name}.png", picture)
        if log:
            log_image(trainer, name, picture, 0)


def log_hparams(trainer: Trainer, experiment: Experiment, metrics: dict[str, Any]) -> None:
    """Log the settings by which runs are compared, with the final scores."""
    method, data = experiment.method, experiment.data
    model: Any = method.model
    parameters = {
        "scene": data.scene,
        "views": data.views or 0,
        "model": model.name,
        "resolution": getattr(model, "resolution", 0),
        "channels": getattr(model, "channels", 0),
        "lrm": metrics["lrm"].get("name", method.lrm.name),  # What lrm=auto chose.
        "seed": method.seed,
        "learning_rate": getattr(model, "learning_rate", getattr(model, "plane_lr", 0.0)),
    }
    scores = {f"{metrics['split']}/{name}": value for name, value in metrics["test"].items()}
    scores["time/train_s"] = metrics["seconds"]["train"]
    for logger in trainer.loggers:
        if isinstance(logger, TensorBoardLogger):
            with SummaryWriter(logger.log_dir) as writer:
                assert writer.file_writer is not None
                for entry in hparams(parameters, scores):
                    writer.file_writer.add_summary(entry)
                for name in scores.keys() - trainer.logged_metrics.keys():  # Others are logged.
                    writer.add_scalar(name, scores[name], metrics["step"])
        else:
            logger.log_hyperparams(parameters)
            logger.log_metrics(scores, metrics["step"])


def closing(run: Path, experiment: Experiment, metrics: dict[str, Any]) -> str:
    """The lines printed at the end: scores, time, paths, and suggested next commands."""
    seconds, skipped = metrics["seconds"], metrics["skipped"]
    limits, more = experiment.trainer, ""
    if 0 <= limits.get("max_steps", -1) <= 2 * metrics["step"]:
        more += f" trainer.max_steps={2 * metrics['step']}"
    if (most := limits.get("max_seconds")) is not None and 2 * seconds["train"] > most:
        more += f" trainer.max_seconds={2 * most:g}"
    test, blank = metrics["test"], metrics["blank_psnr"]
    scores = f"psnr {test['psnr']:.2f}  ssim {test['ssim']:.4f}"
    if "psnr_foreground" in test:
        scores += f"  of the object {test['psnr_foreground']:.2f}"
    if "floaters" in test:
        scores += f"  floaters {100 * test['floaters']:.2f}%"
    lines = [
        f"\n{metrics['split']:<9}{scores}  over {len(metrics['views'])} views, step "
        f"{metrics['step']}"
    ]
    if test["psnr"] < blank + LITTLE:
        lines.append(
            f"warning  hardly better than background-only images ({blank:.2f} dB): this run has "
            "learnt nothing yet"
        )
    if (share := test.get("floaters", 0)) > CLUTTERED:
        lines.append(
            f"warning  {100 * share:.0f}% of the background is not empty (floaters): train longer, "
            "or check the cameras and times; content that\n         is too thin or too fast for "
            "the views shows up as floaters as well"
        )
    if experiment.device.type == "cpu" and (share := metrics["cpu_share"]) < BUSY:
        lines.append(
            f"warning  training got {share:.1f} s of CPU time per second: other programs use this "
            "machine, or a disk\n         is slow; an idle machine trains further in the same time"
        )
    if (cameras := metrics.get("cameras")) is not None:
        lines.append(
            f"cameras  moved by {cameras['mean_px']:.2f} px on average, at most by "
            f"{cameras['most_px']:.2f} px ({cameras['farthest']}); poses in metrics.json"
        )
    stages = {
        "reading the scene": seconds["load"],
        "loading and compiling loops": seconds["warm_up"],
        "scoring": seconds["evaluate"],
        "start, checkpoints and video": seconds["other"],
    }
    spent = [f"{name} {value:.1f} s" for name, value in stages.items() if value >= 1]
    lines += [
        f"time     prepare {sum(seconds['prepare'].values()):.1f} s + train "
        f"{seconds['train']:.1f} s, {metrics['rays_per_second'] / 1000:.1f}k rays/s",
        f"         {seconds['total']:.1f} s in all; {', '.join(spent)}",
    ]
    if metrics["samples_per_ray"]:
        lines.append(
            f"skipped  {100 * skipped['empty']:.0f}% of samples in empty space, "
            f"{100 * skipped['occluded']:.0f}% behind surfaces, "
            f"{100 * skipped['background']:.0f}% of pixels as background; "
            f"{metrics['samples_per_ray']:.1f} samples per ray remained"
        )
    place = shlex.quote(str(run))
    steps = [f"tensorboard --logdir {place}"] * any(run.rglob("events.out.tfevents.*"))
    kept = ""
    if (run / "checkpoints" / LAST).is_file():  # Else there is nothing to render or to resume.
        kept = "checkpoints/last.ckpt  "
        named = "".join(f" --plugin {name}" for name in experiment.config.get("plugins") or [])
        steps += [f"xplanes render {place}{named}", resume_command(run) + more]
    curve = "curve.csv  " * (run / "curve.csv").is_file()
    lines += [
        f"memory   {metrics['peak_memory_bytes'] / 2**30:.1f} GB at its peak",
        f"wrote    {run}",
        f"         metrics.json  {curve}{kept}{metrics.get('media', '')}",
        *(f"{'next' if line is steps[0] else '':<9}{line}" for line in steps),
    ]
    return "\n".join(lines)


def device_memory(device: torch.device) -> int:
    """Peak memory in bytes: of the device if it is a GPU, else of this process."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    if sys.platform == "win32":
        from psutil import Process

        return Process().memory_info().peak_wset
    import resource

    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024  # Only macOS counts in bytes.
