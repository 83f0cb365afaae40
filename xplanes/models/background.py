"""The learnt background behind a field: settings, learning rates and smoothness, for any model."""

from dataclasses import dataclass

import torch
from torch import Tensor

from xplanes.fields.background import Background
from xplanes.fields.regularisers import add_total_variation_gradient
from xplanes.rendering.sampler import Group, Site
from xplanes.scenes.views import Views, spread
from xplanes.settings import Count, Positive, Settings, Steps, Weight
from xplanes.streams import Stream, initial_values

MOST_IMAGES, PIXEL_STEP = 32, 4
"""Largest number of images for `usual_colour`, and stride between their rows and columns."""


def usual_colour(views: Views) -> Tensor:
    """Median colour of the images, per channel, from 0 to 1. [3]"""
    steps = slice(None, None, PIXEL_STEP)
    chosen = spread(MOST_IMAGES, len(views))
    pixels = torch.cat([views.image(i)[steps, steps, :3].reshape(-1, 3) for i in chosen])
    return pixels.median(dim=0).values.float() / 255


@dataclass(frozen=True, kw_only=True)
class BackgroundSettings(Settings):
    """A static field behind the cube, for opaque images with a real background."""

    resolution: Count  # Texels along each side of its planes, in contracted space.
    channels: Count  # Channels of each plane.
    samples: Steps  # Samples per ray behind the field; 0: colour depends on direction only.
    width: Count  # Neurons of the decoder's hidden layer.
    total_variation: Weight  # Weight of its planes' total variation.
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
        """Its trainable parameters."""
        decoder = list(background.decoder.parameters())
        return [
            {"params": [background.planes], "lr": self.plane_lr, "name": "background"},
            {"params": decoder, "lr": self.decoder_lr, "name": "background_decoder"},
        ]

    def regularise(self, background: Background, every: int = 1) -> None:
        """Add the gradient of its total variation, scaled by ``every`` steps."""
        planes = background.planes
        if planes.grad is not None and self.total_variation:
            weight = self.total_variation * every
            add_total_variation_gradient(planes.grad, planes, (1, 2), weight)
