"""Initial points of Gaussians, from a briefly trained X-Planes field."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, cast

import torch
from torch import Tensor

from xplanes.baselines.gaussians.field import PointCloud, neighbour_distance
from xplanes.baselines.gaussians.model import GaussiansSettings, InitialPoints
from xplanes.config import CONF, compose_plain
from xplanes.errors import ConfigError
from xplanes.fields.xplanes import XPlanes
from xplanes.models.initialisation import (
    NO_TIME,
    Initialisation,
    Initialiser,
    InitialiserSettings,
    Method,
    Place,
)
from xplanes.preparation.fixed_view import intrinsics_key, trained_field
from xplanes.preparation.sources import cache_of
from xplanes.rendering.base import RayRenderer
from xplanes.scenes.frame import frame_content
from xplanes.scenes.views import Views
from xplanes.settings import Count, Positive
from xplanes.streams import Stream, step_generator
from xplanes.training.module import RadianceModule

RAYS = 8192
"""Rays per round."""

ROUNDS = 40
"""Most rounds of rays."""

OPAQUE = 0.5
"""Least opacity of rays with a surface, and initial opacity of the Gaussians on it."""

CANDIDATES = 2
"""Candidates per point; those with the highest density are kept."""

WIDEST = 1.5
"""Largest scale of a Gaussian relative to the median, since isolated points would be large."""


@dataclass(frozen=True, kw_only=True)
class FieldSettings(InitialiserSettings):
    """Initial points for Gaussians, on the surfaces of a briefly trained X-Planes field."""

    gives: ClassVar = "points"

    model: Literal["six_planes", "nine_planes"]  # Model of the field.
    source: str  # Initialisation of the field: a file of conf/lrm; none: random.
    steps: Count  # Maximum number of training steps of the field.
    seconds: Positive | None  # Maximum training time of the field in seconds; null: no limit.

    def check(self) -> None:
        sources = sorted(path.stem for path in (CONF / "lrm").glob("*.yaml"))
        for other in ("field", "file"):  # They are no LRMs.
            sources.remove(other)
        if self.source not in sources:
            raise ConfigError(f"source={self.source}: must be one of {', '.join(sources)}")

    def load(self, say: Callable[[str], None] = print) -> "FieldInitialiser":
        overrides = [f"model={self.model}", f"lrm={self.source}"]
        method = Method.read(compose_plain("train", overrides))
        source = method.lrm.load(say)  # Missing weights are reported now.
        return FieldInitialiser(self, method, "" if source is None else source.key)


class FieldInitialiser(Initialiser):
    """Trains a field, and takes points on its surfaces as seen by the training cameras.

    Args:
        settings: The settings, with the budget.
        field: Model and training method of the field.
        key: Hash of the weights from which the field is initialised; empty for none.
    """

    def __init__(self, settings: FieldSettings, field: Method, key: str) -> None:
        self.settings, self.field, self.key = settings, field, key

    def initialise(self, method: Method, place: Place) -> Initialisation:
        settings, scene = self.settings, place.scene
        views = scene.splits["train"]
        count = cast(GaussiansSettings, method.model).count
        field = replace(
            self.field,
            seed=method.seed,
            preparation=method.preparation,
            decomposition=method.decomposition,
        )
        cache = cache_of(method, place)
        inputs = [
            views.identity,
            views.camera_to_world,
            views.times,
            views.ignored,
            intrinsics_key(views.intrinsics),
            frame_content(place.frame),
            field.plain(),
            self.key,
            [None if more is None else more.identity for more in (scene.lrm_views, scene.video)],
            [settings.steps, settings.seconds, count],
        ]

        def make() -> dict[str, Any]:
            place.say(f"points: training {settings.model} for {self._budget}")
            with cache.workshop("points", inputs) as folder:
                module = trained_field(
                    field,
                    place,
                    folder,
                    steps=settings.steps,
                    seconds=settings.seconds,
                    advice=f"It belongs to {settings.model}, trained for initial points: "
                    "set lrm.model to another model, or lrm=none",
                )
                found = surface_points(module, views, count, seed=method.seed)
            if not len(found.points):
                raise ConfigError(
                    f"lrm.steps={settings.steps}: {settings.model} has no surfaces for points "
                    "yet; raise lrm.steps, or set lrm=none"
                )
            assert module.frame is not None
            points = place.frame.points(module.frame.to_world(found.points))
            return {"points": points, "colours": found.colours, "times": found.times}

        stage = cache.stage("points", inputs, make, alone=True)
        scales = neighbour_distance(stage.content["points"])
        cloud = PointCloud(
            **stage.content,
            scales=scales.clamp(max=WIDEST * float(scales.median())),
            opacity=OPAQUE,
        )
        return Initialisation(
            model=method.model,
            frame=place.frame,
            values=InitialPoints(cloud=cloud),
            seconds=NO_TIME | {"field": stage.seconds},
            description=f"{len(cloud.points):,} points on the surfaces of {settings.model}, "
            f"trained for {self._budget}",
        )

    @property
    def _budget(self) -> str:
        steps, seconds = self.settings.steps, self.settings.seconds
        return f"{steps} steps" if seconds is None else f"up to {steps} steps or {seconds:g} s"


@torch.no_grad()
def surface_points(module: RadianceModule, views: Views, count: int, *, seed: int) -> PointCloud:
    """Points on a field's surfaces, from its expected depth along random rays of the views.

    Rays with an opacity below 0.5 are dropped. Points have the rendered colours. Of twice as many
    candidates the half with the highest density is kept, since expected depths may lie in empty
    space between two surfaces. The background outside of the field's cube is ignored.

    Args:
        module: A trained radiance field; its background is removed.
        views: Views through whose cameras rays are drawn.
        count: Number of points; fewer if too few rays have a surface.
        seed: Seed of the rays.

    Returns:
        The points, in the field's frame, with their times.
    """
    renderer, frame, field = module.renderer, module.frame, module.field
    assert isinstance(renderer, RayRenderer)
    assert isinstance(field, XPlanes)
    assert frame is not None
    field.background = None
    device, black = renderer.device, torch.zeros(3, device=renderer.device)
    parts: list[tuple[Tensor, ...]] = []
    for step in range(ROUNDS):
        if sum(len(part[0]) for part in parts) >= CANDIDATES * count:
            break
        generator = step_generator(seed, step, Stream.SIGHT)
        chosen = torch.randint(len(views), (RAYS,), generator=generator)
        place = torch.rand(RAYS, 2, generator=generator) * views.intrinsics.size[chosen] - 0.5
        rays = frame.rays(*views.pixel_rays(chosen, *place.unbind(dim=1)))
        origins, directions = (ray.to(device) for ray in rays)
        times = views.times[chosen].to(device)
        seen = renderer.render(field, origins, directions, times, black)
        points = origins + seen.depth[:, None] * directions
        found = ((seen.opacity >= OPAQUE) & (points.abs() <= 1).all(dim=1)).nonzero()[:, 0]
        colours = seen.colour[found] / seen.opacity[found, None]
        parts.append((points[found], colours.clamp(0, 1), times[found]))
    points, colours, times = (torch.cat(part).float() for part in zip(*parts, strict=True))
    density = field(points, times)[1]
    dense = density.topk(min(count, len(points) // CANDIDATES)).indices
    return PointCloud(points[dense].cpu(), colours[dense].cpu(), times[dense].cpu())
