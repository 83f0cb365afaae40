"""`xplanes pretrain-lrm`: generates the objects, trains the model and exports its weights."""

import hashlib
import itertools
import math
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from lightning import Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from safetensors.torch import save_file
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset

from xplanes.backend import fast_bf16
from xplanes.components import read_settings
from xplanes.config import compose_plain
from xplanes.errors import ConfigError
from xplanes.files import read_json, replacing, write_json
from xplanes.locks import alone_in
from xplanes.lrm import load
from xplanes.lrm.config import LRMConfig, parse_config
from xplanes.lrm.keys import NAMES
from xplanes.lrm.openlrm import OpenLRM
from xplanes.lrm.weights import CHECKSUM
from xplanes.synthetic.pretraining.initialisation import grow_model, init_model
from xplanes.synthetic.pretraining.module import PretrainingModule, Upkeep
from xplanes.synthetic.pretraining.objects import HELD_OUT_SEEDS, TRAINING_SEEDS
from xplanes.synthetic.pretraining.pool import (
    FOCAL,
    SHARD,
    Pool,
    PretrainingBatch,
    PretrainingBatches,
    ensure_pool,
)
from xplanes.synthetic.pretraining.quick import QuickLook
from xplanes.synthetic.pretraining.settings import PretrainingSettings, published_sizes
from xplanes.training.checkpoints import load_checkpoint
from xplanes.training.clock import Interrupt
from xplanes.training.fit import quiet_lightning


def export(model: OpenLRM, config: dict[str, Any], folder: Path, name: str) -> Path:
    """Write NAME.safetensors in half precision and NAME.json, its configuration.

    Args:
        model: The model.
        config: The content of its config.json.
        folder: Output folder.
        name: File name without suffix.

    Returns:
        The file of the weights. Its SHA-256 is written to the configuration as ``weights_sha256``.
    """
    path = folder / f"{name}.safetensors"
    state = {key: value.half().contiguous() for key, value in published_state(model).items()}
    with replacing(path) as temporary:
        save_file(state, temporary)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    write_json(folder / f"{name}.json", {**config, CHECKSUM: digest})
    return path


def published_state(model: OpenLRM) -> dict[str, Tensor]:
    """A model's tensors under the names of OpenLRM's checkpoints."""
    ours = {key: value.detach() for key, value in model.state_dict().items()}
    config: LRMConfig = model.config
    layers = max(config.layers, config.encoder.depth, config.decoder_hidden + 1)
    packed = config.width == config.encoder.width
    result: dict[str, Tensor] = {}
    for published, names in NAMES[config.architecture].items():
        templates = () if names is None else (names,) if isinstance(names, str) else names
        # Query, key and value of attention to the image are stacked if the widths are equal.
        to_image = ".cross_attn." in published and "out_proj" not in published
        if to_image and packed != ("in_proj" in published):
            continue
        for layer in range(layers):
            for part in ("weight", "bias"):
                values = {"i": layer, "p": part, "h": layer, "e": 2 * layer}
                found = [ours.get(template.format(**values)) for template in templates]
                tensors = [tensor for tensor in found if tensor is not None]
                if tensors and len(tensors) == len(templates):
                    result[published.format(**values)] = (
                        torch.cat(tensors) if len(tensors) > 1 else tensors[0]
                    )
    return result


CHECKPOINT = "last.ckpt"


class Steps(IterableDataset):
    """Batches from the module's current step on.

    Args:
        batches: Draws the batch of a step.
        step: Returns the current step.
    """

    def __init__(self, batches: PretrainingBatches, step: Callable[[], int]) -> None:
        self.batches, self.step = batches, step

    def __iter__(self) -> Iterator[PretrainingBatch]:
        for step in itertools.count(self.step()):
            yield self.batches.draw(step)


def run_pretraining(overrides: Sequence[str], announce: Callable[[str], None]) -> Path:
    """Train a small LRM until its budget is used, from its last checkpoint on if there is one.

    Args:
        overrides: Settings of conf/pretrain_lrm.yaml, as ``key=value``.
        announce: Receives progress messages.

    Returns:
        The file of the weights; the configuration is in the same folder.

    Raises:
        ConfigError: If a setting is invalid, or the run folder holds a run with another model, pool
            or seed.
    """
    plain = compose_plain("pretrain_lrm", overrides)
    config = read_settings(PretrainingSettings, plain)
    run = Path(config.run)
    quiet_lightning()
    with alone_in(run):
        _settle(run, plain)
        average = _trained(run, config, announce)
        return export(average, published_sizes(config.model, FOCAL), run, config.model.name)


def _trained(run: Path, config: PretrainingSettings, announce: Callable[[str], None]) -> OpenLRM:
    """The moving average of a trained model."""
    last = run / CHECKPOINT
    if last.is_file():
        try:
            load_checkpoint(last)
        except ConfigError as problem:
            raise ConfigError(
                f"{last} is damaged: delete it to start again, or name another run"
            ) from problem
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    module, data, look = _assemble(config, device, announce)
    if last.is_file():
        announce(f"resuming from {last}")
    interrupt = Interrupt()
    trainer = Trainer(
        accelerator=device.type,
        devices=1,
        max_steps=-1,
        max_epochs=-1,
        callbacks=[Upkeep(last, config.schedule, look, announce), interrupt],
        logger=TensorBoardLogger(run, name="", version="tb"),
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        log_every_n_steps=10**9,
        use_distributed_sampler=False,
    )
    loader = DataLoader(Steps(data, lambda: module.steps), batch_size=None)
    checkpoint = str(last) if last.is_file() else None
    with interrupt.exits():
        trainer.fit(module, loader, ckpt_path=checkpoint, weights_only=True)
    return module.average


def _assemble(
    config: PretrainingSettings, device: torch.device, announce: Callable[[str], None]
) -> tuple[PretrainingModule, PretrainingBatches, QuickLook]:
    """The initialised module, its training batches, and the scores on held-out objects."""
    root, schedule = Path(config.pool.root), config.schedule

    def pool(folder: Path, seeds: range, workers: int) -> Pool:
        return ensure_pool(
            folder,
            seeds,
            views=config.pool.views,
            side=config.model.image_size,
            device=device,
            workers=workers,
            announce=announce,
        )

    drawn = pool(root, TRAINING_SEEDS[: config.pool.objects], os.cpu_count() or 1)
    shards = math.ceil(schedule.score_objects / SHARD)
    held_out = pool(root / "held_out", HELD_OUT_SEEDS[: shards * SHARD], 1)
    sizes = parse_config(published_sizes(config.model, FOCAL))
    model = (
        init_model(sizes, config.seed)
        if config.init_from is None
        else _grown(config.init_from, sizes)
    )
    module = PretrainingModule(model, config.batch, schedule, config.seed, bf16=fast_bf16(device))
    data = PretrainingBatches(drawn, model.view, config.batch, seed=config.seed)
    return module, data, QuickLook(held_out, schedule.score_objects)


def _grown(init_from: str, sizes: LRMConfig) -> OpenLRM:
    weights = Path(init_from)
    try:
        earlier = load(read_json(weights.with_suffix(".json")), weights)
        if not isinstance(earlier, OpenLRM):
            raise ValueError(f"their architecture is {earlier.config.architecture}")
        return grow_model(earlier, sizes).requires_grad_(True)
    except (OSError, ValueError, RuntimeError) as problem:
        raise ConfigError(
            f"init_from={init_from}: the weights do not fit this model: {problem}"
        ) from problem


def _settle(run: Path, plain: dict) -> None:
    """Write the configuration to the run folder; refuse one that contradicts the earlier one."""
    path = run / "config.json"
    if path.is_file():
        try:
            before = read_json(path)
        except ValueError as problem:
            raise ConfigError(
                f"{path} is damaged: delete it if the settings are still the same, or choose "
                "another run"
            ) from problem
        for key in ("seed", "model", "pool"):
            if before.get(key) != plain[key]:
                raise ConfigError(
                    f"run={run} holds a run with {key}={before.get(key)}, not {key}={plain[key]}: "
                    f"name another folder, or keep {key} as it was"
                )
    write_json(path, plain)
