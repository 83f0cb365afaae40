"""OpenLRM 1.0 and 1.1: image tokens and a camera to a triplane."""

from dataclasses import replace

import torch
from torch import Tensor, nn

from xplanes.errors import LRMError
from xplanes.lrm.canonical import OPENLRM_VIEW, canonical_vector
from xplanes.lrm.config import LRMConfig
from xplanes.lrm.model import LRM
from xplanes.lrm.vit import Attention, feed_forward

EPSILON = 1e-6


class ModulatedNorm(nn.Module):
    """A layer norm whose shift and scale depend on the camera.

    Args:
        width: Channels D of the tokens.
        camera_width: Channels E of the camera embedding.
    """

    def __init__(self, width: int, camera_width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width, eps=EPSILON)
        self.modulation = nn.Sequential(nn.SiLU(), nn.Linear(camera_width, 2 * width))

    def forward(self, tokens: Tensor, camera: Tensor) -> Tensor:
        """Normalise. [N, T, D], [N, E] -> [N, T, D]"""
        shift, scale = self.modulation(camera)[:, None].chunk(2, dim=-1)
        return self.norm(tokens) * (1 + scale) + shift


class OpenLRMBlock(nn.Module):
    """Attention to the image, then among the tokens, then a feed-forward layer.

    Args:
        config: Sizes of the model.
    """

    def __init__(self, config: LRMConfig) -> None:
        super().__init__()
        width, camera = config.width, config.camera_width
        self.norm1 = ModulatedNorm(width, camera)
        self.image_attention = Attention(width, config.heads, context_width=config.encoder.width)
        self.norm2 = ModulatedNorm(width, camera)
        self.self_attention = Attention(width, config.heads)
        self.norm3 = ModulatedNorm(width, camera)
        self.mlp = feed_forward(width, 4 * width)

    def forward(self, tokens: Tensor, image: Tensor, camera: Tensor) -> Tensor:
        """One layer. [N, T, D], [N, K, E], [N, F] -> [N, T, D]"""
        tokens = tokens + self.image_attention(self.norm1(tokens, camera), image)
        tokens = tokens + self.self_attention(self.norm2(tokens, camera))
        return tokens + self.mlp(self.norm3(tokens, camera))


class OpenLRM(LRM):
    """OpenLRM 1.0 or 1.1; they differ in the image encoder and in the names of some tensors.

    Args:
        config: Sizes of the model.
    """

    def __init__(self, config: LRMConfig) -> None:
        view = replace(OPENLRM_VIEW, distance=config.source_distance, focal=config.source_focal)
        super().__init__(config, view, density_scale=config.density_scale)
        self.camera = nn.Sequential(
            nn.Linear(16, config.camera_width),
            nn.SiLU(),
            nn.Linear(config.camera_width, config.camera_width),
        )
        self.position = nn.Parameter(torch.zeros(1, 3 * config.low_resolution**2, config.width))
        self.blocks = nn.ModuleList(OpenLRMBlock(config) for _ in range(config.layers))
        self.norm = nn.LayerNorm(config.width, eps=EPSILON)

    @torch.no_grad()
    def encode(self, images: Tensor, camera: Tensor | None = None) -> Tensor:
        """Predict triplanes; the image side may be any multiple of the patch size."""
        self.check_images(images)
        patch = self.config.encoder.patch
        if images.shape[-1] % patch:
            raise LRMError(
                f"images are {images.shape[-1]} pixels wide: must be a multiple of {patch}, the "
                f"model was trained with {self.image_size}"
            )
        if camera is None:
            camera = canonical_vector(self.view).expand(len(images), -1)
        if camera.shape != (len(images), 16):
            raise LRMError(
                f"camera has the shape {list(camera.shape)}: must be [{len(images)}, 16]"
            )
        return self.triplanes(images, camera.to(images))

    def triplanes(self, images: Tensor, camera: Tensor) -> Tensor:
        """`encode` with gradients. [N, 3, S, S], [N, 16] -> [N, 3, C, H, H]"""
        tokens = self.transform(self.encoder(images), self.camera(camera))
        return turn_third_plane(self.planes(tokens))

    def transform(self, image: Tensor, camera: Tensor) -> Tensor:
        """Tokens of the triplane from those of the image. [N, K, E], [N, F] -> [N, 3 R R, D]"""
        tokens = self.position.expand(len(image), -1, -1)
        for block in self.blocks:
            tokens = block(tokens, image, camera)
        return self.norm(tokens)


def turn_third_plane(planes: Tensor) -> Tensor:
    """Swap rows and columns of the last plane: OpenLRM has "zy", X-Planes "yz".

    Args:
        planes: Planes xy, xz, zy or xy, xz, yz. [..., 3, C, H, H]

    Returns:
        Planes with the third one transposed. [..., 3, C, H, H]
    """
    xy, xz, third = planes.unbind(-4)
    return torch.stack([xy, xz, third.transpose(-2, -1)], dim=-4)
