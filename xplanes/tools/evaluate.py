"""Scores of a trained run, view by view."""

import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from xplanes.files import is_there, write_json
from xplanes.metrics import mean
from xplanes.optional import require
from xplanes.tools.runs import TrainedRun
from xplanes.training.scores import score_view

logger = logging.getLogger(__name__)

DEFAULT_NETWORK = "vgg"
WEIGHTS = {"vgg": ("VGG16_Weights", "528 MB"), "alex": ("AlexNet_Weights", "233 MB")}
"""Name in torchvision and download size of the weights of each LPIPS backbone."""

SMALLEST = 32
"""Least pixels per side for which the networks have feature maps."""


def evaluate(trained: TrainedRun, network: str | None = None) -> dict[str, Any]:
    """Compute scores of all views of the run's split, with the same code as in training.

    Args:
        trained: The run.
        network: Backbone of LPIPS, ``vgg`` or ``alex``, downloaded if necessary; ``none`` for no
            LPIPS; None for vgg if it is already downloaded.

    Returns:
        Content for `write_scores`: scores with the keys of metrics.json, and ``not_computed``, a
        mapping from the names of missing scores to the reasons.
    """
    views, parts = trained.views, (trained.module.field, trained.module.renderer, trained.frame)
    name = network or DEFAULT_NETWORK
    tag, metric, missing = f"lpips_{name}", None, {}
    if network != "none":
        side, device = int(views.intrinsics.size.min()), str(trained.module.device)
        try:
            metric = lpips(name, side, device, download=network is not None)
        except UnavailableError as reason:
            missing = {tag: str(reason)}
            if network is not None:
                logger.warning("--lpips %s: not computed: %s", network, reason)
    began = time.perf_counter()
    rows: list[dict[str, Any]] = []
    for index in tqdm(range(len(views)), "views", leave=False, delay=2, disable=None):
        score, images = score_view(*parts, views, index, trained.scene.background)
        row = {"file": score.file, "time": score.time, **score.scores}
        if metric is not None:
            row[tag] = metric(images["colour"], images["truth"])
        rows.append(row)
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


def write_scores(run: Path, scores: dict[str, Any]) -> Path:
    """Write evaluation_<split>.json or evaluation_<split>_best.json; metrics.json is unchanged."""
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


class UnavailableError(Exception):
    """LPIPS cannot be computed; the message is the reason."""


def lpips(
    network: str, side: int, device: str, *, download: bool
) -> Callable[[Tensor, Tensor], float]:
    """The LPIPS distance by ``vgg`` or ``alex``, whose values are not comparable; lower is better.

    It is that of a prediction from the ground truth, both in [0, 1] [H, W, 3], with ``side`` pixels
    on the shorter side.

    Raises:
        UnavailableError: If a package, the weights or the images' size rule it out.
    """
    if side < SMALLEST:
        raise UnavailableError(f"images of {side} pixels are below {SMALLEST}")
    try:
        models = require("torchvision.models", extra="lpips")
    except ImportError as error:
        raise UnavailableError(str(error)) from error
    name, size = WEIGHTS[network]
    url = getattr(models, name).DEFAULT.url
    file = Path(torch.hub.get_dir()) / "checkpoints" / Path(url).name
    if not is_there(file) and not download:
        raise UnavailableError(f"{file} is missing: --lpips {network} downloads its {size}")
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    try:
        if is_there(file):
            # Refuse a malicious pickle: torchvision would load the file unrestricted.
            torch.load(file, map_location="cpu", weights_only=True)
        metric = LearnedPerceptualImagePatchSimilarity(
            net_type=network,  # type: ignore[arg-type]
            normalize=True,
        ).to(device)
    except Exception as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise UnavailableError(
            f"its weights cannot be loaded ({reason}): put {url} at {file}"
        ) from error

    @torch.no_grad()
    def measure(prediction: Tensor, truth: Tensor) -> float:
        images = [t.clamp(0, 1).float().permute(2, 0, 1)[None] for t in (prediction, truth)]
        return float(metric(*(image.to(device) for image in images)))

    return measure
