"""Vision transformers that turn an image into tokens: DINO, and DINOv2 with registers."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from xplanes.lrm.config import EncoderConfig


def attend(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    """Scaled dot-product attention. [N, H, T, E], [N, H, K, E], [N, H, K, E] -> [N, H, T, E]

    In bfloat16 on the CPU, separate matrix products take a third of the fused kernel's time (768
    tokens, 2 heads of 64 channels). They process one sequence at a time, which fits in the cache.
    """
    if query.device.type != "cpu" or query.dtype != torch.bfloat16:
        return F.scaled_dot_product_attention(query, key, value)
    query = query * query.shape[-1] ** -0.5
    mixed = [
        (q @ k.transpose(-1, -2)).softmax(-1, dtype=q.dtype) @ v
        for q, k, v in zip(query, key, value, strict=True)
    ]
    return torch.stack(mixed)


class Attention(nn.Module):
    """Multi-head self-attention or cross-attention.

    Args:
        width: Channels D of the tokens, in and out.
        heads: Number of heads.
        context_width: Channels E of the context tokens; ``width`` when None.
        bias: Whether query, key and value have biases.
        out_bias: Whether the output has one.
    """

    def __init__(
        self,
        width: int,
        heads: int,
        *,
        context_width: int | None = None,
        bias: bool = False,
        out_bias: bool = False,
    ) -> None:
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(width, width, bias=bias)
        self.key = nn.Linear(context_width or width, width, bias=bias)
        self.value = nn.Linear(context_width or width, width, bias=bias)
        self.out = nn.Linear(width, width, bias=out_bias)

    def forward(self, tokens: Tensor, context: Tensor | None = None) -> Tensor:
        """Attend to ``context``, or to the tokens themselves. [N, T, D], [N, K, E] -> [N, T, D]"""
        if context is None:
            context = tokens
        query, key, value = (
            projected.unflatten(-1, (self.heads, -1)).transpose(1, 2)
            for projected in (self.query(tokens), self.key(context), self.value(context))
        )
        mixed = attend(query, key, value)
        return self.out(mixed.transpose(1, 2).flatten(2))


def feed_forward(width: int, hidden: int) -> nn.Sequential:
    """Two linear layers with the exact (erf) GELU between them."""
    return nn.Sequential(nn.Linear(width, hidden), nn.GELU(), nn.Linear(hidden, width))


class GatedFeedForward(nn.Module):
    """A gated feed-forward layer (GEGLU).

    Args:
        width: Channels D in and out.
        hidden: Channels after gating.
    """

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.expand = nn.Linear(width, 2 * hidden)
        self.contract = nn.Linear(hidden, width)

    def forward(self, tokens: Tensor) -> Tensor:
        """Process each token separately. [N, T, D] -> [N, T, D]"""
        value, gate = self.expand(tokens).chunk(2, dim=-1)
        return self.contract(value * F.gelu(gate))


def interpolate_positions(position: Tensor, side: int, *, antialias: bool) -> Tensor:
    """Position embedding for another number of patches.

    Args:
        position: Learned embedding, the class token first, then a square grid row by row.
            [1, 1 + G G, D]
        side: Patches along each side of the image.
        antialias: DINOv2's rule: antialiased, to the exact size. Otherwise DINO's, which maps
            coordinates by the factor (side + 0.1) / G; the 0.1 changes the result by some percent.

    Returns:
        The embedding for side x side patches. [1, 1 + side side, D]
    """
    head, patches = position[:, :1], position[:, 1:]
    stored = round(patches.shape[1] ** 0.5)
    if stored == side:
        return position
    grid = patches.unflatten(1, (stored, stored)).permute(0, 3, 1, 2)
    if antialias:
        grid = F.interpolate(grid, size=(side, side), mode="bicubic", antialias=True)
    else:
        factor = (side + 0.1) / stored
        grid = F.interpolate(grid, scale_factor=(factor, factor), mode="bicubic")
    return torch.cat([head, grid.flatten(2).transpose(1, 2)], dim=1)


class Block(nn.Module):
    """A pre-norm transformer block: self-attention and a feed-forward layer, both residual.

    Args:
        config: Sizes of the encoder.
    """

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        width = config.width
        self.norm1 = nn.LayerNorm(width, eps=config.norm_epsilon)
        self.attention = Attention(width, config.heads, bias=True, out_bias=True)
        self.norm2 = nn.LayerNorm(width, eps=config.norm_epsilon)
        self.mlp = feed_forward(width, config.hidden)
        scaled = config.layer_scale
        self.scale1 = nn.Parameter(torch.ones(width)) if scaled else None
        self.scale2 = nn.Parameter(torch.ones(width)) if scaled else None

    def forward(self, tokens: Tensor) -> Tensor:
        """One layer. [N, T, D] -> [N, T, D]"""
        change = self.attention(self.norm1(tokens))
        tokens = tokens + (change if self.scale1 is None else self.scale1 * change)
        change = self.mlp(self.norm2(tokens))
        return tokens + (change if self.scale2 is None else self.scale2 * change)


class VisionTransformer(nn.Module):
    """An image encoder: DINO ViT (OpenLRM 1.0, TripoSR) or DINOv2 with registers (OpenLRM 1.1).

    Args:
        config: Sizes, and the options in which the two differ.
    """

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        self.config = config
        width, patch = config.width, config.patch
        self.patch = nn.Conv2d(3, width, kernel_size=patch, stride=patch)
        self.class_token = nn.Parameter(torch.zeros(1, 1, width))
        self.position = nn.Parameter(torch.zeros(1, 1 + config.grid**2, width))
        self.registers = (
            nn.Parameter(torch.zeros(1, config.registers, width)) if config.registers else None
        )
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.depth))
        self.norm = nn.LayerNorm(width, eps=config.norm_epsilon)

    def forward(self, images: Tensor) -> Tensor:
        """Tokens of images, the class token first, then the patches row by row.

        Args:
            images: RGB from 0 to 1, square, the side a multiple of the patch. [N, 3, S, S]

        Returns:
            Normalised tokens without the registers. [N, 1 + (S / patch)^2, D]
        """
        config = self.config
        if config.mean is not None and config.std is not None:
            mean, std = images.new_tensor(config.mean), images.new_tensor(config.std)
            images = (images - mean[:, None, None]) / std[:, None, None]
        patches = self.patch(images)
        side = patches.shape[-1]
        tokens = torch.cat(
            [self.class_token.expand(len(images), -1, -1), patches.flatten(2).transpose(1, 2)],
            dim=1,
        )
        tokens = tokens + interpolate_positions(
            self.position, side, antialias=config.antialias_positions
        )
        if self.registers is not None:
            registers = self.registers.expand(len(images), -1, -1)
            tokens = torch.cat([tokens[:, :1], registers, tokens[:, 1:]], dim=1)
        for block in self.blocks:
            tokens = block(tokens)
        tokens = self.norm(tokens)
        if self.registers is not None:
            tokens = torch.cat([tokens[:, :1], tokens[:, 1 + config.registers :]], dim=1)
        return tokens
