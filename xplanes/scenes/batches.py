"""Stateless training batches: the seed, the step and the rank determine all randomness."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from xplanes.backend import memory_left
from xplanes.errors import ConfigError
from xplanes.scenes.cameras import turned
from xplanes.scenes.frame import Frame
from xplanes.scenes.importance import CANDIDATES, Tiles, preferred
from xplanes.scenes.pools import PixelPools, RunPools
from xplanes.scenes.silhouettes import changing, foreground, textureless
from xplanes.scenes.store import RUN, StoredImages
from xplanes.scenes.views import Views
from xplanes.settings import Count, Settings, Share
from xplanes.streams import Stream, counted_uniform, step_generator

Batch = dict[str, Any]
"""Tensors by name, one row per ray; whole views also have a ``camera``."""

NEAR_SILHOUETTE = 0.02
"""Margin around silhouettes that counts as near, as a share of the image's side."""

TEXTURELESS_SHARE = 0.2
"""Share of rays drawn at opaque pixels without texture around them."""

STATIC_SHARE = 0.5
"""Share of rays drawn at static pixels of fixed cameras."""

PER_RUN = 32
"""Rays from one run of consecutive pixels, for images in files."""

LEAST_RUNS = 32
"""Least number of runs per batch, if it has as many rays."""

LARGEST_SHARE = 0.25
"""Largest share of a GPU's free memory for images."""

AHEAD = 8
"""Number of batches whose pixels are prefetched from the disk."""

FEWEST_RAYS = 64
"""Fewest rays of a batch, unless per_batch is lower."""

CPU_RAYS, CPU_SAMPLES = 1365, 8192
"""Largest batch on the CPU with per_batch=auto; schedules in steps assume this size."""

SLOPES_OVER = 2
"""Spacing in pixels of the Sobel filter for image gradients; adjacent pixels are noisier."""

GPU_RAYS, GPU_SAMPLES = 2**15, 2**19
"""Largest batch on a GPU with per_batch=auto; small batches would leave it idle."""


class Batches(ABC):
    """Training batches as a function of (seed, step, rank).

    Attributes:
        views: Training views.
        rays: Number of rays per batch.
        skipped: Share of the rays that would go to other pixels with uniform sampling.
    """

    views: Views
    rays: int
    skipped: float

    def add_slopes(self) -> None:
        """Add the gradients for the refinement of cameras to each batch, see `RayBatches.slopes`.

        Raises:
            ConfigError: If these batches do not support it.
        """
        raise ConfigError(
            "data.refine_cameras=true: this model trains on whole views, but cameras are refined "
            "with rays; set it to false, or choose model=six_planes"
        )

    @abstractmethod
    def draw(self, step: int, rays: int | None = None, errors: Tensor | None = None) -> Batch:
        """The batch of a step.

        Args:
            step: Its number.
            rays: Number of rays to draw; the maximum when None.
            errors: Errors by tile, for importance sampling (`ErrorMap.errors`); None for none.
        """


@dataclass(frozen=True, kw_only=True)
class BatchSettings(Settings, ABC):
    """Base class of the settings of training batches; its defaults are those of whole views."""

    def on(self, device: torch.device) -> "BatchSettings":
        """The settings with each auto resolved for a device."""
        return self

    @property
    def matches_exposure(self) -> bool:
        """Whether a gain is learnt for each training camera, if images show surroundings."""
        return False

    @property
    def most_rays(self) -> int:
        """Maximum rays per batch; 0 if a batch is a whole view."""
        return 0

    @property
    def most_samples(self) -> int | None:
        """Maximum samples per batch, on average; None without samples along rays."""
        return None

    @abstractmethod
    def batches(self, views: Views, frame: Frame, *, seed: int, rank: int) -> Batches:
        """The batches of a process.

        Args:
            views: Training views.
            frame: The field's frame.
            seed: The run's seed.
            rank: Rank of the process among the processes that split the rays.
        """

    def fitting(self, rays: int, samples: int) -> int:
        """Number of rays in the next batch, given the rays and samples of the last one."""
        return rays


@dataclass(frozen=True, kw_only=True)
class RaySettings(BatchSettings):
    """Settings of ray batches."""

    # Maximum rays per batch. auto: 1365 on the CPU; 32768 on a GPU, where most schedules in steps
    # are shortened to 1/24.
    per_batch: Count | Literal["auto"]
    # Maximum samples per batch, on average; 64 rays may exceed it. auto: 8192 on the CPU, 524288 on
    # a GPU.
    samples_per_batch: Count | Literal["auto"]
    # Background colour. random: drawn per ray; one: drawn per batch.
    background: Literal["white", "random", "one"]
    skip_background: bool  # Sample more rays near silhouettes, on texture and where images change.
    background_share: Share  # Share of rays far from silhouettes.
    background_jitter: Share  # Maximum random time offset of these rays.
    # Share of rays that are drawn in proportion to the field's error in their image tile. Weights
    # in the losses of colour and opacity correct for this. For images in memory; 0: none.
    error_share: Share
    # Learn a gain per colour channel of each training camera, if the images show surroundings.
    match_exposure: bool

    def on(self, device: torch.device) -> "RaySettings":
        if device.type == "cpu":
            return self
        rays = GPU_RAYS if self.per_batch == "auto" else self.per_batch
        samples = GPU_SAMPLES if self.samples_per_batch == "auto" else self.samples_per_batch
        return replace(self, per_batch=rays, samples_per_batch=samples)

    @property
    def matches_exposure(self) -> bool:
        return self.match_exposure

    @property
    def most_rays(self) -> int:
        return CPU_RAYS if self.per_batch == "auto" else self.per_batch

    @property
    def most_samples(self) -> int:
        return CPU_SAMPLES if self.samples_per_batch == "auto" else self.samples_per_batch

    def batches(self, views: Views, frame: Frame, *, seed: int, rank: int) -> "RayBatches":
        return RayBatches(views, frame, self, seed=seed, rank=rank)

    def fitting(self, rays: int, samples: int) -> int:
        """Number of rays that keeps the number of samples near its maximum."""
        room = self.most_samples * rays / max(1, samples)
        return min(self.most_rays, max(FEWEST_RAYS, int(room)))


@dataclass(frozen=True, kw_only=True)
class ViewSettings(BatchSettings):
    """Whole training views, one per batch."""

    background: Literal["white", "one"]  # Background colour; one: drawn per batch.

    def batches(self, views: Views, frame: Frame, *, seed: int, rank: int) -> "ViewBatches":
        return ViewBatches(views, self, seed=seed, rank=rank)


class ViewBatches(Batches):
    """Draws whole training views in random order, all of them once before any is repeated.

    Args:
        views: Training views.
        settings: The settings, with the background colour.
        seed: The run's seed.
        rank: Rank of this process in a distributed run.
    """

    skipped = 0.0

    def __init__(self, views: Views, settings: ViewSettings, *, seed: int, rank: int = 0) -> None:
        self.views, self.seed, self.stream = views, seed, Stream.VIEWS + rank
        self.background = settings.background
        self.rays = max(1, views.pixels // len(views))

    def draw(self, step: int, rays: int | None = None, errors: Tensor | None = None) -> Batch:
        """The view of a step.

        Returns:
            Its ``camera``, and for each pixel, row by row: ``times`` [R], ``target`` colour on
            ``background`` [R, 3] each, and ``alpha`` [R]. If some pixels are not trained on, also
            ``shown``: whether each pixel is. bool [R]
        """
        turn, place = divmod(step, len(self.views))
        generator = step_generator(self.seed, turn, self.stream)
        index = int(torch.randperm(len(self.views), generator=generator)[place])
        background = torch.ones(3)
        if self.background == "one":
            generator = step_generator(self.seed, step, self.stream)
            background = torch.rand(3, generator=generator)
        alpha = self.views.image(index)[..., 3].flatten().float() / 255
        shown = self.views.shown(index)
        return {
            "camera": self.views.camera(index),
            "times": self.views.times[index].expand(len(alpha)),
            "target": self.views.composite(index, background).flatten(0, 1),
            "background": background.expand(len(alpha), 3),
            "alpha": alpha,
            **({} if shown is None else {"shown": shown.flatten()}),
        }


class RayBatches(Batches):
    """Draws training rays as a function of (seed, step, rank).

    With ``skip_background``, at most ``background_share`` of the rays go to pixels far from the
    silhouettes. These show only background, and a few rays suffice to prevent floaters. Far rays
    with alpha 0 get slightly earlier or later times: their space is assumed to be empty then, too.
    At most `TEXTURELESS_SHARE` go to opaque pixels without texture, such as those of a white floor.
    In opaque images of fixed cameras, changing pixels take the role of silhouettes: at most
    `STATIC_SHARE` of the rays go to static pixels, without changed times.

    From images in files, each batch takes up to `PER_RUN` pixels from each of a few runs of
    consecutive pixels, so that it reads from few places on the disk; pixels of a kind remain
    equally likely. Near and far are distinguished more coarsely there (`RunPools`).

    Args:
        views: Training views.
        frame: The field's frame, in which rays are returned.
        settings: The settings.
        seed: The run's seed.
        rank: Rank of this process among the processes that split the rays.

    Attributes:
        slopes: Whether batches have ``across``, the change of each ray's direction by one pixel to
            the right and down, [R, 2, 3], and ``slopes``, the change of the target colour per pixel
            in the same directions (Sobel filter), [R, 3, 2].
        tiles: Image tiles whose errors guide importance sampling; None without it.
    """

    slopes = False
    tiles: Tiles | None = None

    def __init__(
        self, views: Views, frame: Frame, settings: RaySettings, *, seed: int, rank: int = 0
    ) -> None:
        self.views, self.frame = views, frame
        self.rays, self.seed, self.rank = settings.most_rays, seed, rank
        self.background, self.error_share = settings.background, settings.error_share
        widths = views.intrinsics.size[:, 1].tolist()
        margins = [max(1, round(NEAR_SILHOUETTE * width)) for width in widths]
        changes = None
        if isinstance(views.images, StoredImages):
            self.pools = RunPools(views, views.images, margins)
        else:
            self.tiles = Tiles.of(views) if self.error_share else None
            if settings.skip_background and views.is_opaque:
                changes = changing(views, margins)  # Opaque images in files are sampled uniformly.
            skips_textureless = settings.skip_background and changes is None
            self.pools = PixelPools(
                foreground(views, margins) if changes is None else changes,
                textureless(views, margins) if skips_textureless else None,
                views.valid() if views.is_partial else None,
            )
        self.far_pixels, textureless_pixels, others = self.pools.sizes
        self._prefetched = -1
        self.near_pixels = textureless_pixels + others
        pixels = self.near_pixels + self.far_pixels
        uniform_far, uniform_textureless = self.far_pixels / pixels, textureless_pixels / pixels
        skip = settings.skip_background and self.near_pixels > 0
        share = settings.background_share if changes is None else STATIC_SHARE
        most_far, most_textureless = (share, TEXTURELESS_SHARE) if skip else (1.0, 1.0)
        self.far_share = min(most_far, uniform_far)
        textureless_share = min(most_textureless, uniform_textureless)
        jitter = skip and uniform_far > 0 and not views.is_static and changes is None
        self.background_jitter = settings.background_jitter if jitter else 0.0
        self.skipped = uniform_far + uniform_textureless - self.far_share - textureless_share
        self.pools.share(self.far_share, textureless_share)

    def add_slopes(self) -> None:
        if isinstance(self.views.images, StoredImages):
            raise ConfigError(
                "data.refine_cameras=true: the images are too large for memory, and cameras are "
                "refined with images in memory; set data.resolution to a smaller width"
            )
        self.slopes = True

    def draw(self, step: int, rays: int | None = None, errors: Tensor | None = None) -> Batch:
        """The batch of a step.

        Args:
            step: Its number.
            rays: Number of rays to draw; the maximum when None.
            errors: As in `Batches.draw`; unused without `tiles`.

        Returns:
            ``origins`` and unit ``directions`` in the field's frame [R, 3], ``times`` [R],
            ``target`` colour on ``background`` [R, 3] each, its ``alpha`` [R], ``jitter`` of the
            samples from 0 to 1 [R], and the index of its ``view``, int64 [R]. With `tiles`, also
            ``tile``, the number of each pixel's tile, int64 [R], and with ``errors`` the rays'
            ``weight`` in the loss [R]. `slopes` adds further entries.
        """
        rays = rays or self.rays
        errors = None if self.tiles is None else errors
        generator = step_generator(self.seed, step, self.rank)
        candidates = rays if errors is None else CANDIDATES * rays
        uniform = torch.rand(candidates, 3, generator=generator, dtype=torch.float64)
        if isinstance(self.views.images, StoredImages):
            self._prefetch(step, rays)
            drawn, more = self._from_files(self.views.images, uniform, generator), {}
        else:
            drawn, more = self._from_memory(self.views.images, uniform, rays, errors)
        background = torch.ones(rays, 3)
        if self.background != "white":
            count = 1 if self.background == "one" else rays
            background = torch.rand(count, 3, generator=generator).expand(rays, 3)
        move = torch.rand(rays, generator=generator) if self.background_jitter else None
        return more | self._batch_of(drawn, background, move, uniform[:rays, 2].float())

    def _batch_of(
        self, drawn: tuple[Tensor, ...], background: Tensor, move: Tensor | None, jitter: Tensor
    ) -> Batch:
        """The batch of drawn pixels on a background; ``move`` and ``jitter`` are from 0 to 1."""
        far, view, row, column, colour = drawn
        origins, directions = self.views.pixel_rays(view, row.float(), column.float())
        origins, directions = self.frame.rays(origins, directions)
        colour = colour.float() / 255
        times = self.views.times[view]
        if move is not None:
            jittered = (times + self.background_jitter * (2 * move - 1)).clamp(0, 1)
            times = torch.where(far & (colour[:, 3] == 0), jittered, times)
        more = self._slopes(directions, view, row, column, background) if self.slopes else {}
        return more | {
            "view": view,
            "origins": origins,
            "directions": directions,
            "times": times,
            "target": colour[:, :3] + (1 - colour[:, 3:]) * background,
            "background": background,
            "alpha": colour[:, 3],
            "jitter": jitter,
        }

    def _slopes(
        self, directions: Tensor, view: Tensor, row: Tensor, column: Tensor, background: Tensor
    ) -> Batch:
        """The entries that `slopes` adds to a batch of pixels with these ray directions."""
        places = (row, column + 1), (row + 1, column)
        rays = (self.views.pixel_rays(view, *(x.float() for x in place))[1] for place in places)
        across = torch.stack([turned(ray, self.frame.rotation) - directions for ray in rays], dim=1)
        images = self.views.images
        assert isinstance(images, Tensor)
        offsets = torch.arange(-SLOPES_OVER, SLOPES_OVER + 1, SLOPES_OVER, device=view.device)
        last = self.views.intrinsics.size[view] - 1
        rows = torch.minimum((row[:, None] + offsets).clamp(min=0), last[:, :1])
        columns = torch.minimum((column[:, None] + offsets).clamp(min=0), last[:, 1:])
        lines = (view[:, None] * images.shape[1] + rows) * images.shape[2]
        around = images.view(-1, 4)[lines[:, :, None] + columns[:, None]].float() / 255
        step = offsets / (2 * SLOPES_OVER**2)
        smooth = 0.5 - offsets.abs() / (4 * SLOPES_OVER)  # A quarter, a half and a quarter.
        kernels = torch.stack([torch.outer(smooth, step), torch.outer(step, smooth)])
        slopes = torch.einsum("rijc,kij->rck", around, kernels)
        # Images are stored premultiplied by alpha.
        slopes = slopes[:, :3] - background[..., None] * slopes[:, 3:]
        return {"across": across, "slopes": slopes}

    def _from_memory(
        self, images: Tensor, uniform: Tensor, rays: int, errors: Tensor | None
    ) -> tuple[tuple[Tensor, ...], Batch]:
        """Draw pixels independently, or choose them among more candidates by their tiles' errors.

        Returns:
            Whether each is far, view, row and column [R], colour [R, 4]; ``tile`` and ``weight``.
        """
        assert isinstance(self.pools, PixelPools)
        far, pixel = self.pools.pick(uniform[:, 0], uniform[:, 1])
        height, width = self.views.height, self.views.width
        place = pixel // (height * width), pixel // width % height, pixel % width
        more: Batch = {}
        if self.tiles is not None:
            more["tile"] = self.tiles.number(*place)
        if errors is not None:
            offset = uniform[-1, 2]  # The jitter of rays uses only the first of these numbers.
            candidates = errors.to(pixel.device)[more["tile"]]
            chosen, weight = preferred(candidates, self.error_share, rays, offset)
            more = {"tile": more["tile"][chosen], "weight": weight}
            far, pixel = far[chosen], pixel[chosen]
            place = tuple(each[chosen] for each in place)
        return (far, *place, images.view(-1, 4)[pixel]), more

    def _from_files(
        self, images: StoredImages, uniform: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, ...]:
        """Draw pixels from a few runs: whether each is far, its view, row, column and colour."""
        assert isinstance(self.pools, RunPools)
        number, per_run = len(uniform), _per_run(len(uniform))
        far, view, run = self.pools.pick(*uniform[::per_run, :2].T)
        inside = torch.rand(len(run), per_run, generator=generator, dtype=torch.float64)
        inside = self.pools.inside(far, view, run, inside)
        colour = images.pixels(view, run, inside).flatten(0, 1)
        pixel = (RUN * run[:, None] + inside).flatten()
        far, view = (each.repeat_interleave(per_run) for each in (far, view))
        width = self.views.intrinsics.size[view, 1]
        drawn = far, view, pixel // width, pixel % width, colour
        return tuple(each[:number] for each in drawn)  # The last run may be used only in part.

    def _prefetch(self, step: int, rays: int) -> None:
        """Prefetch the runs of the next batches, each once."""
        assert isinstance(self.views.images, StoredImages)
        assert isinstance(self.pools, RunPools)
        if not step <= self._prefetched <= step + AHEAD:
            self._prefetched = step
        for later in range(self._prefetched + 1, step + AHEAD + 1):
            generator = step_generator(self.seed, later, self.rank)
            uniform = torch.rand(rays, 3, generator=generator, dtype=torch.float64)
            _, view, run = self.pools.pick(*uniform[:: _per_run(rays), :2].T)
            self.views.images.prefetch(view, run)
        self._prefetched = step + AHEAD


class DeviceBatches(RayBatches):
    """Batches drawn on the GPU that holds the images: without transfers or synchronisation.

    As in `RayBatches` they are a function of (seed, step, rank), with the same distribution. The
    random numbers differ: each is computed from its index (`counted_uniform`), so that they are the
    same on every device.

    Args:
        batches: Batches of pinhole images in memory.
        device: Device of the images.
    """

    def __init__(self, batches: RayBatches, device: torch.device) -> None:
        vars(self).update(vars(batches))
        self.device = device
        self.views = batches.views.to(device)
        self.frame = batches.frame.to(device)
        assert isinstance(batches.pools, PixelPools)
        self.pools = batches.pools.to(device)

    @staticmethod
    def can_serve(batches: RayBatches, device: torch.device) -> bool:
        """Whether these batches can be drawn on a device, and their images fit its memory."""
        views = batches.views
        if device.type == "cpu" or views.is_stored or views.intrinsics.lenses is not None:
            return False
        return views.nbytes < LARGEST_SHARE * memory_left(device)

    def draw(self, step: int, rays: int | None = None, errors: Tensor | None = None) -> Batch:
        rays = rays or self.rays
        errors = None if self.tiles is None else errors
        shape = (rays if errors is None else CANDIDATES * rays, 7)
        uniform = counted_uniform(self.seed, step, self.rank, shape, self.device)
        assert isinstance(self.views.images, Tensor)
        drawn, more = self._from_memory(self.views.images, uniform, rays, errors)
        uniform = uniform[:rays]
        background = uniform[:, 3:6].float()
        if self.background == "one":
            background = background[:1].expand(rays, 3)
        elif self.background == "white":
            background = torch.ones_like(background)
        move = uniform[:, 6].float() if self.background_jitter else None
        return more | self._batch_of(drawn, background, move, uniform[:, 2].float())


def _per_run(rays: int) -> int:
    """Number of rays from one run of pixels, for a batch of ``rays``."""
    return max(1, min(PER_RUN, rays // LEAST_RUNS))
