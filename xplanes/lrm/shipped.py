"""The small models that come with the package; docs/lrm_tiny.md says what they can do."""

import hashlib
from pathlib import Path

from xplanes.files import read_json
from xplanes.lrm.checkpoint import load
from xplanes.lrm.errors import LRMError
from xplanes.lrm.model import LRM

FOLDER = Path(__file__).resolve().parent / "shipped"
"""Weights NAME.safetensors, and NAME.json: their configuration and their SHA-256."""


def shipped_names(folder: Path = FOLDER) -> list[str]:
    """Names of the models there are."""
    return sorted(path.stem for path in folder.glob("*.safetensors"))


def load_shipped(name: str, folder: Path = FOLDER) -> LRM:
    """Load a model that comes with the package.

    Args:
        name: One of `shipped_names`.
        folder: Where its files lie.

    Raises:
        LRMError: If there is no such model, or its weights are not those that were shipped.
    """
    weights, described = folder / f"{name}.safetensors", folder / f"{name}.json"
    if not weights.is_file() or not described.is_file():
        known = ", ".join(shipped_names(folder)) or "none"
        raise LRMError(f"{weights} or {described.name} is missing: shipped models are {known}")
    try:
        config = read_json(described)
    except ValueError as problem:
        raise LRMError(f"{problem}: install the package again") from problem
    digest = hashlib.sha256(weights.read_bytes()).hexdigest()
    if digest != config.get("weights_sha256"):
        raise LRMError(
            f"{weights} is damaged or not the file that {described.name} describes: its SHA-256 is "
            f"{digest}, should be {config.get('weights_sha256')}; install the package again"
        )
    return load(config, weights)
