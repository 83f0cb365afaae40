"""Stateless ray batches: the step alone determines their content."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from xplanes.backend import memory_left
from xplanes.scenes.frame import Frame
from xplanes.scenes.pools import PixelPools, RunPools
from xplanes.scenes.silhouettes import changing, foreground, plain
from xplanes.scenes.store import RUN, StoredImages
from xplanes.scenes.views import Views
from xplanes.settings import Count, Settings, Share
from xplanes.streams import Stream, counted_uniform, step_generator

Batch = dict[str, Any]
"""Tensors by name, one row for each ray; whole views have a ``camera`` besides."""

NEAR_SILHOUETTE = 0.02
"""Share of the image's side around silhouettes that counts as near."""

PLAIN_SHARE = 0.2
"""Share of rays at opaque pixels whose surroundings have the same colour."""

STILL_SHARE = 0.5
"""Share of rays at pixels of fixed cameras where nothing changes."""

PER_RUN = 32
"""Rays from one run of pixels, of images in files."""

LEAST_RUNS = 32
"""Runs of a batch at least, if it has as many rays."""

LARGEST_SHARE = 0.25
"""Share of a GPU's free memory that images may take."""

AHEAD = 8
"""Batches whose pixels the system is asked to read ahead."""

CPU_RAYS, CPU_SAMPLES = 1365, 8192
"""Largest batch on the CPU under per_batch=auto, for which schedules in steps are made."""

GPU_RAYS, GPU_SAMPLES = 2**15, 2**19
"""The same on a GPU, which small batches leave idle."""


class Batches(ABC):
    """Training batches as a function of (seed, step, rank).

    Attributes:
        views: Training views.
        rays: Rays of a batch.
        skipped: Share of rays that uniform sampling would have drawn and this one does not.
    """

    views: Views
    rays: int
    skipped: float

    @abstractmethod
    def draw(self, step: int, rays: int | None = None) -> Batch:
        """The batch of a step.

        Args:
            step: Its number.
            rays: Rays to draw; as many as there may be when None.
        """


@dataclass(frozen=True, kw_only=True)
class BatchSettings(Settings, ABC):
    """What a training step is given."""

    def on(self, device: torch.device) -> "BatchSettings":
        """The same settings with each auto replaced by what suits a device."""
        return self

    @property
    @abstractmethod
    def most(self) -> int:
        """Maximum rays per batch; 0 if a batch is a whole view."""

    @property
    @abstractmethod
    def most_samples(self) -> int | None:
        """Maximum samples per batch, on average; None without samples along rays."""

    @abstractmethod
    def batches(self, views: Views, frame: Frame, *, seed: int, rank: int) -> Batches:
        """The batches of a process.

        Args:
            views: Training views.
            frame: The field's frame.
            seed: The run's seed.
            rank: Number of the process among those that split the rays.
        """

    @abstractmethod
    def fitting(self, rays: int, samples: int) -> int:
        """Rays of the next batch, given the rays and samples of the last one."""


@dataclass(frozen=True, kw_only=True)
class RaySettings(BatchSettings):
    """Which rays a training step gets."""

    # Maximum rays per batch. auto: 1365 on the CPU; 32768 on a GPU, with the schedules of X-Planes
    # and of the occupancy grid shortened to 1/24.
    per_batch: Count | Literal["auto"]
    # Maximum samples per batch, on average. auto: 8192 on the CPU, 524288 on a GPU.
    samples_per_batch: Count | Literal["auto"]
    # Background colour. random: drawn per ray; one: drawn per batch.
    background: Literal["white", "random", "one"]
    skip_background: bool  # Sample more rays near silhouettes, on texture and where images change.
    background_share: Share  # Share of rays far from silhouettes.
    background_jitter: Share  # Maximum random time offset of these rays.

    def on(self, device: torch.device) -> "RaySettings":
        if device.type == "cpu":
            return self
        rays = GPU_RAYS if self.per_batch == "auto" else self.per_batch
        samples = GPU_SAMPLES if self.samples_per_batch == "auto" else self.samples_per_batch
        return replace(self, per_batch=rays, samples_per_batch=samples)

    @property
    def most(self) -> int:
        return CPU_RAYS if self.per_batch == "auto" else self.per_batch

    @property
    def most_samples(self) -> int:
        return CPU_SAMPLES if self.samples_per_batch == "auto" else self.samples_per_batch

    def batches(self, views: Views, frame: Frame, *, seed: int, rank: int) -> "RayBatches":
        return RayBatches(views, frame, self, seed=seed, rank=rank)

    def fitting(self, rays: int, samples: int) -> int:
        """As many as keep the samples near their maximum."""
        room = self.most_samples * rays / max(1, samples)
        return max(64, min(self.most, int(room)))


@dataclass(frozen=True, kw_only=True)
class ViewSettings(BatchSettings):
    """Whole training views, one per batch."""

    background: Literal["white", "one"]  # Background colour; one: drawn per batch.

    @property
    def most(self) -> int:
        return 0

    @property
    def most_samples(self) -> int | None:
        return None

    def batches(self, views: Views, frame: Frame, *, seed: int, rank: int) -> "ViewBatches":
        return ViewBatches(views, self, seed=seed, rank=rank)

    def fitting(self, rays: int, samples: int) -> int:
        return rays


class ViewBatches(Batches):
    """Draws whole training views; each comes once before any comes again.

    Args:
        views: Training views.
        settings: What lies behind them.
        seed: The run's seed.
        rank: Number of this process among those that share the run.
    """

    skipped = 0.0

    def __init__(self, views: Views, settings: ViewSettings, *, seed: int, rank: int = 0) -> None:
        self.views, self.seed, self.stream = views, seed, Stream.VIEWS + rank
        self.background = settings.background
        self.rays = max(1, views.pixels // len(views))

    def draw(self, step: int, rays: int | None = None) -> Batch:
        """The view of a step.

        Returns:
            Its ``camera``, and for each pixel, row by row: ``times`` [R], ``target`` colour before
            ``background`` [R, 3] each, and ``alpha`` [R]. If some are not to be trained on, which
            are ``shown``. bool [R]
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

    With ``skip_background`` rays far from the silhouettes are drawn at ``background_share`` instead
    of at their share of the pixels. They show nothing but background; a few keep the air clear of
    floaters. Space along those without any alpha counts as empty shortly before and after, too.
    Opaque pixels of one colour with all around them, such as those of a white floor, have
    `PLAIN_SHARE`. Opaque images of fixed cameras have no silhouettes, but pixels that change: the
    others are drawn at `STILL_SHARE`, at their own times.

    Of images in files each batch takes `PER_RUN` pixels of each of some runs of consecutive pixels,
    so that it reads few places of the disk; every pixel is still as likely as any other. Near and
    far are told apart more coarsely there (`RunPools`).

    Args:
        views: Training views.
        frame: The field's frame, in which rays are served.
        settings: Which rays to draw.
        seed: The run's seed.
        rank: Number of this process among those that split the rays.
    """

    def __init__(
        self, views: Views, frame: Frame, settings: RaySettings, *, seed: int, rank: int = 0
    ) -> None:
        self.views, self.frame = views, frame
        self.rays, self.seed, self.rank = settings.most, seed, rank
        self.background = settings.background
        widths = views.intrinsics.size[:, 1].tolist()
        margins = [max(1, round(NEAR_SILHOUETTE * width)) for width in widths]
        changes = None
        if isinstance(views.images, StoredImages):
            self.pools = RunPools(views, views.images, margins)
        else:
            if settings.skip_background and views.is_opaque:
                changes = changing(views, margins)  # Large captures are drawn from evenly.
            skips_plain = settings.skip_background and changes is None
            self.pools = PixelPools(
                foreground(views, margins) if changes is None else changes,
                plain(views, margins) if skips_plain else None,
                views.valid() if views.is_cut else None,
            )
        self.far_pixels, plain_pixels, others = self.pools.sizes
        self._prefetched = -1
        self.near_pixels = plain_pixels + others
        pixels = self.near_pixels + self.far_pixels
        natural, plain_natural = self.far_pixels / pixels, plain_pixels / pixels
        skip = settings.skip_background and self.near_pixels > 0
        share = settings.background_share if changes is None else STILL_SHARE
        self.far_share = min(share, natural) if skip else natural
        self.plain_share = min(PLAIN_SHARE, plain_natural) if skip else plain_natural
        jitter = skip and natural > 0 and not views.is_static and changes is None
        self.background_jitter = settings.background_jitter if jitter else 0.0
        self.skipped = natural + plain_natural - self.far_share - self.plain_share
        self.pools.share(self.far_share, self.plain_share)

    def draw(self, step: int, rays: int | None = None) -> Batch:
        """The batch of a step.

        Args:
            step: Its number.
            rays: Rays to draw; as many as there may be when None.

        Returns:
            ``origins`` and unit ``directions`` in the field's frame [R, 3], ``times`` [R],
            ``target`` colour before ``background`` [R, 3] each, its ``alpha`` [R], and ``jitter``
            from 0 to 1 [R].
        """
        rays = rays or self.rays
        generator = step_generator(self.seed, step, self.rank)
        uniform = torch.rand(rays, 3, generator=generator, dtype=torch.float64)
        if isinstance(self.views.images, StoredImages):
            self._prefetch(step, rays)
            drawn = self._from_files(self.views.images, uniform, generator)
        else:
            drawn = self._from_memory(self.views.images, uniform)
        shape = (rays, 3)
        if self.background == "random":
            background = torch.rand(shape, generator=generator)
        elif self.background == "one":
            background = torch.rand(3, generator=generator).expand(shape)
        else:
            background = torch.ones(shape)
        move = None
        if self.background_jitter:
            move = torch.rand(rays, generator=generator)
        return self._served(drawn, background, move, uniform[:, 2].float())

    def _served(
        self, drawn: tuple[Tensor, ...], background: Tensor, move: Tensor | None, jitter: Tensor
    ) -> Batch:
        """A batch of pixels, what lies behind them, and random numbers from 0 to 1."""
        far, view, row, column, colour = drawn
        origins, directions = self.views.pixel_rays(view, row.float(), column.float())
        origins, directions = self.frame.rays(origins, directions)
        colour = colour.float() / 255
        return {
            "origins": origins,
            "directions": directions,
            "times": self._times(view, far & (colour[:, 3] == 0), move),
            "target": colour[:, :3] + (1 - colour[:, 3:]) * background,
            "background": background,
            "alpha": colour[:, 3],
            "jitter": jitter,
        }

    def _from_memory(self, images: Tensor, uniform: Tensor) -> tuple[Tensor, ...]:
        """Far, view, row, column and colour of rays through scattered pixels. [R], [R, 4]"""
        assert isinstance(self.pools, PixelPools)
        far, pixel = self.pools.pick(uniform[:, 0], uniform[:, 1])
        height, width = self.views.height, self.views.width
        view, row, column = pixel // (height * width), pixel // width % height, pixel % width
        return far, view, row, column, images.view(-1, 4)[pixel]

    def _from_files(
        self, images: StoredImages, uniform: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, ...]:
        """Far, view, row, column and colour of rays, some through each of few runs of pixels."""
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
        return tuple(each[:number] for each in drawn)  # The last run may have to give fewer.

    def _prefetch(self, step: int, rays: int) -> None:
        """Ask the system to read the runs of the next batches ahead, each once."""
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

    def _times(self, view: Tensor, empty: Tensor, move: Tensor | None) -> Tensor:
        """Times of rays, those through empty space moved. int64 [R], bool [R], [R] -> [R]"""
        times = self.views.times[view]
        if move is None:
            return times
        move = self.background_jitter * (2 * move - 1)
        return torch.where(empty, (times + move).clamp(0, 1), times)


class DeviceBatches(RayBatches):
    """Batches drawn where the images lie, on a GPU: nothing is copied there, and nothing waits.

    Like those of `RayBatches` they are a function of (seed, step, rank), of the same distribution;
    the random numbers are others, each made from its own place (`counted_uniform`), so that they
    are the same on every device.

    Args:
        batches: What to draw, from pinhole images in memory.
        device: Where.
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
        """Whether these rays can be drawn on a device, and their images have room there."""
        views = batches.views
        if device.type == "cpu" or views.is_stored or views.intrinsics.lenses is not None:
            return False
        return views.nbytes < LARGEST_SHARE * memory_left(device)

    def draw(self, step: int, rays: int | None = None) -> Batch:
        rays = rays or self.rays
        shape = (rays, 7)
        uniform = counted_uniform(self.seed, step, self.rank, shape, self.device)
        assert isinstance(self.views.images, Tensor)
        drawn = self._from_memory(self.views.images, uniform)
        background = uniform[:, 3:6].float()
        if self.background == "one":
            background = background[:1].expand(rays, 3)
        elif self.background == "white":
            background = torch.ones_like(background)
        move = uniform[:, 6].float() if self.background_jitter else None
        return self._served(drawn, background, move, uniform[:, 2].float())


def _per_run(rays: int) -> int:
    """Rays of a batch from one run of pixels."""
    return max(1, min(PER_RUN, rays // LEAST_RUNS))
