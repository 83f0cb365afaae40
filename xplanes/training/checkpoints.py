"""Checkpoints: written atomically, and loaded without executing code."""

import io
import logging
import pickle
import re
import shutil
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO

from xplanes.errors import ConfigError
from xplanes.files import read_rows, replacing, stand_in
from xplanes.training.clock import Stopped, TrainingClock, off_clock
from xplanes.training.diagnosis import require_finite
from xplanes.training.module import RadianceModule

logger = logging.getLogger(__name__)

LAST, BEST = "last.ckpt", "best.ckpt"

TENSORS = ("state_dict", "optimizer_states")
"""Large parts of a checkpoint, which contain only tensors and plain values."""


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes checkpoints atomically; verifies checksums and executes no code when loading."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None
    ) -> None:
        _require_data(checkpoint)
        with replacing(Path(path)) as temporary:
            super().save_checkpoint(checkpoint, temporary, storage_options)

    def load_checkpoint(self, path: Any, *args: Any, **kwargs: Any) -> dict[str, Any]:
        return load_checkpoint(Path(path))


def _require_data(checkpoint: Mapping[str, Any]) -> None:
    """Refuse a state that could be saved but not loaded, such as numpy numbers in a callback.

    Raises:
        ConfigError: With the name of the part that contains it.
    """
    parts = {name: part for name, part in checkpoint.items() if name not in TENSORS}
    parts |= {f"callback {name}": state for name, state in parts.pop("callbacks", {}).items()}
    for name, part in parts.items():
        with io.BytesIO() as file:
            torch.save(part, file)
            file.seek(0)
            try:
                torch.load(file, weights_only=True)
            except pickle.UnpicklingError as error:
                raise ConfigError(
                    f"{name}: its state is not plain data{_kind_in(error)}, so the checkpoint "
                    "could not be loaded; return only tensors, numbers, strings, lists and "
                    "dictionaries from state_dict"
                ) from error


def _kind_in(error: pickle.UnpicklingError) -> str:
    """The class that was refused, in brackets; empty if the error does not name it."""
    kind = re.search(r"GLOBAL (\S+)", str(error))
    return f" ({kind[1]})" if kind else ""


class Checkpoints(ModelCheckpoint):
    """Writes ``last.ckpt`` at intervals and at the end, and ``best.ckpt`` at each new best score.

    They are in ``checkpoints`` in the trainer's ``default_root_dir``; the training clock does not
    count the time to write them. The best one has the highest ``val/psnr``.

    Args:
        every: Steps between checkpoints.
    """

    def __init__(self, every: int = 1000) -> None:
        if every < 1:
            raise ConfigError(f"every={every}: must be above 0")
        super().__init__(
            filename=BEST.removesuffix(".ckpt"),
            monitor="val/psnr",
            mode="max",
            save_on_train_epoch_end=False,
            enable_version_counter=False,
        )
        self.every = every
        self._due = False

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        self.dirpath = str(Path(trainer.default_root_dir) / "checkpoints")
        super().setup(trainer, pl_module, stage)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        # Never between accumulated batches: checkpoints do not contain gradients.
        whole = getattr(pl_module, "between_updates", True)
        self._due = whole and trainer.global_step % self.every == 0
        # If a validation follows, save after it, so that the checkpoint records the best score.
        validates = trainer.val_check_batch == trainer.fit_loop.epoch_loop.total_batch_idx + 1
        if self._due and not validates:
            self._save_last(trainer)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self.monitor in trainer.callback_metrics:
            super().on_validation_end(trainer, pl_module)
        if self._due and not trainer.sanity_checking:
            self._save_last(trainer)
            self._due = False

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._save_last(trainer)

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        # Other exceptions may have occurred in the middle of a step.
        if isinstance(exception, Stopped) and trainer.global_step:
            self._save_last(trainer)

    def _save_last(self, trainer: Trainer) -> None:
        self._save_checkpoint(trainer, f"{self.dirpath}/{LAST}")

    def _should_skip_saving_checkpoint(self, trainer: Trainer) -> bool:
        # Saving is allowed after training: the final scores may come then, see `Trainer.train`.
        return trainer.sanity_checking or not trainer.global_step

    def _save_checkpoint(self, trainer: Trainer, filepath: str) -> None:
        if trainer.fast_dev_run:  # type: ignore[attr-defined]
            return
        with off_clock(trainer):
            if isinstance(module := trainer.lightning_module, RadianceModule):
                require_finite(module)
            super()._save_checkpoint(trainer, filepath)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        # The run directory may have been moved.
        best = f"{self.dirpath}/{BEST}"
        score = state_dict["best_model_score"]
        moved = {"dirpath": self.dirpath, "kth_best_model_path": best, "best_model_path": best}
        if score is not None:
            super().load_state_dict({**state_dict, **moved, "best_k_models": {best: score}})


def has_checkpoint(run: Path) -> bool:
    """Whether a run directory contains a checkpoint to resume from."""
    return any((run / "checkpoints" / name).is_file() for name in (LAST, BEST))


def find_resumable(folder: Path) -> Path | None:
    """The checkpoint to resume from; if the last one is lost or damaged, the best replaces it.

    Returns:
        ``last.ckpt``; None if there is none, so that training starts from the beginning.

    Raises:
        ConfigError: If neither can be read.
    """
    last, best = folder / LAST, folder / BEST
    if not (last.is_file() or best.is_file()):
        run = folder.parent
        rows = read_rows(run / "curve.csv")
        if (run / "metrics.json").is_file() or any(row.get("step") != "0" for row in rows):
            logger.warning("%s: its checkpoints are gone; training starts again at step 0", run)
        return None
    try:
        load_checkpoint(last)
    except ConfigError as problem:
        try:
            step = load_checkpoint(best)["global_step"]
        except (ConfigError, KeyError, TypeError):
            found = " and ".join(str(path) for path in (last, best) if path.is_file())
            raise ConfigError(f"{problem}; to start again, delete {found}") from problem
        logger.warning("%s. Continuing from %s, step %d", problem, best, step)
        with replacing(last) as temporary:
            shutil.copyfile(best, temporary)
    return last


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint to the CPU, tensors and builtins only.

    Raises:
        ConfigError: If the file is missing, cannot be read, is damaged, or is not plain data.
    """
    beside = path.with_name(BEST if path.name == LAST else LAST)
    if not path.is_file():
        if path.name == BEST and beside.is_file():
            raise ConfigError(
                f"{path} does not exist: there were no validation scores to choose it; use {LAST} "
                "(--checkpoint last)"
            )
        if path.name == LAST and beside.is_file():
            raise ConfigError(f"{path} does not exist; try {BEST} beside it")
        raise ConfigError(
            f"{path} does not exist: the run stopped before its first checkpoint "
            "(callbacks.checkpoints.every)"
        )
    if (other := stand_in(path)) is not None:
        raise ConfigError(f"{path} {other}")
    try:
        # torch stores checksums but does not check them.
        with zipfile.ZipFile(path) as archive:
            if (name := archive.testzip()) is not None:
                raise zipfile.BadZipFile(f"wrong checksum of {name}")
        return torch.load(path, map_location="cpu", weights_only=True)
    except MemoryError:
        raise
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror or error}") from error
    except pickle.UnpicklingError as error:
        raise ConfigError(
            f"{path} is not plain data{_kind_in(error)}, and is not loaded, because it could run "
            "code; save only tensors, numbers, strings, lists and dictionaries"
        ) from error
    except Exception as error:
        raise ConfigError(
            f"{path} cannot be read ({type(error).__name__}: {str(error).split('. ')[0]}): it is "
            f"damaged{f'; try {beside.name} beside it' if beside.is_file() else ''}"
        ) from error


def training_so_far(path: Path) -> tuple[int, float]:
    """Steps and seconds of the training clock in a checkpoint that `find_resumable` has checked."""
    content = torch.load(
        path, map_location="cpu", weights_only=True, mmap=True
    )  # Reads no tensors.
    clock = content.get("callbacks", {}).get(TrainingClock.__qualname__, {})
    return content["global_step"], clock.get("seconds", 0.0)
