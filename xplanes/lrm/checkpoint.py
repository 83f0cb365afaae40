"""Strict loading of published weights."""

import pickle
import zipfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from xplanes.errors import LRMError
from xplanes.files import stand_in
from xplanes.lrm.config import PUBLISHED, LRMConfig, parse_config, published_config
from xplanes.lrm.keys import translate
from xplanes.lrm.model import LRM
from xplanes.lrm.openlrm import OpenLRM
from xplanes.lrm.triposr import TripoSR

NAMED = 4
"""Maximum number of tensors listed in a message."""


class MismatchError(LRMError):
    """Weights do not match the model's sizes.

    Args:
        message: Description of the mismatch.
        fits: Names of the published models that they match.
    """

    def __init__(self, message: str, fits: list[str]) -> None:
        super().__init__(message)
        self.fits = fits


def load(config: Mapping[str, Any] | LRMConfig, weights: Path) -> LRM:
    """Load a Large Reconstruction Model from published weights.

    Args:
        config: The checkpoint's published configuration (`parse_config`), or
            ``{"architecture": NAME}`` with a name from `PUBLISHED`. In the second case, a
            configuration of the same sizes inside the file (OpenLRM 1.0) takes precedence.
        weights: The published file: model.safetensors, pytorch_model.bin, model.pth or model.ckpt.

    Returns:
        The model in float32 and evaluation mode, on the CPU, with frozen parameters.

    Raises:
        LRMError: If the configuration is invalid, or the file is missing, is damaged, holds more
            than weights, or does not fit; the message then names the published models that fit.
    """
    path = Path(weights)
    state, carried = read_weights(path)
    name = None
    if not isinstance(config, LRMConfig):
        if set(config) == {"architecture"} and config["architecture"] in PUBLISHED:
            name = str(config["architecture"])
            config = published_config(name)
            if carried and _same_size(config, carried):
                config = carried
        config = parse_config(config)
    try:
        model = build(config)
    except ValueError as problem:
        raise LRMError(f"the model's configuration cannot be used: {problem}") from problem
    try:
        fill(model, state)
    except MismatchError as problem:
        message = f"{path} does not fit {name or config.architecture}: {problem}"
        raise MismatchError(message, problem.fits) from None
    if broken := [tensor for tensor, values in state.items() if not _finite(values)]:
        raise LRMError(f"{path} holds NaN or infinity in {_some(broken)}: the weights are damaged")
    return model


def build(config: LRMConfig) -> LRM:
    """A model on the meta device, which allocates no memory."""
    with torch.device("meta"):
        model = TripoSR(config) if config.architecture == "triposr" else OpenLRM(config)
    return model.eval().requires_grad_(False)


def fill(model: LRM, state: Mapping[str, Tensor]) -> None:
    """Load published tensors into a model.

    Args:
        model: A model from `build`.
        state: Published tensors by their published names.

    Raises:
        MismatchError: If a tensor is missing, unexpected or of another shape.
    """
    problems = mismatches(model, state)
    if problems:
        fits = fitting(state)
        choices = " or ".join(f"{name} ({PUBLISHED[name].choice})" for name in fits)
        advice = f". It fits {choices or 'no published model'}"
        raise MismatchError("; ".join(problems) + advice, fits)
    translated = {}
    for published, tensor in state.items():
        if names := translate(model.config.architecture, published):
            translated.update(zip(names, tensor.float().chunk(len(names)), strict=True))
    model.load_state_dict(translated, assign=True)
    model.requires_grad_(False)


def _finite(values: Tensor) -> bool:
    """Whether all numbers are finite, computed without a copy."""
    return not values.is_floating_point() or bool(values.sum(dtype=torch.float64).isfinite())


def mismatches(model: LRM, state: Mapping[str, Tensor]) -> list[str]:
    """Differences between published tensors and a model, for messages; empty if they match."""
    expected = {name: list(tensor.shape) for name, tensor in model.state_dict().items()}
    unknown, shapes, found = [], [], set()
    for published, tensor in state.items():
        names = translate(model.config.architecture, published)
        if names is None or any(name not in expected or name in found for name in names):
            unknown.append(published)
            continue
        found.update(names)
        for name in names:
            rows = expected[name][0] * len(names)
            wanted = [rows, *expected[name][1:]]
            if list(tensor.shape) != wanted:
                shapes.append(f"{published} is {list(tensor.shape)} and should be {wanted}")
                break
    missing = [name for name in expected if name not in found]
    problems = {"": shapes, "it has unknown tensors: ": unknown, "it lacks tensors: ": missing}
    return [f"{what}{_some(names)}" for what, names in problems.items() if names]


def fitting(state: Mapping[str, Tensor]) -> list[str]:
    """Names of the published models with the same tensor names and shapes."""
    return [name for name in PUBLISHED if not mismatches(_published_model(name), state)]


@cache
def _published_model(name: str) -> LRM:
    return build(parse_config(published_config(name)))


def read_weights(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors of a file by name, and the configuration that OpenLRM 1.0 files contain.

    Pickles are loaded with ``weights_only``: code in them is never run.

    Raises:
        LRMError: If the file is missing, damaged, or holds more than tensors and numbers.
    """
    if not path.is_file():
        raise LRMError(f"{path} is not a file: give the downloaded weights")
    if (other := stand_in(path)) is not None:
        raise LRMError(f"{path} {other}")
    content = _content(path)
    carried: Any = {}
    if isinstance(content, dict) and "weights" in content:
        content, carried = content["weights"], content.get("kwargs") or {}
    if (
        not isinstance(content, dict)
        or not content
        or not all(isinstance(value, Tensor) for value in content.values())
        or not isinstance(carried, dict)
    ):
        raise LRMError(f"{path} contains no named weights: give the file published for inference")
    return {str(name): tensor for name, tensor in content.items()}, carried


def _content(path: Path) -> Any:
    """Content of a file of weights.

    Raises:
        LRMError: If it is damaged, or contains code.
    """
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            return load_file(path)
        # Only files of newer versions of torch, which are zip archives, can be memory-mapped.
        mapped = zipfile.is_zipfile(path)
        return torch.load(path, map_location="cpu", weights_only=True, mmap=mapped)
    except pickle.UnpicklingError as problem:
        raise LRMError(
            f"{path} is not a file of weights, or contains code, which is never run: use the "
            f".safetensors file if there is one"
        ) from problem
    except Exception as problem:  # Other files raise many kinds of errors.
        raise LRMError(f"{path} is damaged or incomplete: {problem}") from problem


def _same_size(config: Mapping[str, Any], carried: Mapping[str, Any]) -> bool:
    """Whether the configuration in a file has the sizes of the requested published model."""
    model = carried.get("model", {})
    sizes = ("transformer_dim", "transformer_layers", "triplane_dim")
    return all(model.get(key) == config.get(key) for key in sizes)


def _some(items: list[str]) -> str:
    rest = len(items) - NAMED
    return ", ".join(items[:NAMED]) + (f" and {rest} more" if rest > 0 else "")
