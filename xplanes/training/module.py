"""The LightningModule that trains one field on rays."""

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

import torch
from lightning import LightningModule
from lightning.pytorch.core.optimizer import LightningOptimizer
from torch import Tensor, nn

from xplanes.backend import fast_bf16
from xplanes.components import build, plugins
from xplanes.config import compose_plain
from xplanes.errors import ConfigError, XPlanesError
from xplanes.fields.base import Representation
from xplanes.metrics import psnr, ssim
from xplanes.models.base import Model, ModelSettings, colour_error
from xplanes.models.initialisation import Initialisation, Method, Place
from xplanes.rendering.base import Renderer, Rendering, leave_empty
from xplanes.rendering.sampler import Sampler, Site
from xplanes.scenes.batches import Batch, BatchSettings
from xplanes.scenes.frame import Frame, frame_content, read_frame
from xplanes.scenes.views import Scene
from xplanes.streams import TrainingState
from xplanes.training.clock import training_seconds
from xplanes.training.finite import all_usable, not_finite, unusable_gradients
from xplanes.training.meters import Meters, due, masked_mean, mean_opacities

ANOTHER_SEED = 1_000_003
"""Added to the seed of a field that begins anew."""

PATIENCE = 20
"""Steps in a row with a loss or gradient that is not finite after which training gives up."""

COUNTS = ("rays", "candidates", "empty", "occluded", "samples", "passed", "no_room")
"""What a run counts: rays, samples in their box, those dropped as empty or occluded, those left,
those whose gradients reached the field, and rays left out for want of room on a GPU."""

DROPPED = ("candidates", "empty", "occluded")
"""Numbers of samples before some are dropped."""

OPACITIES = 5
"""Batches from one look at the rays' opacity to the next."""


class TrainingError(XPlanesError, RuntimeError):
    """Training cannot continue; the message says what was observed and what to change."""


class RadianceModule(LightningModule):
    """Trains a field on rays, supervised by the images' colours.

    The field is built in `setup`, when the scene is known. An LRM, if configured, runs there too.
    Checkpoints store what the data and the LRM determine about the field, so
    ``RadianceModule.load_from_checkpoint(path)`` needs only the file (and ``plugins``, if used).
    Optimisation is manual: the Trainer's gradient clipping and accumulation do not apply. Set
    ``model.rays.accumulate`` to accumulate gradients.

    Args:
        config: The keys ``seed``, ``model``, ``lrm``, ``preparation``, ``decomposition`` and
            ``losses`` (optional) of a configuration, as dicts, lists, numbers and strings; others
            are ignored.
        plugins: Names of the user's modules whose classes the configuration may name.

    Raises:
        ConfigError: If a setting is missing or invalid, or a plug-in cannot be imported.
    """

    field: Representation

    def __init__(self, config: Mapping[str, Any], plugins: Sequence[str] = ()) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.method = _read(config, plugins)
        kept = {name: config[name] for name in Method.GROUPS if name in config}
        # Not the plug-ins: a file from somebody else must not choose what is imported.
        self.save_hyperparameters({"config": kept})
        self._plugins = tuple(plugins)
        self.ray_settings: BatchSettings = self.method.model.rays
        """What a training step gets to see; once the field is built, on its device."""
        self.model: Model | None = None
        self.sampler: Sampler | None = None
        self.site: Site | None = None
        self.initialisation: Initialisation | None = None
        self.batches = 0
        self.rays = 0
        self.counts: dict[str, int] = dict.fromkeys(COUNTS, 0)
        self.unusable = 0
        self.unusable_in_a_row = 0
        self.restarts = 0
        """How often the field has begun anew, see `restart`."""
        self.advice: str | None = None
        """What to change when the loss is not finite; the model's own advice when None."""
        self.last: dict[str, float] = {}
        """Loss and PSNR of the last batch, mean opacities, and the last scores of views."""
        self._meters = Meters()
        self._broken: Tensor | None = None
        self._opacities: dict[str, Tensor] = {}
        self._steps = math.inf
        self._loaded_step = 0
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
    def of(cls, method: Method) -> "RadianceModule":
        """Build from settings that are already parsed.

        Args:
            method: All settings except those of the data and the Trainer.

        Raises:
            ConfigError: If a settings class belongs to a plug-in.
        """
        return cls(method.plain())

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
        try:
            return super().load_from_checkpoint(
                checkpoint_path, *args, weights_only=weights_only, **kwargs
            )
        except ConfigError as error:
            words, ask, _ = str(error).partition("plugins=[MODULE]")
            if not ask:
                raise
            raise ConfigError(f"{words}load_from_checkpoint(path, {ask})") from error

    # Building

    def setup(self, stage: str) -> None:
        require_whole_floats(str(self.trainer.precision))
        if self.model is not None:
            return
        data: Any = self.trainer.datamodule  # type: ignore[attr-defined]
        if data is None:
            raise ConfigError(
                "a RadianceModule trains with a SceneDataModule: hand one over as datamodule="
            )
        self.build(
            data.scene,
            half_side=data.settings.half_side,
            device=self.trainer.strategy.root_device,
            devices=self.trainer.world_size,
        )

    def build(
        self,
        scene: Scene,
        frame: Frame | None = None,
        *,
        half_side: float | None = None,
        device: torch.device | None = None,
        devices: int = 1,
        initialise: Callable[[Method, Place], Initialisation] | None = None,
        say: Callable[[str], None] = print,
    ) -> None:
        """Build the field for a scene, with the configured initialisation.

        Args:
            scene: The scene, with a ``train`` split.
            frame: The field's frame; chosen by the model when None.
            half_side: Half the side of the scene's cube in world units; estimated when None.
            device: Device on which the field will be trained; the CPU when None.
            devices: Number of processes that share the run.
            initialise: Function that makes the initialisation; taken from ``lrm`` when None.
            say: Function that receives a status line before each slow operation.

        Raises:
            ConfigError, SceneError, LRMError: If settings, scene and initialisation do not fit
                together.
        """
        views, method = scene.splits["train"], self.method
        device = device or torch.device("cpu")
        if frame is None:
            frame = method.model.frame(views, half_side, scene.points)
        if initialise is None and (source := method.lrm.load(say)) is not None:
            initialise = source.initialise
        found = Initialisation(method.model, frame)
        if initialise is not None:
            found = initialise(method, Place(scene, frame, device, devices, say, half_side))
        rays = self.method.model.rays
        self.ray_settings = rays.on(device)
        site = Site(
            frame=found.frame,
            # In a field without time planes all views are of one timestep.
            times=torch.zeros_like(views.times) if found.model.is_static else views.times,
            seed=method.seed,
            precision=_precision(found.model, device),
            bounds=found.model.bounds(views),
            views=views,
            initialised=found.values is not None,
            surrounded=scene.is_surrounded,
            device=device,
            samples_per_batch=self.ray_settings.most_samples,
            batch_scale=self.ray_settings.most / rays.most if rays.most else 1.0,
        )
        self.initialisation = found
        self._assemble(found.model, site)

    def _assemble(self, settings: ModelSettings, site: Site) -> None:
        values = None if self.initialisation is None else self.initialisation.values
        self.model = settings.build(site, values)
        self.field = require_field(self.model)
        settings.sampler.require_kind(type(self.field))
        self.sampler = settings.sampler.build(self.field, site)
        require_groups(self.model, self.sampler)
        for name, part in self.sampler.parts.items():
            self.add_module(name, part)
        self.site, self._settings = site, settings
        self.rays = self.sampler.first_rays(self.ray_settings.most)

    @property
    def frame(self) -> Frame | None:
        """The field's frame; None before it is built."""
        return None if self.site is None else self.site.frame

    @property
    def renderer(self) -> Renderer:
        """Renders images of the field."""
        return self._parts[1].renderer

    @property
    def renderer_now(self) -> Renderer:
        """The same for the field as far as it is trained."""
        return self._parts[1].renderer_at(max(self.global_step, self._loaded_step))

    @property
    def _parts(self) -> tuple[Model, Sampler]:
        if self.model is None or self.sampler is None:
            raise ConfigError(
                "the field is not built yet: fit with a SceneDataModule, or load a checkpoint"
            )
        return self.model, self.sampler

    # Training

    @property
    def progress(self) -> float:
        """Share of training that is done: of its steps, or as callbacks with ``progress`` say."""
        share = self.global_step / self._steps
        return min(1.0, max([share, *(callback.progress for callback in self._schedules)]))

    @property
    def between_updates(self) -> bool:
        """Whether no gradients of batches wait for others (``model.rays.accumulate``)."""
        return self.batches % self.ray_settings.accumulate == 0

    @property
    def state(self) -> TrainingState:
        """How far training is."""
        done = (self.global_step, self.batches, self.global_rank)
        return TrainingState(self.method.seed, *done, progress=self.progress)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        model, sampler = self._parts
        groups = [*model.groups(), *sampler.groups()]
        # Not part of the optimiser, whose state a resumed run takes over: settings may change.
        self._peaks = [group["lr"] for group in groups]
        return model.optimizer(groups)

    def on_fit_start(self) -> None:
        # Callbacks ask for `progress` in their on_train_start, which is before this module's.
        trainer = self.trainer
        self._steps = max(1, self._most_steps())
        callbacks: list[Any] = trainer.callbacks  # type: ignore[attr-defined]
        self._schedules = [c for c in callbacks if isinstance(getattr(c, "progress", None), float)]
        self.method.require_devices(trainer.world_size)

    def _most_steps(self) -> float:
        """Steps that the Trainer does at most, by its steps and its epochs."""
        trainer = self.trainer
        most = trainer.max_steps if trainer.max_steps > 0 else math.inf
        batches = trainer.estimated_stepping_batches  # Makes the data loader, whose length counts.
        if trainer.max_epochs is not None and trainer.max_epochs > 0:
            batches = trainer.max_epochs * trainer.num_training_batches
            most = min(most, batches / self.ray_settings.accumulate)
        return most

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        model, step, progress = self._parts[0], self.global_step, self.progress
        groups = cast(LightningOptimizer, self.optimizers()).param_groups
        for group, peak in zip(groups, self._peaks, strict=True):
            group["lr"] = model.rate_of(group["name"], step, progress) * peak

    def training_step(self, batch: Batch, batch_idx: int) -> None:
        model, sampler = self._parts
        optimizer = cast(LightningOptimizer, self.optimizers())
        state = self.state
        model.before_step(state, optimizer.optimizer)
        rays = self.ray_settings.part(batch, self.rays)
        rendering = sampler.render(self.field, rays, state)
        terms = self._terms(rendering, rays, state)
        loss = sum(terms.values())
        assert isinstance(loss, Tensor)
        if loss.device.type != "cpu" and _takes_flags(optimizer.optimizer):
            self._go_on_without_waiting(optimizer, state, rendering, rays, terms, loss)
            return
        value = float(loss.detach())
        self.batches += 1
        # All ranks must skip a step together: one that waits for the others' gradients would hang.
        usable = self.trainer.strategy.reduce_boolean_decision(math.isfinite(value), all=True)
        if not usable:
            optimizer.zero_grad()  # Of the batches before it, for the same update.
            self._refuse(f"the loss was {value}", rendering, terms)
            return
        self.manual_backward(loss / self.ray_settings.accumulate)
        self.counts["passed"] += int(sampler.pass_on(rendering, state))
        sampler.observe(rendering)
        samples = rendering.samples
        shown = {name: int(getattr(samples, name)) for name in DROPPED}
        self._count(shown | {"samples": int(samples.count)}, len(rays["times"]))
        error = float(colour_error(rendering, rays).detach())
        self.last |= {"loss": value, "psnr": -10 * math.log10(max(error, 1e-10))}
        # Before a background that is learnt, no pixel is known to need opacity or to lack it.
        plain = getattr(self.field, "background", None) is None
        if plain and self.batches % OPACITIES == 0:
            self.last |= {n: float(value) for n, value in mean_opacities(rendering, rays).items()}
        self._log_terms(terms, state)
        if self.between_updates:
            self._update(optimizer, state, rendering, terms)

    def _go_on_without_waiting(
        self,
        optimizer: LightningOptimizer,
        state: TrainingState,
        rendering: Rendering,
        rays: Batch,
        terms: dict[str, Tensor],
        loss: Tensor,
    ) -> None:
        """The rest of a step on a GPU: the host runs ahead, and looks at what came out later.

        Whether loss and gradients are finite stays on the GPU, where the optimiser leaves the step
        out if they are not; such a step counts as one.
        """
        sampler = self._parts[1]
        self.batches += 1
        bad = (~loss.detach().isfinite()).float()
        self._broken = bad if self._broken is None else torch.maximum(self._broken, bad)
        self.manual_backward(loss / self.ray_settings.accumulate)
        passed = sampler.pass_on(rendering, state)
        sampler.observe(rendering)
        count, samples = len(rays["times"]), rendering.samples
        shown: Tensor | None = getattr(samples, "shown", None)
        values = {name: getattr(samples, name) for name in DROPPED}
        values |= {"samples": samples.count, "passed": passed, "batches": 1, "all rays": count}
        values |= {"rays": count if shown is None else shown.sum()}
        error = (rendering.colour.detach() - rays["target"]).square().mean(dim=1)
        values |= {"loss": loss, "error": masked_mean(error, shown)}
        plain = getattr(self.field, "background", None) is None
        if plain and self.batches % OPACITIES == 0:
            self._opacities = mean_opacities(rendering, rays)
        if self.between_updates:
            values["skipped"] = self._update_by_flag(optimizer, state)
        else:
            values["skipped"] = torch.zeros_like(bad)
        self._meters.add(values)
        if due(self.batches) or self._logs_now:
            self._read_meters()
            if self.unusable_in_a_row >= PATIENCE:
                self._give_up("the loss or a gradient was not finite", rendering, terms)
        self._log_terms(terms, state)

    def _update_by_flag(self, optimizer: LightningOptimizer, state: TrainingState) -> Tensor:
        """Step unless loss or gradients are not finite; 1 if they were not, on the device. []"""
        model, sampler = self._parts
        model.regularise(state)
        sampler.regularise()
        gradients = [p.grad for p in self.parameters() if p.grad is not None]
        broken = (~nn.utils.get_total_norm(gradients).float().square().isfinite()).float()
        if self._broken is not None:
            broken = torch.maximum(broken, self._broken)
        self._broken = None
        if self.trainer.world_size > 1:
            # All ranks must skip a step together, for their planes must stay equal.
            torch.distributed.all_reduce(broken, op=torch.distributed.ReduceOp.MAX)
        # As a gradient scaler tells it.
        optimizer.optimizer.found_inf = broken  # type: ignore[attr-defined]
        optimizer.step()
        optimizer.zero_grad()
        sampler.update(self.field, state)
        return broken

    def on_train_end(self) -> None:
        self._read_meters()

    def _read_meters(self) -> None:
        """Take in what the batches since the last look showed, if there were any."""
        if not (found := self._meters.read()):
            return
        batches, skipped = int(found.pop("batches")), int(found.pop("skipped"))
        self.last |= {
            "loss": found.pop("loss") / batches,
            "psnr": -10 * math.log10(max(found.pop("error") / batches, 1e-10)),
        }
        self.last |= {name: float(value) for name, value in self._opacities.items()}
        self.counts["passed"] += int(found.pop("passed"))
        rays = int(found.pop("rays"))
        self.counts["no_room"] += int(found.pop("all rays")) - rays
        self._count({name: int(value) for name, value in found.items()}, rays)
        # Of batches of as many rays as the next one has.
        self._parts[1].expect(found["samples"] * self.rays / max(1, rays))
        self.unusable += skipped
        whole = skipped and skipped >= batches // self.ray_settings.accumulate
        self.unusable_in_a_row = self.unusable_in_a_row + skipped if whole else 0

    def rehearse(self, rays: Batch) -> None:
        """Do all that a step does on a copy of the field, so that its kernels are compiled."""
        model, sampler = parts = copy.deepcopy(self._parts)
        state = self.state
        optimizer = model.optimizer([*model.groups(), *sampler.groups()])
        rendering = sampler.render(model.field, rays, state)
        terms = self._terms(rendering, rays, state, parts)
        torch.stack(list(terms.values())).sum().backward()
        sampler.pass_on(rendering, state)
        sampler.observe(rendering)
        model.regularise(state)
        sampler.regularise()
        optimizer.step()
        sampler.update(model.field, state)

    def _terms(
        self,
        rendering: Rendering,
        rays: Batch,
        state: TrainingState,
        parts: tuple[Model, Sampler] | None = None,
    ) -> dict[str, Tensor]:
        """All terms of the loss that need the rays, weighted, by name; of a copy, if given. []"""
        model, sampler = parts or self._parts
        device = rendering.colour.device
        found = model.losses(rendering, rays, state) | sampler.losses(rendering)
        terms = {name: _number(term, f"loss term {name}", device) for name, term in found.items()}
        for name, term in self.method.losses.items():
            if name in found:
                raise ConfigError(
                    f"losses.{name}: the loss has a term of this name already; choose another name"
                )
            value = term.value(model.field, rendering, rays, state)
            terms[name] = term.weight * _number(value, f"losses.{name}", device)
        return terms

    def _update(
        self,
        optimizer: LightningOptimizer,
        state: TrainingState,
        rendering: Rendering,
        terms: Mapping[str, Tensor],
    ) -> None:
        model, sampler = self._parts
        model.regularise(state)
        sampler.regularise()
        usable = all_usable(self.parameters())
        if not self.trainer.strategy.reduce_boolean_decision(usable, all=True):
            broken = [f"gradient of {name}" for name in unusable_gradients(self.named_parameters())]
            optimizer.zero_grad()
            what = "a gradient was infinite, NaN or too large to square"
            self._refuse(what, rendering, terms, broken)
            return
        self.unusable_in_a_row = 0
        optimizer.step()
        optimizer.zero_grad()
        sampler.update(self.field, state)

    @property
    def _logs_now(self) -> bool:
        """Whether the Trainer wants logs of the last batch."""
        every = self.trainer.log_every_n_steps  # type: ignore[attr-defined]
        # As the Trainer counts, for which a module that was loaded begins anew.
        batch = self.trainer.fit_loop.epoch_loop.total_batch_idx + 1
        return bool(every and not batch % every and self.trainer.loggers)

    def _log_terms(self, terms: Mapping[str, Tensor], state: TrainingState) -> None:
        """Log every term of the loss, weighted, where the Trainer wants logs of this step."""
        if not self._logs_now:
            return
        model, sampler = self._parts
        values = {name: float(term.detach()) for name, term in terms.items()}
        values |= model.regularisers(state)
        entries = {f"train/{name}": value for name, value in values.items()}
        entries |= {"train/loss": sum(values.values()), "train/psnr": self.last["psnr"]}
        entries |= {"train/steps_skipped": float(self.unusable), "step": float(state.step)}
        groups = cast(LightningOptimizer, self.optimizers()).param_groups
        entries |= {f"lr/{group['name']}": group["lr"] for group in groups}
        entries["sampler/samples_per_ray"] = self.counts["samples"] / max(1, self.counts["rays"])
        seconds = training_seconds(self.trainer)
        if seconds:
            entries["time/rays_per_s"] = self.counts["rays"] / seconds
            entries["time/train_s"] = seconds
        self.log_dict(entries | sampler.scalars() | model.scalars(), batch_size=1)

    def _count(self, shown: Mapping[str, int], rays: int) -> None:
        """Take in numbers of samples, by name, and of rays, of some batches."""
        for name, value in shown.items():
            self.counts[name] += value
        self.counts["rays"] += rays
        self.rays = self.ray_settings.fitting(rays, shown["samples"])

    def _refuse(
        self,
        what: str,
        rendering: Rendering,
        terms: Mapping[str, Tensor],
        gradients: Sequence[str] = (),
    ) -> None:
        """Leave a step out, and give up after `PATIENCE` of them in a row."""
        self.unusable += 1
        self.unusable_in_a_row += 1
        if self.unusable_in_a_row >= PATIENCE:
            self._give_up(what, rendering, terms, gradients)

    def _give_up(
        self,
        what: str,
        rendering: Rendering,
        terms: Mapping[str, Tensor],
        gradients: Sequence[str] = (),
    ) -> None:
        density, parameters = rendering.density, not_finite(self.named_parameters())
        seen = {"colour": rendering.colour, "opacity": rendering.opacity, "density": density}
        rays = [f"rendered {name}" for name in not_finite(seen.items())]
        losses = [self._key_of(name) for name in not_finite(terms.items())]
        broken = parameters or [*gradients] or [*rays, *losses]
        raise TrainingError(
            f"{what} for {PATIENCE} steps in a row, at step {self.global_step}; not finite: "
            f"{', '.join(broken) or 'gradients, or something in another process'}; largest density "
            f"{float(density.max()) if len(density) else 0:.3g}. "
            f"{self._way_out(losses, rendered=not (parameters or rays))}"
        )

    def _key_of(self, term: str) -> str:
        """A term of the loss as the configuration names it, or as one of the model's."""
        return f"losses.{term}" if term in self.method.losses else f"loss term {term}"

    def require_finite(self) -> None:
        """Refuse to go on with, or to keep, parameters that are not finite.

        Raises:
            TrainingError: Naming them.
        """
        if broken := not_finite(self.named_parameters()):
            raise TrainingError(
                f"not finite at step {self.global_step}: {', '.join(broken)}. No checkpoint was "
                f"written over the last sound one. {self._way_out()}"
            )

    def _way_out(self, broken: Sequence[str] = (), *, rendered: bool = False) -> str:
        """What to change.

        Args:
            broken: Terms of the loss that are not finite.
            rendered: Whether parameters and rendering are finite nevertheless.
        """
        added = [f"losses.{name}" for name in self.method.losses] if rendered else []
        begun = self.global_step > 0
        resume = "; resume= continues from the last checkpoint" if begun else ""
        if culprits := [name for name in added if name in broken]:
            return f"The rendering is finite: correct {' and '.join(culprits)} or omit it{resume}"
        precision = "" if self.field.precision == "32" else ", or set model.precision=32"
        if begun:
            more = f", or omit {' and '.join(added)}" if added else ""
            if self.advice is not None:
                return f"{self.advice}{resume}"
            return f"{self._parts[0].advice}{more}{precision}{resume}"
        initialised = self.site is not None and self.site.initialised
        if initialised and not added and not (rendered and broken):
            largest = max(float(p.detach().abs().max()) for p in self.field.parameters())
            return (
                f"No step was done yet, so the initialisation is to blame, whose largest value is "
                f"{largest:.3g}: set lrm=none, or make it anew"
            )
        checked = " and ".join([type(self.field).__name__, *added])
        return f"No step was done yet: check the values and gradients of {checked}{precision}"

    @property
    def can_restart(self) -> bool:
        """Whether the model has settings that help a field that shows nothing."""
        return self._settings.stronger() is not None

    def restart(self) -> None:
        """Initialise the field anew, with another seed and the model's stronger settings.

        For one process that trains; steps and budget go on.
        """
        assert self.site is not None
        device = self.device
        self._assemble_stronger()
        self.to(device)
        model, sampler = self._parts
        optimizer = cast(LightningOptimizer, self.optimizers()).optimizer
        for group, fresh in zip(
            optimizer.param_groups, [*model.groups(), *sampler.groups()], strict=True
        ):
            group["params"] = fresh["params"]
        optimizer.state.clear()

    def _assemble_stronger(self) -> None:
        stronger = self._settings.stronger()
        assert self.site is not None
        assert stronger is not None
        self.restarts += 1
        site = replace(self.site, seed=self.site.seed + ANOTHER_SEED)
        self._assemble(stronger, site)

    # Scores

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> dict[str, Tensor]:
        return self._score(batch, "val")

    def test_step(self, batch: dict[str, Any], batch_idx: int) -> dict[str, Tensor]:
        return self._score(batch, "test")

    def predict_step(self, batch: dict[str, Any], batch_idx: int) -> dict[str, Tensor]:
        """One view: ``colour`` [H, W, 3], ``opacity`` and ``depth`` [H, W]."""
        return self._view(batch)

    def _score(self, batch: dict[str, Any], stage: str) -> dict[str, Tensor]:
        image, truth = self._view(batch), batch["target"]
        colour = image["colour"].float().clamp(0, 1)
        scores = {
            f"{stage}/psnr": psnr(colour.cpu(), truth.cpu()),
            f"{stage}/ssim": ssim(colour.cpu(), truth.cpu()),
        }
        self.log_dict(scores, on_epoch=True, prog_bar=True, batch_size=1, sync_dist=True)
        return image

    @torch.no_grad()
    def _view(self, batch: dict[str, Any]) -> dict[str, Tensor]:
        assert self.frame is not None
        seen = (batch["camera"], float(batch["time"]), batch["background"])
        image = self.renderer_now.view(self.field, self.frame, *seen)
        if (shown := batch.get("shown")) is not None:
            leave_empty(image, ~shown, batch["background"])
        return image

    # Checkpoints

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self._read_meters()
        checkpoint["progress"] = {
            "batches": self.batches,
            "rays": self.rays,
            "counts": dict(self.counts),
            "unusable": self.unusable,
            "restarts": self.restarts,
            "last": dict(self.last),
        }
        if self.site is not None:
            checkpoint["site"] = {
                "model": self._settings.plain(),
                "frame": frame_content(self.site.frame),
                "times": self.site.times,
                "bounds": self.site.bounds,
                "initialised": self.site.initialised,
                "surrounded": self.site.surrounded,
            }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        try:
            site, progress = checkpoint["site"], checkpoint["progress"]
            frame = read_frame(site["frame"], "the checkpoint")
            if self.model is None:
                self._rebuild(site, frame)
            else:
                self._require_frame(site, frame)
            if self.site is not None and self.site.views is not None:
                while self.restarts < progress["restarts"]:
                    self._assemble_stronger()
            self.restarts = progress["restarts"]
            self._loaded_step = checkpoint["global_step"]
            self.batches, self.unusable = progress["batches"], progress["unusable"]
            self.rays, self.last = progress["rays"], dict(progress.get("last", {}))
            self.counts = dict.fromkeys(COUNTS, 0) | progress["counts"]
        except (KeyError, TypeError, AttributeError) as error:
            raise ConfigError(
                f"the checkpoint cannot be used ({type(error).__name__}: {error}): it is damaged, "
                "or from another version of xplanes"
            ) from error

    def _rebuild(self, content: Mapping[str, Any], frame: Frame) -> None:
        """Build the field without its data, for weights that are about to be loaded."""
        with plugins(self._plugins):
            settings = build(content["model"], ModelSettings, "model")
        if not content["initialised"] or settings.name != self.method.model.name:
            settings = self.method.model  # Weights of another one will not fit.
        site = Site(
            frame=frame,
            times=content["times"],
            seed=self.method.seed,
            precision=_precision(settings, torch.device("cpu")),
            bounds=content["bounds"],
            surrounded=content.get("surrounded", False),  # Not in older checkpoints.
            samples_per_batch=self.ray_settings.most_samples,
        )
        self._assemble(settings, site)

    def _require_frame(self, content: Mapping[str, Any], trained: Frame) -> None:
        """Refuse planes that were trained in another frame than the initialisation lies in now."""
        assert self.site is not None
        if not (self.site.initialised and content["initialised"]):
            return
        for name, now in frame_content(self.site.frame).items():
            before = torch.as_tensor(getattr(trained, name))
            if not torch.allclose(before, torch.as_tensor(now), rtol=1e-4, atol=1e-5):
                raise ConfigError(
                    f"the initialisation was made anew, and its frame is not the checkpoint's "
                    f"({name} {before.tolist()}, now {torch.as_tensor(now).tolist()}): what "
                    "preparation.cache kept is gone. Bring it back, or train anew in another folder"
                )

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:
        """As torch does, with words for a state of other settings.

        Raises:
            ConfigError: If it does not fit.
        """
        try:
            return super().load_state_dict(state_dict, strict=strict, assign=assign)
        except RuntimeError as error:
            problem = str(error).splitlines()[-1].strip().rstrip(".")
            raise ConfigError(
                f"the checkpoint does not fit these settings ({problem}): continue with those that "
                "the run began with, or train anew in another folder"
            ) from error


def _read(config: Mapping[str, Any], modules: Sequence[str]) -> Method:
    with plugins(modules):
        try:
            return Method.read(config)
        except KeyError as error:
            raise ConfigError(f"the configuration lacks the group {error}") from error


def _number(term: Any, name: str, device: torch.device) -> Tensor:
    """A term of the loss as a tensor without dimensions. []

    Raises:
        TrainingError: If it is not one number.
    """
    if isinstance(term, int | float):
        return torch.tensor(float(term), device=device)
    if isinstance(term, Tensor) and term.numel() == 1:
        return term.reshape(()) if term.ndim else term
    shape = f"a tensor of shape {list(term.shape)}" if isinstance(term, Tensor) else None
    raise TrainingError(
        f"{name}: returned {shape or type(term).__name__}; return one number, such as its mean"
    )


def _precision(settings: ModelSettings, device: torch.device) -> str:
    """The precision of products, settled for a device where the settings say auto."""
    if settings.precision == "auto":
        return "bf16" if fast_bf16(device) else "32"
    return settings.precision


def require_whole_floats(precision: str) -> None:
    """Refuse a Trainer that changes the precision: the model sets its own.

    Raises:
        ConfigError: With what to set instead.
    """
    if precision not in ("32", "32-true"):
        raise ConfigError(
            f"precision={precision}: a field computes in model.precision (auto, 32 or bf16), and "
            "its planes are float32; leave it out"
        )


def require_field(model: Model) -> Representation:
    """The field of a model, if it is one.

    Raises:
        ConfigError: If it is of another class.
    """
    field: Any = model.field
    if not isinstance(field, Representation):
        raise ConfigError(
            f"{type(model).__name__}.field: {type(field).__name__} must be derived from "
            "xplanes.fields.base.RadianceField"
        )
    return field


def require_groups(model: Model, sampler: Sampler) -> None:
    """Refuse parameter groups that training cannot work with.

    Raises:
        ConfigError: With what a group consists of.
    """
    wanted = ("params", "lr", "name")
    whole = '{"params": list(field.parameters()), "lr": 0.001, "name": "field"}'
    for owner in (model, sampler):
        place = f"{type(owner).__name__}.groups"
        for group in owner.groups():
            if missing := [key for key in wanted if key not in group]:
                raise ConfigError(f"{place}: a group lacks {' and '.join(missing)}; write {whole}")
    groups = [*model.groups(), *sampler.groups()]
    names = [group["name"] for group in groups]
    if twice := [name for name in names if names.count(name) > 1]:
        raise ConfigError(f"{type(model).__name__}.groups: two groups have the name {twice[0]}")
    keys = [(group["name"], key) for group in groups for key in group if key not in wanted]
    optimizer = model.optimizer(groups)
    for name, key in keys:
        if key not in optimizer.defaults:
            raise ConfigError(
                f"{type(model).__name__}.groups: {type(optimizer).__name__} takes no {key!r}, "
                f"which the group {name} has; it takes {', '.join(optimizer.defaults)}"
            )


def _takes_flags(optimizer: torch.optim.Optimizer) -> bool:
    """Whether an optimiser leaves a step out where a tensor says so, as fused Adam does."""
    return bool(getattr(optimizer, "_step_supports_amp_scaling", False))
