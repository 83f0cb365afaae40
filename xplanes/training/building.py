"""Builds field, model and sampler from a scene or a checkpoint, and sums their losses."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from xplanes import __version__
from xplanes.backend import fast_bf16
from xplanes.components import build, plugins
from xplanes.errors import ConfigError
from xplanes.fields.base import Representation
from xplanes.models.base import LossTerm, Model, ModelSettings
from xplanes.models.initialisation import Initialisation, Method, Place, initialisation_of
from xplanes.models.smoothing import coherence
from xplanes.rendering.base import Rendering
from xplanes.rendering.exposure import START as EXPOSURE_START
from xplanes.rendering.exposure import ExposureSampler
from xplanes.rendering.refining import RefiningSampler
from xplanes.rendering.sampler import Sampler, Site
from xplanes.scenes.batches import Batch
from xplanes.scenes.frame import (
    CameraGroups,
    CubeHints,
    Frame,
    frame_content,
    pixels_across,
    read_frame,
)
from xplanes.scenes.views import Scene
from xplanes.streams import TrainingState
from xplanes.training.diagnosis import TrainingError

ANOTHER_SEED = 1_000_003
"""Added to the seed when a field is re-initialised."""


@dataclass(frozen=True)
class Parts:
    """A field with its model and sampler.

    Attributes:
        settings: The model's settings, including those set by the initialisation.
        site: Context for which the field was built.
        model: The model, which has the field.
        sampler: The sampler, which renders the field.
        initialisation: The initialisation without the sparse part, which the model keeps; None if
            the field was loaded.
    """

    settings: ModelSettings
    site: Site
    model: Model
    sampler: Sampler
    initialisation: Initialisation | None = None

    @property
    def field(self) -> Representation:
        """The field that is trained."""
        return self.model.field

    @classmethod
    def assemble(
        cls, settings: ModelSettings, site: Site, initialisation: Initialisation | None = None
    ) -> "Parts":
        """Build model and sampler.

        Raises:
            ConfigError: If they do not fit together.
        """
        values = None if initialisation is None else initialisation.values
        model = settings.build(site, values)
        if initialisation is not None and values is not None:
            # The sparse part is large; only the model keeps it, until L_r has faded.
            initialisation = replace(initialisation, values=replace(values, sparse=None))
        field: Any = model.field
        if not isinstance(field, Representation):
            raise ConfigError(
                f"{type(model).__name__}.field: {type(field).__name__} must be derived from "
                "xplanes.fields.base.RadianceField"
            )
        settings.sampler.require_kind(type(field))
        sampler = settings.sampler.build(field, site)
        if site.exposed is not None:
            sampler = ExposureSampler(sampler, site.exposed, site.steps(EXPOSURE_START))
        if site.cameras is not None:
            sampler = RefiningSampler(sampler, site.cameras, site.batch_scale)
        require_groups(model, sampler)
        return cls(settings, site, model, sampler, initialisation)

    def stronger(self) -> "Parts":
        """Rebuild the parts with another seed and the model's settings for a restart."""
        settings = self.settings.stronger()
        assert settings is not None
        site, found = replace(self.site, seed=self.site.seed + ANOTHER_SEED), self.initialisation
        if found is not None and found.values is not None:
            found = replace(found, values=replace(found.values, sparse=self.model.sparse))
        return Parts.assemble(settings, site, found)


def build_parts(
    method: Method,
    scene: Scene,
    *,
    hints: CubeHints | None = None,
    device: torch.device | None = None,
    devices: int = 1,
    initialisation: Initialisation | None = None,
    frame: Frame | None = None,
    say: Callable[[str], None] = print,
) -> Parts:
    """Build the field of a scene, with its initialisation.

    Args:
        method: All settings except those of the data and the Trainer.
        scene: The scene, with a ``train`` split.
        hints: Information about the scene's cube; the scene's points when None.
        device: Device on which the field will be trained; the CPU when None.
        devices: Number of processes that share the run.
        initialisation: The field's initialisation; computed from ``lrm`` when None.
        frame: The field's frame; chosen by the model when None.
        say: Function that receives a status line before each slow operation.

    Raises:
        ConfigError, SceneError, LRMError: If settings, scene and initialisation do not fit
            together.
    """
    views, rays = scene.splits["train"], method.model.rays
    device = device or torch.device("cpu")
    hints = hints or CubeHints(points=scene.points)
    frame = frame or method.model.frame(views, hints)
    found = initialisation
    if found is None:
        place = Place(scene, frame, device, devices, say, hints)
        found = initialisation_of(method, method.lrm.load(say), place)
    resolved = rays.on(device)
    cameras = CameraGroups.of(views, found.frame)
    site = Site(
        frame=found.frame,
        # All views of a static field have the same time.
        times=torch.zeros_like(views.times) if found.model.is_static else views.times,
        seed=method.seed,
        precision=precision_of(found.model, device),
        bounds=found.model.bounds(views),
        views=views,
        positions=views.positions,
        initialised=found.values is not None,
        pixels=pixels_across(views, found.frame),
        surrounded=scene.is_surrounded,
        cameras=cameras if scene.refine_cameras else None,
        exposed=cameras if rays.matches_exposure and scene.is_surrounded else None,
        device=device,
        samples_per_batch=resolved.most_samples,
        batch_scale=resolved.most_rays / rays.most_rays if rays.most_rays else 1.0,
    )
    if site.is_rig and site.surrounded and not site.initialised:
        site = replace(site, coherence=coherence(views, site.frame))
    parts = Parts.assemble(found.model, site, found)
    assert parts.initialisation is not None
    seconds = found.seconds | {"fill": parts.sampler.fill_seconds}
    return replace(parts, initialisation=replace(parts.initialisation, seconds=seconds))


def loss_terms(
    parts: Parts,
    added: Mapping[str, LossTerm],
    rendering: Rendering,
    rays: Batch,
    state: TrainingState,
) -> dict[str, Tensor]:
    """Weighted loss terms by name: the model's, the sampler's and additional ones. [] each

    Args:
        parts: The field with its model and sampler.
        added: Terms of the group ``losses``.
        rendering: The rendering of the batch.
        rays: The batch.
        state: Seed and progress of training.

    Raises:
        ConfigError: If two terms have the same name.
        TrainingError: If a term is not a single number.
    """
    device = rendering.colour.device
    found = parts.model.losses(rendering, rays, state) | parts.sampler.losses(rendering)
    terms = {name: _number(term, f"loss term {name}", device) for name, term in found.items()}
    for name, term in added.items():
        if name in found:
            raise ConfigError(
                f"losses.{name}: the loss has a term of this name; choose another name"
            )
        value = term.value(parts.field, rendering, rays, state)
        terms[name] = term.weight * _number(value, f"losses.{name}", device)
    return terms


def _number(term: Any, name: str, device: torch.device) -> Tensor:
    """A loss term as a tensor without dimensions. []

    Raises:
        TrainingError: If it is not a single number.
    """
    if isinstance(term, int | float):
        return torch.tensor(float(term), device=device)
    if isinstance(term, Tensor) and term.numel() == 1:
        return term.reshape(()) if term.ndim else term
    shape = f"a tensor of shape {list(term.shape)}" if isinstance(term, Tensor) else None
    raise TrainingError(
        f"{name}: returned {shape or type(term).__name__}; return one number, such as its mean"
    )


def site_content(parts: Parts) -> dict[str, Any]:
    """Properties of a field that depend on the data and the LRM, as builtins and tensors."""
    site = parts.site
    return {
        "model": parts.settings.plain(),
        "frame": frame_content(site.frame),
        "times": site.times,
        "bounds": site.bounds,
        "positions": site.positions,
        "initialised": site.initialised,
        "pixels": site.pixels,
        "coherence": site.coherence,
        "surrounded": site.surrounded,
        "cameras": None if site.cameras is None else vars(site.cameras),
        "exposed": None if site.exposed is None else vars(site.exposed),
    }


def parts_from(
    content: Mapping[str, Any], method: Method, modules: Sequence[str], samples: int | None
) -> Parts:
    """Build a field without its data, before its weights are loaded.

    Args:
        content: Result of `site_content`.
        method: All settings except those of the data and the Trainer.
        modules: The user's modules whose classes ``content`` may name.
        samples: Samples per training batch.

    Raises:
        ConfigError: If the content names a class that is not allowed.
    """
    with plugins(modules):
        settings = build(content["model"], ModelSettings, "model")
    if not content["initialised"] or settings.name != method.model.name:
        settings = method.model  # Loading the weights of another model fails later.
    cameras, exposed = (
        None if (groups := content[name]) is None else CameraGroups(**groups)
        for name in ("cameras", "exposed")
    )
    site = Site(
        frame=read_frame(content["frame"], "the checkpoint"),
        times=content["times"],
        seed=method.seed,
        precision=precision_of(settings, torch.device("cpu")),
        bounds=content["bounds"],
        positions=content["positions"],
        initialised=content["initialised"],
        pixels=content["pixels"],
        coherence=content["coherence"],
        surrounded=content["surrounded"],
        cameras=cameras,
        exposed=exposed,
        samples_per_batch=samples,
    )
    return Parts.assemble(settings, site)


def require_frame(parts: Parts, content: Mapping[str, Any]) -> None:
    """Refuse a checkpoint whose planes were trained in another frame than the initialisation's.

    Raises:
        ConfigError: With the difference.
    """
    trained = read_frame(content["frame"], "the checkpoint")
    if not (parts.site.initialised and content["initialised"]):
        return
    for name, now in frame_content(parts.site.frame).items():
        before = torch.as_tensor(getattr(trained, name))
        if not torch.allclose(before, torch.as_tensor(now), rtol=1e-4, atol=1e-5):
            raise ConfigError(
                "the initialisation was recomputed, because its entry in preparation.cache is "
                f"gone, and its frame differs from the checkpoint's ({name} {before.tolist()}, now "
                f"{torch.as_tensor(now).tolist()}): restore the entry, or start a new run in "
                "another folder"
            )


def precision_of(settings: ModelSettings, device: torch.device) -> str:
    """Precision of matrix products; ``auto`` is resolved for the device."""
    if settings.precision == "auto":
        return "bf16" if fast_bf16(device) else "32"
    return settings.precision


def require_version(path: Any) -> None:
    """Refuse a checkpoint of a version with different settings.

    Args:
        path: The file; paths that are not readable local files are ignored.

    Raises:
        ConfigError: With the version.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
        made = str(content.get("xplanes", "0.2 or older"))
    except Exception:  # The loading function reports the problem.
        return
    if made.split(".")[:2] != __version__.split(".")[:2]:
        raise ConfigError(
            f"{path} was made by xplanes {made}, whose settings differ from {__version__}: "
            "load it with that version, or start a new run"
        )


def require_float32(precision: str) -> None:
    """Refuse a Trainer that changes the precision: the model sets its own.

    Raises:
        ConfigError: With the setting to use instead.
    """
    if precision not in ("32", "32-true"):
        raise ConfigError(
            f"precision={precision}: planes are float32, and model.precision (auto, 32 or bf16) "
            "sets the precision of matrix products; leave it out"
        )


def require_new_rays(overfit_batches: float) -> None:
    """Refuse a Trainer that repeats batches: rays are drawn again at each step.

    Raises:
        ConfigError: With the setting to use instead.
    """
    if overfit_batches:
        raise ConfigError(
            f"overfit_batches={overfit_batches}: rays are drawn again at each step; leave it out, "
            "and set data.views to train on few images"
        )


def require_groups(model: Model, sampler: Sampler) -> None:
    """Refuse parameter groups that training cannot use.

    Raises:
        ConfigError: With an example of a complete group.
    """
    wanted = ("params", "lr", "name")
    whole = '{"params": list(field.parameters()), "lr": 0.001, "name": "field"}'
    for owner in (model, sampler):
        for group in owner.groups():
            if missing := " and ".join(key for key in wanted if key not in group):
                place = f"{type(owner).__name__}.groups"
                raise ConfigError(f"{place}: a group lacks {missing}; write {whole}")
    groups, place = [*model.groups(), *sampler.groups()], f"{type(model).__name__}.groups"
    names = [group["name"] for group in groups]
    if twice := [name for name in names if names.count(name) > 1]:
        raise ConfigError(f"{place}: two groups have the name {twice[0]}")
    keys = [(group["name"], key) for group in groups for key in group if key not in wanted]
    optimizer = model.optimizer(groups)
    for name, key in keys:
        if key not in optimizer.defaults:
            raise ConfigError(
                f"{place}: the group {name} has {key!r}, which {type(optimizer).__name__} does not "
                f"accept; it accepts {', '.join(optimizer.defaults)}"
            )
    trained = {id(parameter) for group in groups for parameter in group["params"]}
    for part in (model.field, *sampler.modules.values()):
        for name, parameter in part.named_parameters():
            if parameter.requires_grad and id(parameter) not in trained:
                raise ConfigError(
                    f"{place}: no group has {name} of {type(part).__name__}, which would never be "
                    "trained; add it to a group, or call its requires_grad_(False)"
                )
