"""Ray marching in equal steps through occupied cells, with updates of the occupancy grid."""

import math
import time
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, cast

import torch
from torch import Tensor, distributed, nn

from xplanes.backend import cpu_loops, in_group, warm_up
from xplanes.errors import ConfigError
from xplanes.fields.base import RadianceField
from xplanes.rendering.base import RayRenderer, Rendering
from xplanes.rendering.behind import behind
from xplanes.rendering.box import Field, ray_box, shade
from xplanes.rendering.compositing import composite, distortion, sample_weights
from xplanes.rendering.front_to_back import front_to_back
from xplanes.rendering.marching import Rays, march
from xplanes.rendering.occupancy import OccupancyGrid
from xplanes.rendering.pruning import carve, fill, keep_moving
from xplanes.rendering.sampler import VIEWS_PER_ROW, Sampler, SamplerSettings, Site
from xplanes.rendering.thinning import thinned
from xplanes.rendering.warming import render_one_ray
from xplanes.scenes.batches import Batch
from xplanes.settings import Count, Range, Share, Weight
from xplanes.streams import Stream, TrainingState, counted_uniform, step_generator

SPARE = 1.25
"""Memory slots for the samples of a batch, relative to their average number."""

SLOT_STEP = 1024
"""The number of slots is a multiple of this."""

FEWEST_SAMPLES, SAMPLES_PER_PIXEL = 128, 0.5
"""Minimum number of samples along the diagonal; samples per image pixel along the cube's side."""

BINS, MOST_BINS = 8, 16
"""Usual and maximum number of time bins of the grid with time_bins=auto."""

UNPRUNED = 0.9
"""Share of occupied cells above which empty space is searched for before rendering an image."""

HALF_EMPTY = 0.4
"""Share of occupied cells above which a field is too smooth for images to need many more samples
than training batches."""

DETAILED = 1.5
"""Largest number of samples of such images, relative to training batches, in scenes with
surroundings and many camera positions."""

SEARCHED_PER_RAY = 8
"""Largest number of cells per ray of an image that are searched for empty space."""

SPARSE_POINTS = 2048
"""Points at which the sparsity prior is evaluated."""

DIAGONAL = 2 * math.sqrt(3)
"""Length of the cube's diagonal."""

BEHIND = 0.5
"""Distance behind the cube at which the distortion loss places the background."""

BORDER = 8
"""Power of the distance from the cube's centre in the border loss; its faces are at 1."""


@dataclass(frozen=True)
class GridRendering(Rendering):
    """Rays rendered with an occupancy grid.

    Attributes:
        distortion: Result of `compositing.distortion`; None if not computed. []
        border: Mean over rays of the weights times ``max(|x|, |y|, |z|) ** BORDER``; None if not
            computed. []
    """

    distortion: Tensor | None
    border: Tensor | None


@dataclass(frozen=True)
class GridRenderer(RayRenderer):
    """Renders rays through a field, and skips samples in empty cells or behind surfaces.

    Attributes:
        grid: The occupancy grid.
        samples: Steps along the diagonal of the field's cube.
        skip_empty: Skip samples in empty cells.
        occlusion: Transmittance below which samples are skipped; 0 skips none. Estimated from the
            grid, except for images on the CPU, where it comes from the field.
        room: Number of memory slots for samples, see `march`.
        surrounded: Whether to compute the losses of scenes with surroundings.
        thinning: Subsample gradients below this times the mean, see `thinned`.
    """

    grid: OccupancyGrid
    samples: int
    skip_empty: bool = True
    occlusion: float = 0.001
    room: int | None = None
    surrounded: bool = False
    thinning: float = 0.0

    @property
    def device(self) -> torch.device:
        return self.grid.density.device

    @property
    def step(self) -> float:
        """Distance between samples in the field's frame."""
        return DIAGONAL / self.samples

    def render(
        self,
        field: Field,
        origins: Tensor,
        directions: Tensor,
        times: Tensor,
        background: Tensor,
        jitter: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> GridRendering:
        """Render rays.

        Args:
            field: Maps points and times to colour and density.
            origins: Ray origins in the field's frame. [R, 3]
            directions: Unit directions. [R, 3]
            times: Time of each ray, from 0 to 1. [R]
            background: Colour behind the scene. [3] or [R, 3]
            jitter: Offset of each ray's samples within their steps; the middle when None. [R]
            generator: Selects the samples that carry gradients, see `thinned`; all when None.

        Returns:
            One value per ray.
        """
        offset = torch.full_like(times, 0.5) if jitter is None else jitter
        samples = march(
            Rays(origins, directions, times, offset),
            self.grid,
            step=self.step,
            skip_empty=self.skip_empty,
            occlusion=self.occlusion,
            room=self.room,
        )

        def evaluate(chosen: Tensor | slice) -> tuple[Tensor, Tensor]:
            points, ray = samples.points[chosen], samples.ray[chosen]
            return shade(field, points, times, directions, ray)

        if generator is None:
            colour, density = evaluate(slice(None))
        else:
            wanted = [p for p in cast("nn.Module", field).parameters() if p.requires_grad]
            colour, density = thinned(evaluate, wanted, self.thinning, generator)
        if samples.live is not None:
            density = torch.where(samples.live, density, 0)
        total, _ = composite(
            density * self.step,
            colour,
            samples.distances,
            samples.ray,
            samples.starts,
            samples.number,
        )
        background = behind(field, origins, directions, total[:, 3], background, jitter)
        if samples.shown is not None:
            # A ray without slots shows only the background, which must not learn from it.
            background = torch.where(samples.shown[:, None], background, background.detach())
        colour, opacity, depth = _pixels(total, background)
        spread = border = None
        if self.surrounded:
            ends = ray_box(origins, directions)[1] + BEHIND
            weights = sample_weights(density * self.step, samples.ray, samples.starts)
            along = samples.distances, samples.ray, samples.starts, total
            spread = distortion(weights, *along, ends, self.step)
            outwards = samples.points.detach().abs().amax(dim=1).pow(BORDER)
            border = (weights * outwards).sum() / max(1, len(times))
        seen = colour, opacity, depth.detach(), density.detach(), samples
        return GridRendering(*seen, distortion=spread, border=border)

    def pixels(
        self, field: Any, origins: Tensor, directions: Tensor, times: Tensor, background: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """As `render`, without gradients; on the CPU with early ray termination."""
        if not cpu_loops(origins):
            return super().pixels(field, origins, directions, times, background)
        rays = Rays(origins, directions, times, torch.full_like(times, 0.5))
        samples = march(rays, self.grid, step=self.step, skip_empty=self.skip_empty)
        total = front_to_back(
            field, samples, times, directions, step=self.step, occlusion=self.occlusion
        )
        background = behind(field, origins, directions, total[:, 3], background)
        return _pixels(total, background)

    def for_image(self, field: Any, time: float, rays: int) -> "GridRenderer":
        """As `RayRenderer.for_image`; finds empty space first if nothing is pruned yet.

        The grid is not changed: emptying cells this early would harm training.
        """
        worthwhile = self.skip_empty and self.grid.resolution**3 <= SEARCHED_PER_RAY * rays
        if not worthwhile or self.grid.occupied_fraction <= UNPRUNED:
            return self
        grid = self.grid.at(time)

        def now(points: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
            return field(points, torch.full_like(times, time))

        grid.sweep(now, torch.Generator().manual_seed(0))
        return replace(self, grid=grid)


def _pixels(total: Tensor, background: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Colour, opacity and depth from a ray's sums and its background. [R, 5], [R, 3]"""
    opacity = total[:, 3]
    colour = total[:, :3] + (1 - opacity)[:, None] * background
    return colour, opacity, total[:, 4] / opacity.clamp_min(1e-6)


Fraction = Annotated[float, Range(0, 1, open=True)]


@dataclass(frozen=True, kw_only=True)
class OccupancySettings(SamplerSettings):
    """Equal steps along rays; samples that cannot contribute are skipped."""

    # Samples along the diagonal of the cube in training. auto: half the number of image pixels
    # along its side, from 128 to 256; 128 in scenes with surroundings.
    samples: Count | Literal["auto"]
    # Samples along the diagonal in evaluation and videos. No more than in training while over 40%
    # of the cells are occupied; up to 1.5 times as many between 40% and 90% in scenes with
    # surroundings and at least 50 camera positions.
    render_samples: Count
    grid_resolution: Count  # Cells of the occupancy grid along each side.
    # Bins of the occupancy grid along time. auto: one per timestep, from 8 to 16, if there are four
    # or more views per timestep, else 8.
    time_bins: Count | Literal["auto"]
    threshold: Fraction  # Opacity per step below which a cell is empty.
    # Replaces `model.sampler.threshold` if a background is learnt.
    threshold_with_background: Fraction
    decay: Share  # Decay of a cell's density at each update.
    # Replaces `model.sampler.decay` if a background is learnt. In a cell with a thin part, most
    # observations miss that part.
    decay_with_background: Share
    skip_empty: bool  # Skip samples in empty cells.
    skip_occluded: bool  # Skip samples behind opaque surfaces.
    occlusion: Annotated[float, Range(0, 1)]  # Transmittance below which samples are occluded.
    thinning: Weight  # Subsample gradients below this times the mean, on the CPU; 0: off.
    # Prune cells outside the silhouettes (alpha). In opaque images, keep the cells in which every
    # fixed camera that sees them shows a change.
    silhouettes: bool
    fill: bool  # Prune empty cells of an initialised field.
    # Weight of the mean opacity per step of random points in occupied cells. It empties space that
    # no training ray sees, such as that below a ground plate. 0 if a background is learnt, which
    # would otherwise take over the emptied content.
    sparsity: Weight
    # Weight of the distortion loss (Mip-NeRF 360), which turns fog into surfaces. 0 unless a
    # background is learnt.
    distortion: Weight
    # Weight of the opacity near the cube's faces, which leaves to the background what few cameras
    # see there. 0 unless a background is learnt.
    border: Weight
    # Steps at which all occupied cells are updated. Only the last one if a background is learnt,
    # which would take over the content of cells that are emptied too early.
    sweep_at: list[int]
    sweep_every: Count  # Steps between updates of all occupied cells afterwards.
    # On the CPU, half as many samples along rays before the first of these updates: all cells may
    # be occupied until then.
    coarse_first: bool
    update_every: Count  # Steps between updates of random cells.
    update_cells: Count  # Maximum number of cells per update.

    def check(self) -> None:
        if self.occlusion >= 1:
            raise ConfigError(
                f"occlusion={self.occlusion}: must be below 1, or all samples are skipped; 0.001 "
                "is the default, skip_occluded=false skips none"
            )
        bins = MOST_BINS if self.time_bins == "auto" else self.time_bins
        if self.grid_resolution**3 * bins > 2**28:
            raise ConfigError(
                f"grid_resolution={self.grid_resolution} with time_bins={bins}: more "
                "than 268 million cells; lower one of them"
            )

    def bins(self, times: Tensor) -> int:
        """Bins of the grid along time.

        Args:
            times: Times of the training views. [V]
        """
        distinct = len(times.unique())
        if distinct == 1:
            return 1
        if self.time_bins != "auto":
            return self.time_bins
        determined = len(times) >= VIEWS_PER_ROW * distinct
        return min(max(distinct, BINS), MOST_BINS) if determined else BINS

    def build(self, field: RadianceField, site: Site) -> "OccupancySampler":
        constant = getattr(field, "background", None) is None
        along = self.samples
        if along == "auto":
            least, most = FEWEST_SAMPLES, 2 * FEWEST_SAMPLES if constant else FEWEST_SAMPLES
            along = min(max(round(SAMPLES_PER_PIXEL * site.pixels), least), most)
        grid = OccupancyGrid(
            self.grid_resolution,
            self.bins(site.times),
            step=DIAGONAL / along,
            threshold=self.threshold if constant else self.threshold_with_background,
            decay=self.decay if constant else self.decay_with_background,
        )
        renderer = GridRenderer(
            grid,
            along,
            skip_empty=self.skip_empty,
            occlusion=self.occlusion if self.skip_occluded else 0.0,
        )
        fill_seconds = 0.0
        if site.views is not None:
            if self.silhouettes:
                carve(grid, site.views, site.frame, exact=site.cameras is None)
                keep_moving(grid, site.views, site.frame)
            if site.initialised and self.fill:
                fill_seconds = _fill(renderer, field, site)
        settings = (
            self.with_constant_background(site) if constant else self.with_learnt_background()
        )
        detailed = not constant and site.is_seen_from_many
        filled = round(DETAILED * along) if detailed else along
        return OccupancySampler(renderer, settings, site.samples_per_batch, fill_seconds, filled)

    def with_constant_background(self, site: Site) -> "OccupancySettings":
        """Settings for a constant background: scaled sweeps, no losses against fog.

        Updates of random cells are not scaled, because large batches reach more cells anyway.
        """
        return replace(
            self,
            sweep_at=[site.steps(step) for step in self.sweep_at],
            sweep_every=site.steps(self.sweep_every),
            distortion=0.0,
            border=0.0,
        )

    def with_learnt_background(self) -> "OccupancySettings":
        """Settings for a learnt background: no early emptying of cells and no sparsity prior."""
        return replace(self, sweep_at=self.sweep_at[-1:], sparsity=0.0)

    def for_video(self) -> "OccupancySettings":
        samples = FEWEST_SAMPLES if self.samples == "auto" else self.samples
        return replace(self, samples=samples, render_samples=samples)


def _fill(renderer: GridRenderer, field: RadianceField, site: Site) -> float:
    """Fill the grid of an initialised field on its training device.

    Returns:
        Duration in seconds, warm-up excluded.
    """
    assert site.views is not None
    began = time.perf_counter() - warm_up.seconds
    parts = field, renderer.grid
    for part in parts:
        part.to(site.device or "cpu")
    render_one_ray(field, renderer)
    generator = step_generator(site.seed, 0, Stream.FILL)
    fill(renderer.grid, field, site.views, site.frame, step=renderer.step, generator=generator)
    for part in parts:
        part.to("cpu")
    return time.perf_counter() - warm_up.seconds - began


class OccupancySampler(Sampler):
    """Equal steps through occupied cells; also updates the grid.

    Args:
        renderer: Its grid is changed in place.
        settings: Settings of the updates.
        most_samples: Maximum average number of samples per batch; None if unknown.
        fill_seconds: Seconds spent on filling the grid of an initialised field.
        filled_samples: Samples along the diagonal for images of a field that fills much of the
            cube; as many as in training when None.
    """

    def __init__(
        self,
        renderer: GridRenderer,
        settings: OccupancySettings,
        most_samples: int | None = None,
        fill_seconds: float = 0.0,
        filled_samples: int | None = None,
    ) -> None:
        self.settings, self.grid, self.most_samples = settings, renderer.grid, most_samples
        self.fill_seconds, self._filled_samples = fill_seconds, filled_samples or renderer.samples
        surrounded = max(settings.distortion, settings.border) > 0
        self._training_renderer = replace(
            renderer, surrounded=surrounded, thinning=settings.thinning
        )
        self._image_renderer = replace(renderer, samples=settings.render_samples)
        self.expect(math.inf)

    @property
    def renderer(self) -> GridRenderer:
        renderer, least = self._image_renderer, self._training_renderer.samples
        occupied = self.grid.occupied_fraction
        most = least if occupied > UNPRUNED else self._filled_samples
        if renderer.samples > most and occupied > HALF_EMPTY:
            return replace(renderer, samples=most)
        return renderer

    @property
    def modules(self) -> dict[str, nn.Module]:
        return {"grid": self.grid}

    @property
    def outline(self) -> str:
        return f"{100 * self.grid.occupied_fraction:.0f}% of the cube may be occupied"

    @property
    def pruned_at(self) -> int:
        settings = self.settings
        return min([*settings.sweep_at, settings.sweep_every]) if settings.skip_empty else 0

    def first_rays(self, most: int) -> int:
        return min(most, 256)

    def render(self, field: Any, rays: Batch, state: TrainingState) -> Rendering:
        renderer = self._training_renderer
        # On a GPU, the number of slots would not adapt when the number of samples doubles.
        on_cpu = self.device.type == "cpu"
        if on_cpu and self.settings.coarse_first and state.step < self.pruned_at:
            renderer = replace(renderer, samples=max(1, renderer.samples // 2))
        # On other devices the selection costs more than it saves.
        thins = self.settings.thinning > 0 and on_cpu
        thins = thins and torch.is_grad_enabled() and isinstance(field, nn.Module)
        return renderer.render(
            field,
            rays["origins"],
            rays["directions"],
            rays["times"],
            rays["background"],
            rays["jitter"],
            state.generator(self.device, Stream.THINNING) if thins else None,
        )

    def losses(self, rendering: GridRendering) -> dict[str, Tensor]:
        if rendering.distortion is None or rendering.border is None:
            return {}
        terms = {}
        if weight := self.settings.distortion:
            terms["distortion"] = weight * rendering.distortion
        if weight := self.settings.border:
            terms["border"] = weight * rendering.border
        return terms

    def observe(self, rendering: Rendering) -> None:
        samples = rendering.samples
        self.grid.observe(samples.cells, rendering.density, samples.live)

    def regularise(self, field: Any, state: TrainingState) -> None:
        settings = self.settings
        if not settings.sparsity or state.step % settings.update_every:
            return
        parameters = [p for p in field.parameters() if p.requires_grad]
        with torch.enable_grad():
            loss = self._sparsity(field, state, settings.update_every)
        gradients = torch.autograd.grad(loss, parameters, allow_unused=True)
        for parameter, gradient in zip(parameters, gradients, strict=True):
            if gradient is None:
                continue
            if in_group():
                distributed.all_reduce(gradient)  # Each process has its own points.
                gradient /= distributed.get_world_size()
            if parameter.grad is None:
                parameter.grad = gradient
            else:
                parameter.grad += gradient

    @torch.no_grad()
    def regularisers(self, field: Any, state: TrainingState) -> dict[str, float]:
        return {"sparsity": float(self._sparsity(field, state))} if self.settings.sparsity else {}

    def _sparsity(self, field: Any, state: TrainingState, steps: int = 1) -> Tensor:
        """Mean opacity of random points in occupied cells, weighted for a number of steps. []"""
        stream, device = Stream.SPARSITY + state.rank, self.device
        uniform = counted_uniform(state.seed, state.step, stream, (SPARSE_POINTS, 5), device)
        points, times = self.grid.occupied_points(uniform.float())
        density = field(points, times)[1]
        opacity = -torch.expm1(-self._training_renderer.step * density)
        # Computed even if no cell is occupied: other processes wait for the gradients.
        return steps * self.settings.sparsity / SPARSE_POINTS * opacity.sum()

    @property
    def device(self) -> torch.device:
        """Device of the grid."""
        return self.grid.density.device

    def update(self, field: Any, state: TrainingState) -> None:
        step, settings = state.step, self.settings
        sweeping = step in settings.sweep_at or (step > 0 and step % settings.sweep_every == 0)
        if not sweeping and step % settings.update_every:
            return
        self._agree()
        generator = step_generator(state.seed, step, Stream.GRID)
        if sweeping:
            self.grid.sweep(field, generator)
        elif self.device.type != "cpu":
            shape = (settings.update_cells, 8)
            uniform = counted_uniform(state.seed, step, Stream.GRID, shape, self.device)
            self.grid.update_by(field, uniform)
        else:
            self.grid.update(field, settings.update_cells, generator)

    def _agree(self) -> None:
        """Copy the first process's grid to all, since each has observed only its own samples."""
        if in_group():
            for part in (self.grid.density, self.grid.least, self.grid.occupied):
                distributed.broadcast(part, src=0)

    def expect(self, samples: float) -> None:
        if self.most_samples is None:
            return
        # Some batches have more than the average, and at least one ray must fit; few different
        # sizes allow memory to be reused.
        training = self._training_renderer
        slots = max(SPARE * min(samples, self.most_samples), 2 * training.samples)
        room = SLOT_STEP * math.ceil(slots / SLOT_STEP)
        self._training_renderer = replace(training, room=room)

    def scalars(self) -> dict[str, float]:
        return {"sampler/occupied": self.grid.occupied_fraction}
