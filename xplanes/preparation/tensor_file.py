"""Tensors and builtins in one file: torch.save's form, or safetensors where the name says so."""

import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from xplanes.files import replacing

MARK = "xplanes"
"""Key of what is not a tensor in the metadata of a safetensors file."""


def write_content(path: Path, content: dict[str, Any]) -> None:
    """Write a dict of tensors and builtins, dicts of such among them, whole or not at all.

    Args:
        path: Where to; ``.safetensors`` is written as such.
        content: Names without dots.
    """
    with replacing(path) as temporary:
        if path.suffix != ".safetensors":
            torch.save(content, temporary)
            return
        from safetensors.torch import save_file

        tensors, rest = _apart(content)
        tensors = {name: tensor.contiguous() for name, tensor in tensors.items()}
        save_file(tensors, temporary, metadata={MARK: json.dumps(rest)})


def read_content(path: Path) -> Any:
    """Read what `write_content` wrote; whatever goes wrong is raised as it comes."""
    if path.suffix != ".safetensors":
        return torch.load(path, map_location="cpu", weights_only=True)
    from safetensors import safe_open

    with safe_open(path, "pt") as file:
        content = json.loads((file.metadata() or {}).get(MARK, "{}"))
        for name in file.keys():  # noqa: SIM118, the file is no dict
            node = content
            *groups, last = name.split(".", 1)
            for group in groups:
                node = node.setdefault(group, {})
            node[last] = file.get_tensor(name)
    return content


def _apart(content: dict[str, Any]) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors by dotted name, and all else in its place."""
    tensors: dict[str, Tensor] = {}
    rest: dict[str, Any] = {}
    for name, value in content.items():
        if isinstance(value, Tensor):
            tensors[name] = value
        elif isinstance(value, dict):
            inner, other = _apart(value)
            tensors |= {f"{name}.{key}": tensor for key, tensor in inner.items()}
            rest[name] = other
        else:
            rest[name] = value
    return tensors, rest
