"""Controls of the LRM: the same preparation, with a part of what it found exchanged.

A plug-in for runs that ask where the lead of an LRM comes from; `overrides` turns a control on. The
preparation runs and counts in full, so that all controls train equally long.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.decomposition import space_planes, time_planes
from xplanes.errors import ConfigError
from xplanes.fields.xplanes import SPACE_PLANES, TIME_PLANES
from xplanes.models.initialisation import Initialisation, Method, Place
from xplanes.models.x_planes import XPlanesSettings
from xplanes.preparation.reconstruct import LoadedLRM, reconstruct
from xplanes.preparation.sequence import TriplaneSequence, load_triplanes
from xplanes.preparation.sources import BundledLRMSettings, LRMInitialiser, cache_of, from_sequence
from xplanes.settings import Location
from xplanes.streams import Stream, step_generator
from xplanes.synthetic.demo.render import camera_at, render_image
from xplanes.synthetic.demo.scenes import build_demo_scene, demo_scene
from xplanes.synthetic.pretraining.objects import procedural_object
from xplanes.synthetic.pretraining.pool import render_solids, view_cameras

OBJECTS = 64
"""Objects of the LRM's training set whose mean triplane is a control."""

OTHER_SCENE = "walker"
"""The demo scene whose video is a control for other scenes."""

NOT_REGULARISED = ("model.loss.sparse_weight=0.0", "model.loss.initial_weight=0.0")
"""Without the terms that hold the field near its initial values."""


def overrides(control: str, oracle: Path | None = None) -> list[str]:
    """Overrides that turn a control of ``lrm=tiny`` on.

    Args:
        control: One of `CONTROLS`.
        oracle: The file of triplanes for "oracle".
    """
    given = ["lrm=tiny", "lrm._target_=controls.ControlSettings", f"+lrm.control={control}"]
    given.append(f"+lrm.triplanes={'null' if oracle is None else oracle}")
    return given + (list(NOT_REGULARISED) if control == "random_planes" else [])


@dataclass(frozen=True, kw_only=True)
class ControlSettings(BundledLRMSettings):
    """A bundled LRM, a part of whose prediction is exchanged."""

    control: Literal[
        "random_planes", "fresh_decoder", "other_scene", "mean", "one_frame", "median", "oracle"
    ]
    triplanes: Location | None  # File of triplanes that replace the LRM's, for oracle.

    def check(self) -> None:
        super().check()
        if (self.control == "oracle") != (self.triplanes is not None):
            raise ConfigError(
                f"control={self.control} with lrm.triplanes={self.triplanes}: oracle, and no other "
                "control, takes a file"
            )

    def load(self, say: Callable[[str], None] = print) -> "ControlInitialiser":
        return ControlInitialiser(self, self.load_model(say))


class ControlInitialiser(LRMInitialiser):
    """Predicts as the LRM does, then exchanges what the control names."""

    settings: ControlSettings

    def initialise(self, method: Method, place: Place) -> Initialisation:
        cache, control = cache_of(method, place), self.settings.control
        made = reconstruct(method, self.settings, place, self.lrm, cache)
        own = made.sequence
        sequence = self._exchanged(own)
        found = from_sequence(
            sequence,
            method,
            place,
            cache,
            source=f"{control} of {made.description}",
            seconds=made.seconds,
        )
        values = found.values
        assert values is not None
        assert isinstance(found.model, XPlanesSettings)
        if control == "random_planes":
            values = replace(values, planes=_noise(found.model, method.seed), sparse=None)
        elif control == "median":
            values = replace(values, **_by_median(own.triplanes, found.model, method))
        elif bool((sequence.triplanes == sequence.triplanes[:1]).all()):
            # Nothing moves: products are not to be held at 0.
            values = replace(values, sparse=None)
        return replace(found, values=values, lrm=made.report)

    def _exchanged(self, own: TriplaneSequence) -> TriplaneSequence:
        planes, control = own.triplanes, self.settings.control
        if control == "fresh_decoder":
            return replace(own, decoder=None, decoder_config=None)
        if control == "oracle":
            assert self.settings.triplanes is not None
            return load_triplanes(Path(self.settings.triplanes))
        if control == "one_frame":
            return replace(own, triplanes=planes[len(planes) // 2].expand_as(planes).clone())
        if control == "mean":
            mean = _resized(training_mean(self.lrm), planes)
            return replace(own, triplanes=mean.expand_as(planes).clone())
        if control == "other_scene":
            return replace(own, triplanes=_resized(other_triplanes(self.lrm, len(planes)), planes))
        return own


def _resized(triplanes: Tensor, like: Tensor) -> Tensor:
    """Triplanes with the texels of others. [T, 3, C, H, H]"""
    flat = F.interpolate(triplanes.flatten(0, 1), size=like.shape[-2:], mode="bilinear")
    return flat.unflatten(0, triplanes.shape[:2])


@torch.no_grad()
def _encoded(lrm: LoadedLRM, pictures: list[Tensor]) -> Tensor:
    """Triplanes of images, RGB on white. [S, S, 3] each -> [N, 3, C, H, H]"""
    images = torch.stack(pictures).float().permute(0, 3, 1, 2)
    return torch.cat([lrm.model.encode(part).float() for part in images.split(8)])


def training_mean(lrm: LoadedLRM) -> Tensor:
    """Mean of the LRM's triplanes of objects that it was trained on. [1, 3, C, H, H]"""
    side, pictures = lrm.model.image_size, []
    for seed in range(OBJECTS):
        pose = camera_at(*view_cameras(seed, 4)[0]).numpy()
        pictures.append(torch.from_numpy(render_solids(procedural_object(seed), pose, side)[0]))
    return _encoded(lrm, pictures).mean(dim=0, keepdim=True)


def other_triplanes(lrm: LoadedLRM, count: int) -> Tensor:
    """The LRM's triplanes of another scene's video. [T, 3, C, H, H]"""
    pose = camera_at(demo_scene(OTHER_SCENE).azimuth, 0.0)
    scene, pictures = build_demo_scene(OTHER_SCENE), []
    for time in torch.linspace(0, 1, count).tolist():
        image = render_image(scene.pose(time), pose, lrm.model.image_size)
        rgba = torch.from_numpy(image).float() / 255
        pictures.append(rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:])
    return _encoded(lrm, pictures)


def _noise(model: XPlanesSettings, seed: int) -> Mapping[str, Tensor]:
    """Planes as without an LRM."""
    assert isinstance(model.time_resolution, int)
    generator = step_generator(seed, 0, Stream.INITIAL_FIELD)
    texels = model.coarse_texels()
    return model.random_planes(model.plane_set, model.time_resolution, texels, generator)


def _by_median(triplanes: Tensor, model: XPlanesSettings, method: Method) -> dict[str, object]:
    """Planes and sparse part where the static part is the median over time."""
    options, texels = method.decomposition, model.coarse_texels()
    space = space_planes(triplanes, static="median", resolution=texels)
    sparse = triplanes - triplanes.median(dim=0).values
    assert isinstance(model.time_resolution, int)
    time = time_planes(
        sparse,
        plane_set=model.plane_set,
        dynamic=options.dynamic,
        resolution=model.time_texels or texels,
        time_resolution=model.time_resolution,
        noise=options.noise,
        generator=step_generator(method.seed, 0, Stream.NOISE),
    )
    names = (*SPACE_PLANES, *TIME_PLANES[model.plane_set])
    planes = {n: p.permute(2, 0, 1) for n, p in zip(names, [*space, *time], strict=True)}
    return {"planes": planes, "sparse": sparse}
