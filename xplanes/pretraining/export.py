"""Weights of a trained model under OpenLRM's names."""

import hashlib
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import Tensor

from xplanes.files import replacing, write_json
from xplanes.lrm.bundled import CHECKSUM
from xplanes.lrm.config import LRMConfig
from xplanes.lrm.keys import NAMES
from xplanes.lrm.openlrm import OpenLRM


def export(model: OpenLRM, config: dict[str, Any], folder: Path, name: str) -> Path:
    """Write NAME.safetensors in half precision and NAME.json, its configuration.

    Args:
        model: The model.
        config: The content of its config.json.
        folder: Where to.
        name: Name of the files.

    Returns:
        The weights. Their SHA-256 stands in the configuration as ``weights_sha256``.
    """
    path = folder / f"{name}.safetensors"
    state = {key: value.half().contiguous() for key, value in published_state(model).items()}
    with replacing(path) as temporary:
        save_file(state, temporary)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    write_json(folder / f"{name}.json", {**config, CHECKSUM: digest})
    return path


def published_state(model: OpenLRM) -> dict[str, Tensor]:
    """A model's tensors under the names of OpenLRM's checkpoints."""
    ours = {key: value.detach() for key, value in model.state_dict().items()}
    config: LRMConfig = model.config
    layers = max(config.layers, config.encoder.depth, config.decoder_hidden + 1)
    packed = config.width == config.encoder.width
    result: dict[str, Tensor] = {}
    for published, names in NAMES[config.architecture].items():
        templates = () if names is None else (names,) if isinstance(names, str) else names
        # Query, key and value of attention to the picture are stacked where widths are equal.
        of_picture = ".cross_attn." in published and "out_proj" not in published
        if of_picture and packed != ("in_proj" in published):
            continue
        for layer in range(layers):
            for part in ("weight", "bias"):
                values = {"i": layer, "p": part, "h": layer, "e": 2 * layer}
                found = [ours.get(template.format(**values)) for template in templates]
                tensors = [tensor for tensor in found if tensor is not None]
                if tensors and len(tensors) == len(templates):
                    result[published.format(**values)] = (
                        torch.cat(tensors) if len(tensors) > 1 else tensors[0]
                    )
    return result
