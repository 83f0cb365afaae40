"""Names of tensors in published checkpoints, and their names in this package.

In a name, ``{i}`` is the index of a layer and ``{p}`` is weight or bias. ``{e}`` is the even index
of a linear layer in a sequence that alternates with activations, and ``{h}`` is half of it. A
published tensor with several names here is split into these along the first axis. None marks
tensors that a checkpoint may contain but the model does not need.
"""

import re
from collections.abc import Mapping
from functools import cache
from typing import Any

from xplanes.lrm.config import Architecture

Names = Mapping[str, str | tuple[str, ...] | None]


def _packed(place: str, suffix: str) -> tuple[str, ...]:
    return tuple(f"{place}.{part}.{suffix}" for part in ("query", "key", "value"))


def _dino(prefix: str) -> Names:
    """A DINO encoder under the names of the transformers library, version 4."""
    layer, block = f"{prefix}.encoder.layer.{{i}}", "encoder.blocks.{i}"
    return {
        f"{prefix}.embeddings.cls_token": "encoder.class_token",
        f"{prefix}.embeddings.position_embeddings": "encoder.position",
        f"{prefix}.embeddings.patch_embeddings.projection.{{p}}": "encoder.patch.{p}",
        f"{layer}.layernorm_before.{{p}}": f"{block}.norm1.{{p}}",
        f"{layer}.attention.attention.query.{{p}}": f"{block}.attention.query.{{p}}",
        f"{layer}.attention.attention.key.{{p}}": f"{block}.attention.key.{{p}}",
        f"{layer}.attention.attention.value.{{p}}": f"{block}.attention.value.{{p}}",
        f"{layer}.attention.output.dense.{{p}}": f"{block}.attention.out.{{p}}",
        f"{layer}.layernorm_after.{{p}}": f"{block}.norm2.{{p}}",
        f"{layer}.intermediate.dense.{{p}}": f"{block}.mlp.0.{{p}}",
        f"{layer}.output.dense.{{p}}": f"{block}.mlp.2.{{p}}",
        f"{prefix}.layernorm.{{p}}": "encoder.norm.{p}",
    }


_DINOV2: Names = {
    "encoder.model.cls_token": "encoder.class_token",
    "encoder.model.pos_embed": "encoder.position",
    "encoder.model.register_tokens": "encoder.registers",
    "encoder.model.patch_embed.proj.{p}": "encoder.patch.{p}",
    "encoder.model.blocks.{i}.norm1.{p}": "encoder.blocks.{i}.norm1.{p}",
    "encoder.model.blocks.{i}.attn.qkv.{p}": _packed("encoder.blocks.{i}.attention", "{p}"),
    "encoder.model.blocks.{i}.attn.proj.{p}": "encoder.blocks.{i}.attention.out.{p}",
    "encoder.model.blocks.{i}.ls1.gamma": "encoder.blocks.{i}.scale1",
    "encoder.model.blocks.{i}.norm2.{p}": "encoder.blocks.{i}.norm2.{p}",
    "encoder.model.blocks.{i}.mlp.fc1.{p}": "encoder.blocks.{i}.mlp.0.{p}",
    "encoder.model.blocks.{i}.mlp.fc2.{p}": "encoder.blocks.{i}.mlp.2.{p}",
    "encoder.model.blocks.{i}.ls2.gamma": "encoder.blocks.{i}.scale2",
    "encoder.model.norm.{p}": "encoder.norm.{p}",
}

_LAYER = "transformer.layers.{i}"

_OPENLRM: Names = {
    "camera_embedder.mlp.0.{p}": "camera.0.{p}",
    "camera_embedder.mlp.2.{p}": "camera.2.{p}",
    f"{_LAYER}.norm1.norm.{{p}}": "blocks.{i}.norm1.norm.{p}",
    f"{_LAYER}.norm1.mlp.1.{{p}}": "blocks.{i}.norm1.modulation.1.{p}",
    f"{_LAYER}.norm2.norm.{{p}}": "blocks.{i}.norm2.norm.{p}",
    f"{_LAYER}.norm2.mlp.1.{{p}}": "blocks.{i}.norm2.modulation.1.{p}",
    f"{_LAYER}.norm3.norm.{{p}}": "blocks.{i}.norm3.norm.{p}",
    f"{_LAYER}.norm3.mlp.1.{{p}}": "blocks.{i}.norm3.modulation.1.{p}",
    # Packed if image and triplane tokens have the same width, else separate.
    f"{_LAYER}.cross_attn.in_proj_weight": _packed("blocks.{i}.image_attention", "weight"),
    f"{_LAYER}.cross_attn.q_proj_weight": "blocks.{i}.image_attention.query.weight",
    f"{_LAYER}.cross_attn.k_proj_weight": "blocks.{i}.image_attention.key.weight",
    f"{_LAYER}.cross_attn.v_proj_weight": "blocks.{i}.image_attention.value.weight",
    f"{_LAYER}.cross_attn.out_proj.weight": "blocks.{i}.image_attention.out.weight",
    f"{_LAYER}.self_attn.in_proj_weight": _packed("blocks.{i}.self_attention", "weight"),
    f"{_LAYER}.self_attn.out_proj.weight": "blocks.{i}.self_attention.out.weight",
    f"{_LAYER}.mlp.0.{{p}}": "blocks.{i}.mlp.0.{p}",
    f"{_LAYER}.mlp.3.{{p}}": "blocks.{i}.mlp.2.{p}",
    "transformer.norm.{p}": "norm.{p}",
    "synthesizer.decoder.net.{e}.{p}": "decoder.layers.{h}.{p}",
}

_BLOCK = "backbone.transformer_blocks.{i}"

_TRIPOSR: Names = {
    "image_tokenizer.model.pooler.dense.{p}": None,
    "tokenizer.embeddings": "tokens",
    "backbone.norm.{p}": "norm.{p}",
    "backbone.proj_in.{p}": "project_in.{p}",
    "backbone.proj_out.{p}": "project_out.{p}",
    f"{_BLOCK}.norm1.{{p}}": "blocks.{i}.norm1.{p}",
    f"{_BLOCK}.attn1.to_q.weight": "blocks.{i}.self_attention.query.weight",
    f"{_BLOCK}.attn1.to_k.weight": "blocks.{i}.self_attention.key.weight",
    f"{_BLOCK}.attn1.to_v.weight": "blocks.{i}.self_attention.value.weight",
    f"{_BLOCK}.attn1.to_out.0.{{p}}": "blocks.{i}.self_attention.out.{p}",
    f"{_BLOCK}.norm2.{{p}}": "blocks.{i}.norm2.{p}",
    f"{_BLOCK}.attn2.to_q.weight": "blocks.{i}.image_attention.query.weight",
    f"{_BLOCK}.attn2.to_k.weight": "blocks.{i}.image_attention.key.weight",
    f"{_BLOCK}.attn2.to_v.weight": "blocks.{i}.image_attention.value.weight",
    f"{_BLOCK}.attn2.to_out.0.{{p}}": "blocks.{i}.image_attention.out.{p}",
    f"{_BLOCK}.norm3.{{p}}": "blocks.{i}.norm3.{p}",
    f"{_BLOCK}.ff.net.0.proj.{{p}}": "blocks.{i}.mlp.expand.{p}",
    f"{_BLOCK}.ff.net.2.{{p}}": "blocks.{i}.mlp.contract.{p}",
    "post_processor.upsample.{p}": "upsample.{p}",
    "decoder.layers.{e}.{p}": "decoder.layers.{h}.{p}",
}

NAMES: dict[Architecture, Names] = {
    "openlrm-1.0": {
        **_dino("encoder.model"),
        **_OPENLRM,
        "transformer.pos_embed": "position",
        "transformer.deconv.{p}": "upsample.{p}",
    },
    "openlrm-1.1": {
        **_DINOV2,
        **_OPENLRM,
        "pos_embed": "position",
        "upsampler.{p}": "upsample.{p}",
    },
    "triposr": {**_dino("image_tokenizer.model"), **_TRIPOSR},
}
"""Maps published names to those of this package, by family."""

_PLACEHOLDERS = {"i": r"\d+", "e": r"\d*[02468]", "p": r"weight|bias"}


def translate(architecture: Architecture, name: str) -> tuple[str, ...] | None:
    """Names of a published tensor in this package; empty if not needed, None if unknown."""
    for pattern, ours in _patterns(architecture):
        if (match := pattern.fullmatch(name)) is not None:
            values = match.groupdict()
            if "e" in values:
                values["h"] = str(int(values["e"]) // 2)
            templates = (ours,) if isinstance(ours, str) else ours or ()
            return tuple(template.format(**values) for template in templates)
    return None


@cache
def _patterns(architecture: Architecture) -> list[tuple[re.Pattern[str], Any]]:
    """For each published name of a family, a regular expression and the names in this package."""
    found = []
    for name, ours in NAMES[architecture].items():
        parts = re.split(r"\{(\w)\}", name)
        parts[::2] = map(re.escape, parts[::2])
        parts[1::2] = [f"(?P<{part}>{_PLACEHOLDERS[part]})" for part in parts[1::2]]
        found.append((re.compile("".join(parts)), ours))
    return found
