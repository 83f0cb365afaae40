"""TripoSR: image tokens to a triplane, no camera."""

import torch
from torch import Tensor, nn

from xplanes.errors import LRMError
from xplanes.lrm.canonical import TRIPOSR_VIEW
from xplanes.lrm.config import LRMConfig
from xplanes.lrm.images import resize_triposr
from xplanes.lrm.model import LRM
from xplanes.lrm.vit import Attention, GatedFeedForward

CHORD = 2 * 0.999 * TRIPOSR_VIEW.half_side
"""Length of an axis-aligned ray through TripoSR's box, in its frame.

TripoSR's density is relative to the length of each ray inside the box. Divided by this length, it
is a density per unit length: exact for the central ray, approximate for the others.
"""


class TripoSRBlock(nn.Module):
    """Attention among the tokens, then to the image, then a gated feed-forward layer.

    Args:
        config: Sizes of the model.
    """

    def __init__(self, config: LRMConfig) -> None:
        super().__init__()
        width = config.heads * config.head_width
        self.norm1 = nn.LayerNorm(width)
        self.self_attention = Attention(width, config.heads, out_bias=True)
        self.norm2 = nn.LayerNorm(width)
        self.image_attention = Attention(
            width, config.heads, context_width=config.encoder.width, out_bias=True
        )
        self.norm3 = nn.LayerNorm(width)
        self.mlp = GatedFeedForward(width, 4 * width)

    def forward(self, tokens: Tensor, image: Tensor) -> Tensor:
        """One layer. [N, T, D], [N, K, E] -> [N, T, D]"""
        tokens = tokens + self.self_attention(self.norm1(tokens))
        tokens = tokens + self.image_attention(self.norm2(tokens), image)
        return tokens + self.mlp(self.norm3(tokens))


class TripoSR(LRM):
    """TripoSR.

    Args:
        config: Sizes of the model.
    """

    def __init__(self, config: LRMConfig) -> None:
        decoder = {"activation": "silu", "density": "exp", "colour_margin": 0.0}
        super().__init__(config, TRIPOSR_VIEW, density_scale=1 / CHORD, **decoder)
        side, width = config.low_resolution, config.width
        inner = config.heads * config.head_width
        self.tokens = nn.Parameter(torch.zeros(3, width, side, side))
        self.norm = nn.GroupNorm(32, width, eps=1e-6)
        self.project_in = nn.Linear(width, inner)
        self.blocks = nn.ModuleList(TripoSRBlock(config) for _ in range(config.layers))
        self.project_out = nn.Linear(inner, width)

    @torch.no_grad()
    def encode(self, images: Tensor, camera: Tensor | None = None) -> Tensor:
        """Predict triplanes; images are resized to the size of the training images."""
        self.check_images(images)
        if camera is not None:
            raise LRMError("TripoSR has no camera input: camera must be None")
        return self.planes(self.transform(self.encoder(resize_triposr(images, self.image_size))))

    def transform(self, image: Tensor) -> Tensor:
        """Tokens of the triplane from those of the image. [N, K, E] -> [N, 3 R R, D]"""
        start = self.tokens.permute(0, 2, 3, 1).flatten(0, 2).expand(len(image), -1, -1)
        # Group statistics are computed over all tokens.
        normalised = self.norm(start.transpose(1, 2)).transpose(1, 2)
        tokens = self.project_in(normalised)
        for block in self.blocks:
            tokens = block(tokens, image)
        return start + self.project_out(tokens)
