"""First points of Gaussians, from an X-Planes field that is trained for a few seconds."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, cast

import torch
from torch import Tensor

from xplanes.config import CONF, compose_plain
from xplanes.errors import ConfigError
from xplanes.fields.gaussians import PointCloud
from xplanes.fields.xplanes import XPlanes
from xplanes.models.base import InitialValues
from xplanes.models.gaussians import GaussiansSettings
from xplanes.models.initialisation import (
    Initialisation,
    Initialiser,
    InitialiserSettings,
    Method,
    Place,
    no_time,
)
from xplanes.preparation.fixed_view import intrinsics_key, trained_field
from xplanes.preparation.sources import cache_of
from xplanes.rendering.base import RayRenderer
from xplanes.scenes.frame import Frame, frame_content
from xplanes.scenes.views import Views
from xplanes.settings import Count, Positive
from xplanes.streams import Stream, step_generator
from xplanes.training.module import RadianceModule

RAYS = 8192
"""Rays that are drawn together."""

ROUNDS = 200
"""Times that rays are drawn, at most."""

OPAQUE = 0.5
"""Opacity of a ray from which on there is a surface."""


@dataclass(frozen=True, kw_only=True)
class FieldSettings(InitialiserSettings):
    """Points on the surfaces of an X-Planes field that is trained for this; for Gaussians."""

    gives: ClassVar = "points"

    model: Literal["six_planes", "nine_planes"]  # Model of the field.
    source: str  # What the field is initialised from: a file of conf/lrm; none: random.
    steps: Count  # Maximum number of its training steps.
    seconds: Positive | None  # Maximum time of its training; null: no limit.
    times: Count  # Timesteps at which points are taken, evenly spread; 1: the middle.

    def check(self) -> None:
        sources = sorted(path.stem for path in (CONF / "lrm").glob("*.yaml"))
        sources.remove("field")
        if self.source not in sources:
            raise ConfigError(f"source={self.source}: must be one of {', '.join(sources)}")

    def load(self, say: Callable[[str], None] = print) -> "FieldInitialiser":
        return FieldInitialiser(self)


class FieldInitialiser(Initialiser):
    """Trains a field, and takes points from where the training cameras see its surfaces.

    Args:
        settings: Which field, and for how long.
    """

    def __init__(self, settings: FieldSettings) -> None:
        self.settings = settings

    def initialise(self, method: Method, place: Place) -> Initialisation:
        settings, views = self.settings, place.scene.splits["train"]
        count = cast(GaussiansSettings, method.model).count
        overrides = [f"model={settings.model}", f"lrm={settings.source}"]
        field = replace(
            Method.read(compose_plain("train", overrides)),
            seed=method.seed,
            preparation=method.preparation,
            decomposition=method.decomposition,
        )
        cache = cache_of(method, place)
        inputs = [
            views.identity,
            views.camera_to_world,
            views.times,
            intrinsics_key(views.intrinsics),
            frame_content(place.frame),
            field.plain(),
            [settings.steps, settings.seconds, settings.times, count],
        ]

        def make() -> dict[str, Any]:
            place.say(f"points: training {settings.model} for {self._budget}")
            with cache.workshop("points", inputs) as folder:
                budget = {"steps": settings.steps, "seconds": settings.seconds}
                module = trained_field(field, place, folder, **budget)
                cloud = self._look(module, views, place.frame, count, method.seed)
                return {"points": cloud.points, "colours": cloud.colours, "times": cloud.times}

        stage = cache.stage("points", inputs, make, alone=True)
        return Initialisation(
            model=method.model,
            frame=place.frame,
            values=InitialValues({}, points=PointCloud(**stage.content)),
            seconds=no_time() | {"field": stage.seconds},
            words=f"{len(stage.content['points']):,} points on the surfaces of {settings.model}, "
            f"trained for {self._budget}",
        )

    @property
    def _budget(self) -> str:
        steps, seconds = self.settings.steps, self.settings.seconds
        return f"{steps} steps" if seconds is None else f"up to {steps} steps or {seconds:g} s"

    def _look(
        self, module: RadianceModule, views: Views, frame: Frame, count: int, seed: int
    ) -> PointCloud:
        times = torch.linspace(0, 1, self.settings.times)
        if views.is_static or len(times) == 1:
            times = views.times[:1] if views.is_static else torch.tensor([0.5])
        cloud = surface_points(module, views, times, count, seed=seed)
        if not len(cloud.points):
            raise ConfigError(
                f"lrm.steps={self.settings.steps}: {self.settings.model} shows nothing yet that "
                "points could lie on; raise lrm.steps, or set lrm=none"
            )
        assert module.frame is not None
        return replace(cloud, points=frame.points(module.frame.to_world(cloud.points)))


@torch.no_grad()
def surface_points(
    module: RadianceModule, views: Views, times: Tensor, count: int, *, seed: int
) -> PointCloud:
    """Points where rays through random pixels of the views meet what a field shows.

    A point lies at the mean distance of what its ray sees, if that stops half of the light, and has
    the colour that is seen. What lies behind the field's cube is left out.

    Args:
        module: A trained radiance field.
        views: Whose cameras are looked through, each at all times.
        times: When, in turn. [T]
        count: Number of points; there are fewer if the field is hardly seen.
        seed: Source of the pixels.

    Returns:
        The points, in the field's frame.
    """
    renderer, frame, field = module.renderer, module.frame, module.field
    assert isinstance(renderer, RayRenderer)
    assert frame is not None
    if isinstance(field, XPlanes):
        field.background = None
    device, black = renderer.device, torch.zeros(3, device=renderer.device)
    # As many of each time, and the last rounds for times at which little is seen.
    wanted = torch.full((len(times),), count // len(times))
    wanted[: count % len(times)] += 1
    parts: list[tuple[Tensor, Tensor, Tensor]] = []
    for step in range(ROUNDS):
        if not bool((wanted > 0).any()):
            break
        number = int(wanted.argmax())
        generator = step_generator(seed, step, Stream.SIGHT)
        chosen = torch.randint(len(views), (RAYS,), generator=generator)
        place = torch.rand(RAYS, 2, generator=generator) * views.intrinsics.size[chosen]
        rows, columns = place.floor().unbind(dim=1)
        rays = frame.rays(*views.pixel_rays(chosen, rows, columns))
        origins, directions = (ray.to(device) for ray in rays)
        seen = renderer.image(field, origins, directions, float(times[number]), black)
        points = origins + seen["depth"][:, None] * directions
        colours = seen["colour"] / seen["opacity"].clamp(min=1e-6)[:, None]
        inside = (seen["opacity"] >= OPAQUE) & (points.abs() <= 1).all(dim=1)
        found = inside.nonzero()[: int(wanted[number]), 0]
        wanted[number] -= len(found)
        part = points[found].cpu(), colours[found].clamp(0, 1).cpu()
        parts.append((*part, times[number].expand(len(found))))
    if not parts:
        return PointCloud(torch.empty(0, 3), torch.empty(0, 3), torch.empty(0))
    return PointCloud(*(torch.cat(part) for part in zip(*parts, strict=True)))
