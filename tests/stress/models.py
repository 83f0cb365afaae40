"""Every model, small, on scenes of `tests.stress.scenes`."""

import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from tests.baselines.runs import KPLANES, NEUS, PROPOSAL, TENSOR4D, TINEUVOX, under
from xplanes.config import compose_plain
from xplanes.experiment import Experiment
from xplanes.run import run
from xplanes.scenes.frame import CubeHints
from xplanes.training.module import RadianceModule

XPLANES = (
    *(*under("model", resolution=16, channels=8), "model.decoder.width=32"),
    *under("model.sampler", grid_resolution=16, samples=48, update_cells=256, sweep_at=[15]),
    "model.rays.per_batch=128",
)
SMALLER = ("model.width=16", "model.rays.per_batch=32")

MODELS: dict[str, tuple[str, ...]] = {
    "six_planes": XPLANES,
    "nine_planes": XPLANES,
    "kplanes": (*KPLANES, *PROPOSAL),
    "kplanes_explicit": (*KPLANES, *PROPOSAL),
    "tineuvox_s": TINEUVOX,
    "tineuvox_b": TINEUVOX,
    "tensor4d_density": (*TENSOR4D, *SMALLER),
    "tensor4d": (*TENSOR4D, *SMALLER, *NEUS),
}
"""Overrides by model."""

SLOW = ("tensor4d", "tensor4d_density")
"""Models that get fewer steps."""

RATES = {
    "six_planes": ("model.plane_lr", "model.time_lr", "model.decoder_lr"),
    "nine_planes": ("model.plane_lr", "model.time_lr", "model.decoder_lr"),
    "kplanes": ("model.learning_rate",),
    "kplanes_explicit": ("model.learning_rate",),
    "tineuvox_s": ("model.grid_learning_rate", "model.network_learning_rate"),
    "tineuvox_b": ("model.grid_learning_rate", "model.network_learning_rate"),
    "tensor4d_density": ("model.learning_rate", "model.plane_learning_rate"),
    "tensor4d": ("model.learning_rate", "model.plane_learning_rate"),
}
"""Learning rates by model."""


def settings(model: str, scene: Path, *overrides: str, lrm: str = "none") -> dict[str, Any]:
    """The configuration of a small run."""
    steps = 15 if model in SLOW else 50
    scenes = under("data", root=scene.parent, scene=scene.name, resolution="null")
    trainer = under("trainer", accelerator="cpu", max_steps=steps, max_seconds="null")
    off = ("callbacks.evaluation.at=[]", "media=false", "preparation.cache=null")
    chosen = ("data=dnerf", f"model={model}", f"lrm={lrm}", "model.precision=32")
    given = (*chosen, *scenes, *MODELS[model], *trainer, *off, *overrides)
    return compose_plain("train", list(given))


def faster(model: str, factor: float) -> list[str]:
    """Overrides that multiply all learning rates of a model."""
    plain = compose_plain("train", [f"model={model}", *MODELS[model]])
    found = []
    for key in RATES[model]:
        group, name = key.split(".")
        found.append(f"{key}={plain[group][name] * factor}")
    return found


def trained(config: dict[str, Any], folder: Path) -> dict[str, Tensor]:
    """Run it whole, and give parameters, buffers and scores."""
    run(config, folder, [], resume=False)
    checkpoint = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    scores = json.loads((folder / "metrics.json").read_text())["test"]
    return checkpoint["state_dict"] | {f"score.{k}": torch.tensor(v) for k, v in scores.items()}


def built(config: dict[str, Any]) -> RadianceModule:
    """The module of a run that has not begun."""
    experiment = Experiment.read(config)
    torch.manual_seed(0)
    module = RadianceModule(config)
    module.build(experiment.data.read(), hints=CubeHints(experiment.data.half_side))
    return module
