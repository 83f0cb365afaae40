"""The LightningModule that trains one field on rays."""

import functools
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.callbacks import WeightAveraging
from lightning.pytorch.core.optimizer import LightningOptimizer
from torch import Tensor

from xplanes import __version__
from xplanes.components import plugins
from xplanes.config import compose_plain
from xplanes.errors import ConfigError
from xplanes.files import stand_in
from xplanes.models.initialisation import Method
from xplanes.rendering.base import Rendering
from xplanes.scenes.batches import Batch, BatchSettings
from xplanes.scenes.frame import Frame
from xplanes.scenes.importance import START, ErrorMap
from xplanes.scenes.views import Scene
from xplanes.streams import TrainingState
from xplanes.training.building import (
    Parts,
    build_parts,
    loss_terms,
    parts_from,
    require_float32,
    require_frame,
    require_new_rays,
    require_version,
    site_content,
)
from xplanes.training.clock import training_seconds
from xplanes.training.diagnosis import (
    TrainingError,
    broken_flag,
    diagnosis,
    leave_out,
    unusable_gradients,
)
from xplanes.training.field_module import FieldModule
from xplanes.training.meters import batch_values, due, mean_opacities

PATIENCE = 20
"""Training fails after this many consecutive updates with a loss or gradient that is not finite."""

OPACITIES = 5
"""Batches between measurements of the rays' opacity."""


class RadianceModule(FieldModule):
    """A LightningModule that trains a field on rays, supervised by the images' colours.

    The field is built in `configure_model`, when the scene is known; a configured LRM runs there,
    too. Checkpoints include everything the field takes from the data and the LRM, so
    ``RadianceModule.load_from_checkpoint(path)`` needs only the file (and ``plugins``, if used).

    A step is `training_step` (render the rays, sum the loss terms), `on_before_optimizer_step`
    (gradients of regularisers without rays; non-finite updates are skipped) and
    `optimizer_step` (the optimiser, then the update of the occupancy grid). Validation and test
    score whole views, as `SceneDataModule` serves them; see `FieldModule`.

    Args:
        config: The keys ``seed``, ``model``, ``lrm``, ``preparation``, ``decomposition`` and
            ``losses`` (optional) of a configuration, as dicts, lists, numbers and strings; others
            are ignored. Or an already parsed `Method`.
        plugins: Names of the user's modules whose classes the configuration may name.

    Raises:
        ConfigError: If a setting is missing or invalid, or a plug-in cannot be imported.
    """

    def __init__(self, config: Mapping[str, Any] | Method, plugins: Sequence[str] = ()) -> None:
        super().__init__()
        parsed = isinstance(config, Method)
        self.method = config if parsed else _read(config, plugins)
        plain = config.plain() if parsed else config
        # Without plug-ins: a checkpoint must not decide which modules are imported.
        kept = {name: plain[name] for name in Method.GROUPS if name in plain}
        self.save_hyperparameters({"config": kept})
        self._plugins = tuple(plugins)
        self.ray_settings: BatchSettings = self.method.model.rays
        """Settings of training batches; auto is resolved once the device is known."""
        self.batches = 0
        """Number of batches drawn so far."""
        self.rays = 0
        """Number of rays in the next batch; 0 for whole views."""
        self.restarts = 0
        """Number of times the field was re-initialised, see `restart`."""
        self.advice: str | None = None
        """Advice if the loss is not finite; the model's own when None."""
        self.between_updates = True
        """Whether no accumulated gradients are pending (see ``accumulate_grad_batches``)."""
        self._seen: tuple[Rendering, dict[str, Tensor]] | None = None
        self._losses: list[Tensor] = []
        self._steps = math.inf
        self._schedules: list[Any] = []
        self._peaks: list[float] = []

    @classmethod
    def compose(cls, *overrides: str) -> "RadianceModule":
        """Build from command-line overrides: ``compose("model=nine_planes")``.

        Args:
            *overrides: ``key=value`` each; ``plugins=[MODULE]`` allows classes of your own modules.

        Raises:
            ConfigError: If a setting does not exist or is invalid.
        """
        config = compose_plain("train", overrides)
        return cls(config, plugins=config["plugins"] or ())

    @classmethod
    def load_from_checkpoint(
        cls, checkpoint_path: Any, *args: Any, weights_only: bool = True, **kwargs: Any
    ) -> "RadianceModule":
        """Load a checkpoint as Lightning does; by default no code in the file is executed.

        Args:
            checkpoint_path: As in Lightning.
            *args: As in Lightning.
            weights_only: Read only tensors and plain values. False can execute code in the file.
            **kwargs: As in Lightning. ``plugins=[MODULE]`` allows classes of your own modules.

        Raises:
            ConfigError: If the checkpoint needs a plug-in that is not named, or does not fit.
        """
        local = isinstance(checkpoint_path, str | Path)
        if local and (other := stand_in(Path(checkpoint_path))) is not None:
            raise ConfigError(f"{checkpoint_path} {other}")
        try:
            return super().load_from_checkpoint(
                checkpoint_path, *args, weights_only=weights_only, **kwargs
            )
        except ConfigError as error:
            require_version(checkpoint_path)
            words, ask, _ = str(error).partition("plugins=[MODULE]")
            if not ask:
                raise
            raise ConfigError(f"{words}load_from_checkpoint(path, {ask})") from error

    # Building

    def setup(self, stage: str) -> None:
        require_float32(str(self.trainer.precision))
        require_new_rays(self.trainer.overfit_batches)  # type: ignore[attr-defined]

    def configure_model(self) -> None:
        # Loaded without a Trainer, the field is built in `on_load_checkpoint`.
        if self._parts is not None or self._trainer is None:
            return
        data: Any = self.trainer.datamodule  # type: ignore[attr-defined]
        if data is None:
            raise ConfigError(
                "a RadianceModule trains with a SceneDataModule: pass one as datamodule="
            )
        with torch.device("cpu"):  # Lightning would create every tensor on the GPU.
            self.build(
                data.scene,
                hints=data.settings.hints(data.scene),
                device=self.trainer.strategy.root_device,
                devices=self.trainer.world_size,
            )

    def build(self, scene: Scene, frame: Frame | None = None, **options: Any) -> None:
        """Build the field for a scene, with the configured initialisation.

        Args:
            scene: The scene, with a ``train`` split.
            frame: The field's frame; chosen by the model when None.
            **options: Further arguments of `build_parts`: ``hints``, ``device``, ``devices``,
                ``initialisation``, ``say``.

        Raises:
            ConfigError, SceneError, LRMError: If settings, scene and initialisation do not fit
                together.
        """
        device = options.get("device") or torch.device("cpu")
        self.ray_settings = self.method.model.rays.on(device)
        self._adopt(build_parts(self.method, scene, frame=frame, **options))

    def _adopt(self, parts: Parts) -> None:
        self._parts = parts
        self.field = parts.field
        self.error_map = ErrorMap(parts.site.steps(START))
        for name, part in parts.sampler.modules.items():
            self.add_module(name, part)
        self.rays = parts.sampler.first_rays(self.ray_settings.most_rays)

    # Training

    @property
    def progress(self) -> float:
        """Share of training that is done, by steps or by the budget of a callback."""
        share = self.global_step / self._steps
        return min(1.0, max([share, *(callback.progress for callback in self._schedules)]))

    @property
    def state(self) -> TrainingState:
        """Seed and progress of training, for schedules and random streams."""
        done = (self.global_step, self.batches, self.global_rank)
        return TrainingState(self.method.seed, *done, progress=self.progress)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        groups = [*self.model.groups(), *self.sampler.groups()]
        # Not from the optimiser's restored state, because a resumed run may change the rates.
        self._peaks = [group["lr"] for group in groups]
        return self.model.optimizer(groups)

    def on_fit_start(self) -> None:
        # Not in on_train_start: callbacks' on_train_start runs before it and reads `progress`.
        trainer = self.trainer
        self._steps = max(1, trainer.estimated_stepping_batches)
        callbacks: list[Any] = trainer.callbacks  # type: ignore[attr-defined]
        self._schedules = [c for c in callbacks if isinstance(getattr(c, "progress", None), float)]
        self.method.require_devices(trainer.world_size)
        for callback in callbacks if self.model.replaces_parameters else ():
            if isinstance(callback, WeightAveraging):
                raise ConfigError(
                    f"callbacks: {type(callback).__name__}: {type(self.model).__name__} changes "
                    "its parameters' shapes in training, so weights have no mean; leave it out"
                )
        # An earlier fit may have been interrupted within a step.
        self.between_updates, self._losses, self._seen = True, [], None

    def on_train_start(self) -> None:
        if self.global_rank:  # Sums from a checkpoint must count only once, in the first process.
            for part in self.sampler.modules.values():
                for name in getattr(part, "own", ()):
                    getattr(part, name).zero_()
            self.error_map.drop_own()

    @property
    def _optimizer(self) -> torch.optim.Optimizer:
        optimizer = self.optimizers(use_pl_optimizer=False)
        assert isinstance(optimizer, torch.optim.Optimizer)
        return optimizer

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        if not self.between_updates:
            return
        model, state, optimizer = self.model, self.state, self._optimizer
        for group, peak in zip(optimizer.param_groups, self._peaks, strict=True):
            group["lr"] = model.group_rate_factor(group["name"], state.step, state.progress) * peak
        model.before_step(state, optimizer)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        state = self.state
        rendering = self.sampler.render(self.field, batch, state)
        terms = loss_terms(self.parts, self.method.losses, rendering, batch, state)
        loss = functools.reduce(operator.add, terms.values())
        self._losses.append(loss.detach())
        self._seen = rendering, terms
        self.batches += 1
        self.error_map.observe(batch, rendering.colour, rendering.shown)
        self.between_updates = False
        self._count(rendering, batch, loss)
        if self._logs_now:
            self._log(terms, state)
        if self.trainer.world_size > 1:
            # DDP waits for the gradients of all parameters, including those that no ray reached.
            loss = loss + 0 * sum(p.sum() for p in self.parameters() if p.requires_grad)
        return loss

    def on_after_backward(self) -> None:
        assert self._seen is not None
        self.sampler.observe(self._seen[0])

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        state = self.state
        self.model.regularise(state)
        self.sampler.regularise(self.field, state)
        broken = broken_flag(self.parameters(), self._losses)
        self._losses = []
        if self.trainer.world_size > 1:
            # All processes must skip the same steps, so that their planes stay equal.
            torch.distributed.all_reduce(broken, op=torch.distributed.ReduceOp.MAX)
        named = self.named_parameters() if broken.device.type == "cpu" and broken else ()
        unusable = unusable_gradients(named)
        leave_out(optimizer, broken)
        self.tally.add_update(broken)
        if self.tally.skipped_in_a_row >= PATIENCE:
            self._give_up(unusable)

    def optimizer_step(
        self,
        epoch: int,
        batch_idx: int,
        optimizer: torch.optim.Optimizer | LightningOptimizer,
        optimizer_closure: Callable[[], Any] | None = None,
    ) -> None:
        state = self.state
        super().optimizer_step(epoch, batch_idx, optimizer, optimizer_closure)
        # Not in on_train_batch_end, so that checkpoints of callbacks contain the update.
        self.sampler.update(self.field, state)
        self.between_updates = True
        self._seen = None  # Its graph would keep replaced parameters alive.

    def on_train_end(self) -> None:
        self._read_tally()

    def _count(self, rendering: Rendering, rays: Batch, loss: Tensor) -> None:
        """Add the statistics of a batch; the host reads them later."""
        # With a learnt background it is unknown which pixels are opaque or empty.
        known = getattr(self.field, "background", None) is None
        if known and self.batches % OPACITIES == 0:
            self.tally.opacities = mean_opacities(rendering, rays)
        self.tally.add_batch(batch_values(rendering, rays, loss))
        if loss.device.type == "cpu" or due(self.batches) or self._logs_now:
            self._read_tally()
            if self.tally.skipped_in_a_row >= PATIENCE:
                self._give_up()

    @property
    def _logs_now(self) -> bool:
        """Whether the last batch is to be logged: it ends a step that Lightning logs."""
        trainer: Any = self.trainer
        every, loop = trainer.log_every_n_steps, trainer.fit_loop.epoch_loop
        # Lightning's own count: it begins at 0 even if the module was loaded, and the last step of
        # an epoch may have fewer batches.
        step = loop._batches_that_stepped + 1
        ends = not loop._should_accumulate()
        return bool(every and not step % every and ends and trainer.loggers)

    def _log(self, terms: Mapping[str, Tensor], state: TrainingState) -> None:
        """Log every term of the loss, weighted."""
        values = {name: float(term.detach()) for name, term in terms.items()}
        values |= self.model.regularisers(state)
        values |= self.sampler.regularisers(self.field, state)
        entries = {f"train/{name}": value for name, value in values.items()}
        entries |= {"train/loss": sum(values.values()), "train/psnr": self.tally.last["psnr"]}
        entries |= {"train/steps_skipped": float(self.tally.skipped), "step": float(state.step)}
        for group in self.trainer.optimizers[0].param_groups:
            entries[f"lr/{group['name']}"] = group["lr"]
        counts = self.tally.counts
        entries["sampler/samples_per_ray"] = counts["samples"] / max(1, counts["rays"])
        if seconds := training_seconds(self.trainer):
            entries["time/rays_per_s"] = counts["rays"] / seconds
            entries["time/train_s"] = seconds
        self.log_dict(entries | self.sampler.scalars() | self.model.scalars(), batch_size=1)

    def _read_tally(self) -> None:
        """Read the statistics, and adapt the number of rays to the budget of samples."""
        if (found := self.tally.read(self.trainer)) is None:
            return
        rays, samples = found
        if self.rays:
            self.rays = self.ray_settings.fitting(rays, samples)
        # Expected number of samples in the next batch.
        self.sampler.expect(samples * self.rays / max(1, rays))

    def _give_up(self, unusable: Sequence[str] = ()) -> None:
        assert self._seen is not None
        raise TrainingError(diagnosis(self, *self._seen, unusable))

    def restart(self) -> None:
        """Re-initialise the field, with another seed and the model's settings for a restart.

        Only for a single process, during training; step count and budget continue.
        """
        device, optimizer = self.device, self._optimizer
        self._adopt(self.parts.stronger())
        self.restarts += 1
        self.to(device)
        fresh = [*self.model.groups(), *self.sampler.groups()]
        for group, new in zip(optimizer.param_groups, fresh, strict=True):
            group["params"] = new["params"]
        optimizer.state.clear()

    # Checkpoints

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self._read_tally()
        self.agree()
        own = {"batches": self.batches, "rays": self.rays, "restarts": self.restarts}
        checkpoint["xplanes"] = __version__
        checkpoint["progress"] = own | self.tally.state_dict()
        if self._parts is not None:
            checkpoint["site"] = site_content(self._parts)
            checkpoint["error_map"] = self.error_map.state_dict()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        try:
            site, progress = checkpoint["site"], checkpoint["progress"]
            if self._parts is None:
                rays = self.ray_settings.most_samples
                self._adopt(parts_from(site, self.method, self._plugins, rays))
            else:
                require_frame(self._parts, site)
            if self.site.views is not None:
                while self.restarts < progress["restarts"]:
                    self._adopt(self.parts.stronger())
                    self.restarts += 1
            self.restarts = progress["restarts"]
            self.batches, self.rays = progress["batches"], progress["rays"]
            self.tally.load_state_dict(progress)
            self.error_map.load_state_dict(checkpoint["error_map"])
        except (KeyError, TypeError, AttributeError) as error:
            raise ConfigError(
                f"the checkpoint cannot be used ({type(error).__name__}: {error}): it is damaged, "
                "or from another version of xplanes"
            ) from error

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:
        """As in torch, with a clear error for the state of a run with other settings.

        Raises:
            ConfigError: If it does not fit.
        """
        try:
            return super().load_state_dict(state_dict, strict=strict, assign=assign)
        except RuntimeError as error:
            problem = str(error).splitlines()[-1].strip().rstrip(".")
            raise ConfigError(
                f"the checkpoint does not fit these settings ({problem}): resume with the settings "
                "that the run began with, or start a new run in another folder"
            ) from error


def _read(config: Mapping[str, Any], modules: Sequence[str]) -> Method:
    with plugins(modules):
        try:
            return Method.read(config)
        except KeyError as error:
            raise ConfigError(f"the configuration lacks the group {error}") from error
