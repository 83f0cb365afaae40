"""Scores of a trained run, view by view."""

import time
from pathlib import Path
from typing import Any

from xplanes.evaluation.perceptual import Metric, UnavailableError, lpips
from xplanes.evaluation.progress import progress
from xplanes.evaluation.runs import TrainedRun
from xplanes.files import write_json
from xplanes.training.scores import ViewImages, ViewScore, mean, score_view

DEFAULT_NETWORK = "vgg"


def evaluate(trained: TrainedRun, network: str | None = None) -> dict[str, Any]:
    """Score all views of the run's split with the code that scores them in training.

    Args:
        trained: The run.
        network: Network of LPIPS, ``vgg`` or ``alex``, downloaded if need be; ``none`` leaves LPIPS
            out; None takes vgg if it is on this machine.

    Returns:
        What `write_scores` writes: the keys of metrics.json as far as they are scores, and
        ``not_computed``, from a score's name to the reason.
    """
    views, module = trained.views, trained.module
    tag, metric, missing = _lpips(trained, network)
    began = time.perf_counter()
    rows = []
    for index in progress(range(len(views)), len(views), "views"):
        score, images = score_view(
            module.field,
            module.renderer,
            trained.frame,
            views,
            index,
            trained.scene.background,
        )
        rows.append(_row(score, images, tag, metric))
    names = dict.fromkeys(name for row in rows for name in row if name not in ("file", "time"))
    return {
        "split": trained.split,
        "checkpoint": trained.checkpoint,
        "step": trained.step,
        "test": {name: mean([row[name] for row in rows if name in row]) for name in names},
        "views": rows,
        "not_computed": missing,
        "seconds": time.perf_counter() - began,
    }


def _lpips(trained: TrainedRun, network: str | None) -> tuple[str, Metric | None, dict[str, str]]:
    """The tag of LPIPS, the metric if it can be had, and else the reason under the tag."""
    if network == "none":
        return "", None, {}
    name = network or DEFAULT_NETWORK
    tag = f"lpips_{name}"
    side = int(trained.views.intrinsics.size.min())
    device = str(trained.module.device)
    try:
        return tag, lpips(name, side, device, download=network is not None), {}
    except UnavailableError as reason:
        return tag, None, {tag: str(reason)}


def _row(score: ViewScore, images: ViewImages, tag: str, metric: Metric | None) -> dict[str, Any]:
    row = {"file": score.file, "time": score.time, **score.scores}
    return row if metric is None else {**row, tag: metric(images.colour, images.truth)}


def write_scores(run: Path, scores: dict[str, Any]) -> Path:
    """Write evaluation_<split>.json, or evaluation_<split>_best.json; metrics.json stays."""
    mark = "" if scores["checkpoint"] == "last" else f"_{scores['checkpoint']}"
    path = run / f"evaluation_{scores['split']}{mark}.json"
    write_json(path, scores)
    return path


def score_table(scores: dict[str, Any]) -> str:
    """One line per view, then the means."""
    names = list(scores["test"])
    width = max([len(row["file"]) for row in scores["views"]] + [len("mean of 000 views")])
    lines = [f"{'view':<{width}}   time" + "".join(f"{name:>12}" for name in names)]
    lines += [
        f"{row['file']:<{width}}  {row['time']:.3f}" + _numbers(row, names)
        for row in scores["views"]
    ]
    label = f"mean of {len(scores['views'])} views"
    lines.append(f"{label:<{width}}       " + _numbers(scores["test"], names))
    lines += [f"{tag} not computed ({reason})" for tag, reason in scores["not_computed"].items()]
    return "\n".join(lines)


def _numbers(row: dict[str, Any], names: list[str]) -> str:
    return "".join(
        f"{row[name]:>12.{2 if name.startswith('psnr') else 4}f}" if name in row else " " * 12
        for name in names
    )
