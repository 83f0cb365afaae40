"""Small runs for tests: composed like the command line, trained in this process."""

import copy
import functools
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import hydra
import pytest
import torch
from hydra import initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from lightning import Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from xplanes.config import CONF, to_plain
from xplanes.files import MARK, read_rows
from xplanes.run import run
from xplanes.scenes.datamodule import SceneDataModule
from xplanes.scenes.views import Scene
from xplanes.training import fit
from xplanes.training.clock import TrainingClock
from xplanes.training.module import RadianceModule


def under(group: str, **values: Any) -> tuple[str, ...]:
    """Overrides of keys in a group."""
    return tuple(f"{group}.{key}={value}" for key, value in values.items())


SMALL = (
    "lrm=none",
    *under("data", resolution=32, train_views=10, test_views=3, val_views=2),
    *(*under("model", resolution=24, channels=8), "model.decoder.width=32"),
    *under("model.sampler", grid_resolution=24, samples=64, update_cells=512, sweep_at=[15]),
    *under("model.rays", per_batch=256, samples_per_batch=4096),
    *under("trainer", accelerator="cpu", max_seconds="null", max_steps=40),
    *("callbacks.checkpoints.every=10", "callbacks.evaluation.at=[0,0.5]", "media=false"),
)

NO_CURVE = "callbacks.evaluation.at=[]"
UNSCORED = (NO_CURVE, "data.eval_views=1", "logger=none")
"""Training alone is looked at."""


@functools.cache
def composed(*overrides: str) -> DictConfig:
    """What Hydra makes of these overrides; composing takes a fifth of a second."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return hydra.compose("train", list(overrides))


@functools.cache
def _parsed(override: str) -> Any:
    return OverridesParser.create().parse_override(override).value()


def changed(base: tuple[str, ...], *overrides: str) -> dict[str, Any]:
    """What ``base`` and these overrides compose to, as plain builtins.

    Options of groups are composed again; keys are set in what was composed before, where their
    types are checked as Hydra checks them.
    """
    values = [
        text
        for text in overrides
        if "." in text.split("=")[0] or text.split("=")[0] in ("seed", "resume")
    ]
    config = copy.deepcopy(composed(*base, *(text for text in overrides if text not in values)))
    for text in values:
        key = text.partition("=")[0]
        OmegaConf.update(config, key, _parsed(text))
    return to_plain(config)


def small_config(root: Path, *overrides: str) -> dict[str, Any]:
    """A configuration that trains in seconds, as plain builtins."""
    return changed(SMALL, f"data.root={root}", *overrides)


def quiet(folder: Path, steps: int) -> dict[str, Any]:
    """Options of a trainer that logs and scores nothing."""
    off = ("logger", "enable_progress_bar", "enable_model_summary")
    options = {"accelerator": "cpu", "max_steps": steps, "default_root_dir": folder}
    return options | dict.fromkeys(off, False) | {"limit_val_batches": 0}


def train_quietly(
    module: RadianceModule, scene: Scene, folder: Path, steps: int, **more: Any
) -> fit.Trainer:
    """A trainer that has trained a module and logged and written nothing."""
    trainer = fit.Trainer(**quiet(folder, steps), enable_checkpointing=False, **more)
    trainer.train(module, SceneDataModule.of(scene))
    return trainer


def gone_on(
    scene: Scene, config: dict[str, Any], folder: Path, steps: int, *stops: int
) -> list[dict[str, Any]]:
    """Checkpoints after so many steps: of one run, and of runs that go on from steps of it."""
    kept = ModelCheckpoint(folder, "{step}", save_top_k=-1, every_n_train_steps=1)
    found = []
    for stop in (None, *stops):
        trainer = Trainer(
            **quiet(folder, steps), max_epochs=-1, callbacks=[kept] if stop is None else []
        )
        start = None if stop is None else folder / f"step={stop}.ckpt"
        trainer.fit(RadianceModule(config), SceneDataModule.of(scene), ckpt_path=start)
        trainer.save_checkpoint(folder / "end.ckpt")
        found.append(torch.load(folder / "end.ckpt", weights_only=True))
    return found


def metrics(folder: Path) -> dict[str, Any]:
    """What metrics.json of a run says."""
    return json.loads((folder / "metrics.json").read_text())


def scores(folder: Path) -> list[float]:
    """PSNR of the evaluations of a run."""
    return [float(row["psnr"]) for row in read_rows(folder / "curve.csv")]


def status(folder: Path) -> dict[str, Any]:
    """What run.json of a run says."""
    return json.loads((folder / "run.json").read_text())


def checkpoint(folder: Path, name: str = "last") -> dict[str, Any]:
    """A checkpoint of a run."""
    return torch.load(folder / "checkpoints" / f"{name}.ckpt", weights_only=True)


def outcome(folder: Path) -> dict[str, Any]:
    """All of a finished run that the clock does not touch, as builtins that compare exactly."""
    content = metrics(folder)
    assert status(folder)["status"] == "finished"
    assert not list(folder.rglob(f".*{MARK}*"))
    names = ("test", "views", "step", "skipped", "samples_per_ray", "parameters")
    found = {name: content[name] for name in (*names, "steps_skipped", "restarts")}
    found["curve"] = [(row["step"], row["psnr"]) for row in read_rows(folder / "curve.csv")]
    for path in (folder / "checkpoints").glob("*.ckpt"):
        kept = checkpoint(folder, path.stem)
        tensors = {name: value.tolist() for name, value in kept["state_dict"].items()}
        found[path.stem] = {"step": kept["global_step"], **tensors}
    return found


def same_state(first: Mapping[str, Tensor], second: Mapping[str, Tensor]) -> None:
    """Both have the same names and the same bits."""
    assert first.keys() == second.keys()
    for name, value in first.items():
        assert torch.equal(value, second[name]), name


def also(
    patch: pytest.MonkeyPatch, owner: Any, name: str, do: Callable[..., Any], *, first: bool = False
) -> None:
    """Have a method do something else too, which gets its arguments: afterwards, or first."""
    original = getattr(owner, name)

    def both(*given: Any, **options: Any) -> Any:
        if first:
            do(*given, **options)
        result = original(*given, **options)
        if not first:
            do(*given, **options)
        return result

    patch.setattr(owner, name, both)


def after_each_batch(
    patch: pytest.MonkeyPatch, do: Callable[[TrainingClock, Any, RadianceModule], None]
) -> None:
    """Do something at the end of each batch, once the clock has seen it."""
    also(patch, TrainingClock, "on_train_batch_end", lambda *given: do(*given[:3]))


def broken_off(steps: tuple[int, ...], config: dict[str, Any], folder: Path) -> None:
    """A run that fails after each of these steps, and is resumed each time."""
    for stop in steps:

        def break_down(_: TrainingClock, trainer: Any, __: Any, stop: int = stop) -> None:
            if trainer.global_step == stop:
                raise OSError("power cut")

        with pytest.MonkeyPatch.context() as patch:
            after_each_batch(patch, break_down)
            with pytest.raises(OSError, match="power cut"):
                run(config, folder, [], resume=stop != steps[0])
        assert status(folder)["status"] == "failed"
