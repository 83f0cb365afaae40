"""Attention and feed-forward layers that all transformers here are made of."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn


def attend(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    """Scaled dot-product attention. [N, H, T, E], [N, H, K, E], [N, H, K, E] -> [N, H, T, E]

    In bfloat16 on the CPU plain products, one sequence at a time so that its scores stay in the
    cache, take a third of the fused kernel's time (768 tokens, 2 heads of 64 channels).
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
    """Multi-head attention over a token sequence, or from it to another one.

    Args:
        width: Channels D of the tokens, in and out.
        heads: Number of heads.
        head_width: Channels of each head; width / heads when None.
        context_width: Channels E of the tokens attended to; the same as ``width`` when None.
        bias: Whether query, key and value have biases.
        out_bias: Whether the output has one.
    """

    def __init__(
        self,
        width: int,
        heads: int,
        *,
        head_width: int | None = None,
        context_width: int | None = None,
        bias: bool = False,
        out_bias: bool = False,
    ) -> None:
        super().__init__()
        inner = heads * (head_width or width // heads)
        self.heads = heads
        self.query = nn.Linear(width, inner, bias=bias)
        self.key = nn.Linear(context_width or width, inner, bias=bias)
        self.value = nn.Linear(context_width or width, inner, bias=bias)
        self.out = nn.Linear(inner, width, bias=out_bias)

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
    """A feed-forward layer in which half of the hidden values gate the other half (GEGLU).

    Args:
        width: Channels D in and out.
        hidden: Channels after gating.
    """

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.expand = nn.Linear(width, 2 * hidden)
        self.contract = nn.Linear(hidden, width)

    def forward(self, tokens: Tensor) -> Tensor:
        """Process each token alone. [N, T, D] -> [N, T, D]"""
        value, gate = self.expand(tokens).chunk(2, dim=-1)
        return self.contract(value * F.gelu(gate))
