"""Ray batches drawn without memory: the step alone decides what is in them."""

import torch
from torch import Tensor

from xplanes.scenes.cameras import pixel_rays
from xplanes.scenes.frame import Frame
from xplanes.scenes.silhouettes import foreground
from xplanes.scenes.views import Views

Batch = dict[str, Tensor]

NEAR_SILHOUETTE = 0.02
"""Share of the image's side around silhouettes that counts as near."""


def step_generator(seed: int, step: int, stream: int = 0) -> torch.Generator:
    """A generator that depends on nothing but its arguments.

    Args:
        seed: The run's seed.
        step: The training step.
        stream: Tells independent uses apart: the rank of a process, or another purpose.
    """
    # Odd constants spread neighbouring triples over 64 bits (splitmix64).
    key = (
        seed * 0x9E3779B97F4A7C15 + step * 0xBF58476D1CE4E5B9 + stream * 0x94D049BB133111EB
    ) % 2**64
    key = ((key ^ (key >> 30)) * 0xBF58476D1CE4E5B9) % 2**64
    key = ((key ^ (key >> 27)) * 0x94D049BB133111EB) % 2**64
    return torch.Generator().manual_seed(key ^ (key >> 31))


class RayBatches:
    """Draws training rays as a function of (seed, step, rank).

    Args:
        views: Training views.
        frame: The field's frame, in which rays are served.
        rays: Rays per batch.
        seed: The run's seed.
        background: Behind rays, in the target too: "white", "random" (another colour for each ray)
            or "one" (one random colour for the batch).
        skip_background: Whether rays far from the silhouettes are drawn at ``background_share``
            instead of at their share of the pixels. They show nothing but background; a few keep
            the air clear of specks.
        background_share: Share of a batch drawn far from the silhouettes.
        background_jitter: Share of all time by which their times are then moved at most. What is
            far from a silhouette is taken to be empty a moment before and after, too.
        rank: Number of this process among those that split the rays.
    """

    def __init__(
        self,
        views: Views,
        frame: Frame,
        *,
        rays: int,
        seed: int,
        background: str,
        skip_background: bool,
        background_share: float,
        background_jitter: float,
        rank: int = 0,
    ) -> None:
        self.views, self.frame = views, frame
        self.rays, self.seed, self.rank = rays, seed, rank
        self.background = background
        margin = max(1, round(NEAR_SILHOUETTE * views.width))
        near = foreground(views, margin).flatten()
        self.near, self.far = near.nonzero()[:, 0], (~near).nonzero()[:, 0]
        natural = len(self.far) / near.numel()
        skip = skip_background and 0 < natural < 1
        self.far_share = min(background_share, natural) if skip else natural
        self.background_jitter = background_jitter if skip and not views.is_still else 0.0
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
        origins, directions = pixel_rays(
            self.views.camera_to_world[view],
            (pixel // width % height).float(),
            (pixel % width).float(),
            focal=self.views.focal,
            height=height,
            width=width,
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
