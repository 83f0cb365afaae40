"""Small models with random weights, in the form in which the large ones are published."""

import torch

from xplanes.lrm.checkpoint import build
from xplanes.lrm.config import parse_config
from xplanes.lrm.keys import NAMES

OPENLRM = {
    "camera_embed_dim": 24,
    "rendering_samples_per_ray": 16,
    "transformer_dim": 32,
    "transformer_layers": 2,
    "transformer_heads": 2,
    "triplane_low_res": 4,
    "triplane_high_res": 8,
    "triplane_dim": 6,
}
DINO = {
    "hidden_size": 24,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "intermediate_size": 48,
    "image_size": 48,
    "patch_size": 16,
}
CONFIGS = {
    "openlrm-1.0": {
        **OPENLRM,
        "encoder_model_name": "facebook/dino-vitb16",
        "encoder_feat_dim": 24,
        "encoder_sizes": DINO,
    },
    "openlrm-1.1": {
        **OPENLRM,
        "encoder_type": "dinov2",
        "encoder_model_name": "dinov2_vits14_reg",
        "encoder_feat_dim": 32,
        "encoder_sizes": {"img_size": 70, "embed_dim": 32, "depth": 2, "num_heads": 2},
    },
    "triposr": {
        "cond_image_size": 64,
        "image_tokenizer": {"pretrained_model_name_or_path": "facebook/dino-vitb16"},
        "tokenizer": {"plane_size": 4, "num_channels": 64},
        "backbone": {
            "in_channels": "${tokenizer.num_channels}",
            "num_attention_heads": 2,
            "attention_head_dim": 16,
            "num_layers": 2,
            "cross_attention_dim": 24,
        },
        "post_processor": {"in_channels": 64, "out_channels": 6},
        "decoder": {"in_channels": 18, "n_neurons": 16, "n_hidden_layers": 3, "activation": "silu"},
        "renderer": {"radius": 0.87, "density_activation": "exp", "density_bias": -1.0},
        "encoder_sizes": DINO,
    },
}
"""One configuration of each family; only OpenLRM 1.1's has equally wide image and plane tokens."""

SIDES = {"openlrm-1.0": 48, "openlrm-1.1": 56, "triposr": 64}


def published_shapes(config):
    """Shapes of a model's tensors under their published names, in no memory."""
    model = build(config)
    shapes = {name: list(tensor.shape) for name, tensor in model.state_dict().items()}
    layers = max(config.layers, config.encoder.depth, config.decoder_hidden + 1)
    result, taken = {}, set()
    for published, ours in NAMES[config.architecture].items():
        templates = () if ours is None else (ours,) if isinstance(ours, str) else ours
        for layer in range(layers):
            for part in ("weight", "bias"):
                values = {"i": layer, "p": part, "h": layer, "e": 2 * layer}
                names = [template.format(**values) for template in templates]
                rows = [shapes.get(name, []) for name in names]
                if not names or taken & set(names) or not all(rows) or len({*map(str, rows)}) > 1:
                    continue
                taken.update(names)
                result[published.format(**values)] = [len(names) * rows[0][0], *rows[0][1:]]
    assert taken == set(shapes)
    return result


def random_state(config, seed=0):
    """Random tensors under their published names."""
    generator = torch.Generator().manual_seed(seed)
    return {
        name: 0.2 * torch.randn(shape, generator=generator)
        for name, shape in published_shapes(config).items()
    }


def reduced(name):
    """A published configuration of small size, and random tensors that fit it."""
    return CONFIGS[name], random_state(parse_config(CONFIGS[name]))
