"""Fixed-step sampling in a field's box; only samples with enough weight get a colour."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any

import torch
from torch import Tensor

from xplanes.baselines.bounds import check_range
from xplanes.baselines.stateless import StatelessSampler
from xplanes.errors import ConfigError
from xplanes.fields.base import RadianceField
from xplanes.rendering.base import RayRenderer, Rendering
from xplanes.rendering.behind import behind
from xplanes.rendering.compositing import composite
from xplanes.rendering.marching import Samples
from xplanes.rendering.sampler import SamplerSettings, Site
from xplanes.settings import Positive, Range, Weight


@dataclass(frozen=True)
class FixedStepRendering(Rendering):
    """A rendering with the colours of individual samples.

    Attributes:
        colours: Colour of each sample that has one. [M, 3]
        weights: Compositing weight of each of these samples, without gradient. [M]
        ray: Ray of each of these samples. [M]
    """

    colours: Tensor
    weights: Tensor
    ray: Tensor


class FixedStepRenderer(RayRenderer):
    """Places samples at equal distances along a ray, from where it enters the field's box.

    They are not jittered. Those with an opacity or weight up to a threshold are dropped and get no
    colour.

    Args:
        field: Field with ``bounds``, ``cell``, ``geometry`` and ``colour``.
        near: Least distance of samples from the ray's origin, in the field's frame.
        far: Largest distance of samples.
        step: Distance between samples, in cells.
        threshold: Opacity and weight up to which a sample is dropped.

    Source: TiNeuVox, released code; DirectVoxGO.
    """

    rays_at_once = 2048

    def __init__(
        self, field: Any, *, near: float, far: float, step: float, threshold: float
    ) -> None:
        self.field, self.near, self.far = field, near, far
        self.step, self.threshold = step, threshold

    @property
    def device(self) -> torch.device:
        return self.field.grid.device

    def render(
        self,
        field: Any,
        origins: Tensor,
        directions: Tensor,
        times: Tensor,
        background: Tensor,
        jitter: Any = None,
    ) -> FixedStepRendering:
        step = self.step * field.cell
        box = field.bounds()
        samples = self.place(origins, directions, box, step)
        density, features = field.geometry(samples.points, times[samples.ray])
        depth = density * step
        with torch.no_grad():
            # Weights are computed without the samples whose opacity is below the threshold.
            clear = -torch.expm1(-depth) <= self.threshold
            depth_kept = torch.where(clear, 0, depth)
            nothing = torch.zeros_like(samples.points)
            rays = samples.distances, samples.ray, samples.starts
            seen = (composite(depth_kept, nothing, *rays)[1] > self.threshold).nonzero()[:, 0]
        ray = samples.ray[seen]
        colours = field.colour(features[seen], directions[ray])
        colour = nothing.to(colours.dtype).index_put((seen,), colours)
        total, weights = composite(torch.where(clear, 0, depth), colour, *rays)
        opacity = total[:, 3]
        ends = partial(self.ends, box=box)
        background = behind(field, origins, directions, opacity, background, ends=ends)
        return FixedStepRendering(
            colour=total[:, :3] + (1 - opacity)[:, None] * background,
            opacity=opacity,
            depth=(total[:, 4] / opacity.clamp_min(1e-6)).detach(),
            density=density.detach(),
            samples=samples,
            colours=colours,
            weights=weights[seen],
            ray=ray,
        )

    def reaches(self, points: Tensor) -> Tensor:
        low, high = self.field.bounds()
        return ((points >= low) & (points <= high)).all(dim=1)

    def ends(self, origins: Tensor, directions: Tensor, box: Tensor) -> tuple[Tensor, Tensor]:
        """Distances at which rays enter and leave a box, in [near, far]. [R, 3] -> [R], [R]"""
        slopes = torch.where(directions == 0, 1e-6, directions)
        first, second = (box[0] - origins) / slopes, (box[1] - origins) / slopes
        enter = torch.minimum(first, second).amax(dim=1).clamp(self.near, self.far)
        leave = torch.maximum(first, second).amin(dim=1).clamp(self.near, self.far)
        return enter, leave

    @torch.no_grad()
    def place(self, origins: Tensor, directions: Tensor, box: Tensor, step: float) -> Samples:
        """All samples of rays in the box and between near and far.

        Args:
            origins: [R, 3]
            directions: Unit directions. [R, 3]
            box: Least and largest corner. [2, 3]
            step: Distance between samples.
        """
        enter, leave = self.ends(origins, directions, box)
        count = ((leave - enter) / step).ceil().long().clamp_min(1)
        number = torch.arange(int(count.max()) if len(count) else 0, device=count.device)
        distances = enter[:, None] + number * step
        points = origins[:, None] + distances[..., None] * directions[:, None]
        inside = ((points >= box[0]) & (points <= box[1])).all(dim=-1)
        inside &= number < count[:, None]
        ray, place = inside.nonzero(as_tuple=True)
        each = inside.sum(dim=1)
        return Samples(
            ray=ray,
            starts=each.cumsum(0) - each,
            points=points[ray, place],
            distances=distances[ray, place],
            cells=ray.new_empty(0),
            candidates=len(ray),
            empty=0,
            occluded=0,
        )


@dataclass(frozen=True, kw_only=True)
class FixedStepSettings(SamplerSettings):
    """Equal steps through a field's bounding box; negligible samples are dropped."""

    near: Weight  # Near bound in world units.
    far: Positive  # Far bound in world units.
    step: Positive  # Distance between samples, in cells.
    # Opacity, and weight, up to which samples are dropped.
    threshold: Annotated[float, Range(0, 1, open=True)]

    def check(self) -> None:
        if self.near >= self.far:
            raise ConfigError(f"near={self.near}: must be below far={self.far}")

    def require(self, field: RadianceField | type[RadianceField]) -> None:
        if not hasattr(field, "cell"):
            raise ConfigError(
                f"model.sampler.name={self.name}: needs a feature grid, as TiNeuVox has; set "
                "model/sampler=occupancy or proposal"
            )

    def holds(self, near: float, far: float) -> bool:
        return self.near <= near and far <= self.far

    def bounded(self, near: float, far: float) -> "FixedStepSettings":
        return replace(self, near=near, far=far)

    def build(self, field: RadianceField, site: Site) -> StatelessSampler:
        self.require(field)
        check_range(site, self.near, self.far)
        renderer = FixedStepRenderer(
            field,
            near=self.near * site.frame.scale,
            far=self.far * site.frame.scale,
            step=self.step,
            threshold=self.threshold,
        )
        outline = f"samples {self.step:g} cells apart throughout the field's box"
        return StatelessSampler(renderer, outline)
