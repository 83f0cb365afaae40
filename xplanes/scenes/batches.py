"""Ray batches drawn without memory: the step alone decides what is in them."""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from xplanes.scenes.cameras import cast_rays
from xplanes.scenes.frame import Frame
from xplanes.scenes.silhouettes import foreground
from xplanes.scenes.views import Views
from xplanes.settings import Count, Settings, Share
from xplanes.streams import step_generator

Batch = dict[str, Tensor]

NEAR_SILHOUETTE = 0.02
"""Share of the image's side around silhouettes that counts as near."""


@dataclass(frozen=True, kw_only=True)
class RaySettings(Settings):
    """Which rays a training step gets."""

    per_batch: Count  # Maximum number of rays per batch.
    samples_per_batch: Count  # Maximum number of samples per batch, on average.
    accumulate: Count  # Batches per optimiser step.
    background: Literal["white", "random", "one"]  # random: per ray; one: random per batch.
    skip_background: bool  # Sample rays near the silhouettes more often.
    background_share: Share  # Share of rays far from the silhouettes.
    background_jitter: Share  # Maximum random offset of the times of these rays.


class RayBatches:
    """Draws training rays as a function of (seed, step, rank).

    With ``skip_background`` rays far from the silhouettes are drawn at ``background_share`` instead
    of at their share of the pixels. They show nothing but background; a few keep the air clear of
    floaters. Space far from a silhouette counts as empty shortly before and after, too.

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
        self.rays, self.seed, self.rank = settings.per_batch, seed, rank
        self.background = settings.background
        widths = views.intrinsics.size[:, 1].tolist()
        near = foreground(views, [max(1, round(NEAR_SILHOUETTE * width)) for width in widths])
        far = ~near
        if views.is_cut:
            valid = views.valid()
            near, far = near & valid, far & valid
        self.near, self.far = (pool.flatten().nonzero()[:, 0] for pool in (near, far))
        natural = len(self.far) / (len(self.near) + len(self.far))
        skip = settings.skip_background and 0 < natural < 1
        self.far_share = min(settings.background_share, natural) if skip else natural
        jitter = skip and not views.is_static
        self.background_jitter = settings.background_jitter if jitter else 0.0
        self.skipped = max(0.0, 1 - self.far_share / natural) * natural if skip else 0.0
        """Share of all pixels that uniform drawing would have shown and this one leaves out."""

    def draw(self, step: int) -> Batch:
        """The batch of a step.

        Returns:
            ``origins`` and unit ``directions`` in the field's frame [R, 3], ``times`` [R],
            ``target`` colour before ``background`` [R, 3] each, its ``alpha`` [R], and ``jitter``
            from 0 to 1 [R].
        """
        generator = step_generator(self.seed, step, self.rank)
        uniform = torch.rand(self.rays, 3, generator=generator, dtype=torch.float64)
        far = uniform[:, 0] < self.far_share
        pixel = torch.where(
            far,
            _pick(self.far if len(self.far) else self.near, uniform[:, 1]),
            _pick(self.near if len(self.near) else self.far, uniform[:, 1]),
        )
        height, width = self.views.height, self.views.width
        view = pixel // (height * width)
        intrinsics = self.views.intrinsics
        origins, directions = cast_rays(
            self.views.camera_to_world[view],
            (pixel // width % height).float(),
            (pixel % width).float(),
            focal=intrinsics.focal[view],
            centre=intrinsics.centre[view],
            lenses=None if intrinsics.lenses is None else intrinsics.lenses.subset(view),
        )
        origins, directions = self.frame.rays(origins, directions)
        colour = self.views.images.view(-1, 4)[pixel].float() / 255
        shape = (self.rays, 3)
        if self.background == "random":
            background = torch.rand(shape, generator=generator)
        elif self.background == "one":
            background = torch.rand(3, generator=generator).expand(shape)
        else:
            background = torch.ones(shape)
        return {
            "origins": origins,
            "directions": directions,
            "times": self._times(view, far, generator),
            "target": colour[:, :3] + (1 - colour[:, 3:]) * background,
            "background": background,
            "alpha": colour[:, 3],
            "jitter": uniform[:, 2].float(),
        }

    def _times(self, view: Tensor, far: Tensor, generator: torch.Generator) -> Tensor:
        """Times of rays, those far from silhouettes moved. int64 [R], bool [R] -> [R]"""
        times = self.views.times[view]
        if not self.background_jitter:
            return times
        move = self.background_jitter * (2 * torch.rand(self.rays, generator=generator) - 1)
        return torch.where(far, (times + move).clamp(0, 1), times)


def _pick(pool: Tensor, uniform: Tensor) -> Tensor:
    """Entries of ``pool`` at places given by numbers from 0 to 1."""
    return pool[(uniform * len(pool)).long().clamp_(max=len(pool) - 1)]
