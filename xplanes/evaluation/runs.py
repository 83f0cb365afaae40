"""Run directories as trained scenes."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import yaml

from xplanes.config import ConfigError, TrainConfig, parse
from xplanes.scenes.frame import Frame, scene_frame
from xplanes.scenes.views import Scene
from xplanes.training.builder import build_module, build_scene
from xplanes.training.checkpoints import load_checkpoint
from xplanes.training.module import RadianceModule


@dataclass(frozen=True)
class TrainedRun:
    """A run with its scene and trained field.

    Attributes:
        path: The run directory.
        config: Its settings.
        scene: The training views and the scored split.
        frame: The field's frame.
        module: The trained module, in evaluation mode.
        step: Step of the checkpoint.
    """

    path: Path
    config: TrainConfig
    scene: Scene
    frame: Frame
    module: RadianceModule
    step: int


def read_config(run: Path) -> dict[str, Any]:
    """config.yaml of a run directory.

    Raises:
        ConfigError: If it is missing or damaged.
    """
    path = run / "config.yaml"
    if not path.is_file():
        raise ConfigError(f"{run} is not a run directory: no config.yaml in it")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise ConfigError(f"{path} is damaged: {error}") from error
    if not isinstance(content, dict):
        raise ConfigError(f"{path} is damaged: not a mapping")
    return content


def load_run(
    run: Path, *, checkpoint: str = "last", split: str | None = None, device: str | None = None
) -> TrainedRun:
    """Load a trained run.

    Args:
        run: The run directory.
        checkpoint: ``last`` or ``best``.
        split: Split to read beside the training views; the run's own when None.
        device: Where to put the field; a GPU if there is one when None.

    Raises:
        ConfigError, SceneError: If the run or its data are missing or damaged.
    """
    typed = parse(read_config(run))
    if split is not None:
        typed.data.eval_split = split
    state = load_checkpoint(run / "checkpoints" / f"{checkpoint}.ckpt")
    scene = build_scene(typed.data)
    frame = scene_frame(scene.splits["train"], typed.data.half_side)
    module = build_module(typed, scene, frame)
    module.load_state_dict(state["state_dict"])
    module.on_load_checkpoint(state)
    module.to(device or ("cuda" if torch.cuda.is_available() else "cpu")).eval()
    return TrainedRun(run, typed, scene, frame, module, state["global_step"])
