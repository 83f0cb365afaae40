"""The learnt background behind a field: settings, learning rates and smoothness, for any model."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.fields.background import Background
from xplanes.fields.regularisers import add_total_variation_gradient
from xplanes.rendering.base import Rendering
from xplanes.rendering.behind import background_colour
from xplanes.rendering.sampler import Group, Site
from xplanes.scenes.batches import Batch
from xplanes.scenes.views import Views, spread
from xplanes.settings import Count, Positive, Settings, Steps, Weight
from xplanes.streams import Stream, TrainingState, initial_values

MOST_IMAGES, PIXEL_STEP = 32, 4
"""Largest number of images for `usual_colour`, and stride between their rows and columns."""


def usual_colour(views: Views) -> Tensor:
    """Median colour of the images, per channel, from 0 to 1. [3]"""
    steps = slice(None, None, PIXEL_STEP)
    chosen = spread(MOST_IMAGES, len(views))
    pixels = torch.cat([views.image(i)[steps, steps, :3].reshape(-1, 3) for i in chosen])
    return pixels.median(dim=0).values.float() / 255


UNSEEN_RAYS, UNSEEN_EVERY = 64, 8
"""Random rays of the prior on unseen directions, and steps between its evaluations."""


def weighted_median(values: Tensor, weights: Tensor) -> Tensor:
    """Weighted median of each column. [N, C], [N] -> [C]"""
    values, order = values.sort(dim=0)
    share = weights[order].cumsum(dim=0)
    middle = (share < 0.5 * share[-1]).sum(dim=0).clamp_max(len(values) - 1)
    return values.gather(0, middle[None])[0]


@dataclass(frozen=True, kw_only=True)
class BackgroundSettings(Settings):
    """A static field behind the cube, for opaque images with a real background."""

    resolution: Count  # Texels along each side of its planes, in contracted space.
    channels: Count  # Channels of each plane.
    samples: Steps  # Samples per ray behind the field; 0: colour depends on direction only.
    width: Count  # Neurons of the decoder's hidden layer.
    total_variation: Weight  # Weight of its planes' total variation.
    # Weight of the prior on directions that no view shows: squared error of random rays' colours
    # against the median colour that views show behind the cube.
    unseen: Weight
    plane_lr: Positive  # Learning rate of its planes.
    decoder_lr: Positive  # Learning rate of its decoder.

    def build(self, site: Site) -> Background | None:
        """The background; None where the images show no surroundings."""
        if not site.surrounded:
            return None
        with initial_values(site.seed, Stream.BACKGROUND):
            return Background(
                self.channels,
                self.resolution,
                width=self.width,
                samples=self.samples,
                precision="bf16" if site.precision == "bf16" else "32",
                colour=None if site.views is None else usual_colour(site.views),
            )

    def groups(self, background: Background) -> list[Group]:
        """Parameter groups of the background."""
        decoder = list(background.decoder.parameters())
        return [
            {"params": [background.planes], "lr": self.plane_lr, "name": "background"},
            {"params": decoder, "lr": self.decoder_lr, "name": "background_decoder"},
        ]

    def losses(
        self, background: Background, rendering: Rendering, rays: Batch, state: TrainingState
    ) -> dict[str, Tensor]:
        """Loss terms of the background by name; empty between evaluations of the prior. [] each

        All directions share the decoder: without the prior, directions that no view shows would get
        arbitrary colours.

        Args:
            background: The background.
            rendering: The rendering of the rays.
            rays: The batch.
            state: Seed and progress of training.
        """
        if not self.unseen or state.step % UNSEEN_EVERY:
            return {}
        # Equal weights where no ray passes.
        behind = (1 - rendering.opacity.detach()).clamp_min(1e-6) * rays.get("weight", 1)
        if rendering.shown is not None:
            behind = behind * rendering.shown
        usual = weighted_median(rays["target"], behind)
        generator = state.generator(usual.device, Stream.UNSEEN)
        options = {"generator": generator, "device": usual.device}
        origins = 2 * torch.rand(UNSEEN_RAYS, 3, **options) - 1
        directions = F.normalize(torch.randn(UNSEEN_RAYS, 3, **options), dim=1)
        error = background_colour(background, origins, directions) - usual
        return {"unseen": UNSEEN_EVERY * self.unseen * error.square().mean()}

    def regularise(self, background: Background, factor: float = 1.0) -> None:
        """Add the gradient of the planes' total variation, times its weight and a factor."""
        planes = background.planes
        if planes.grad is not None and self.total_variation:
            weight = self.total_variation * factor
            add_total_variation_gradient(planes.grad, planes, (1, 2), weight)
