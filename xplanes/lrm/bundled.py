"""The bundled models."""

import hashlib
from pathlib import Path

from xplanes.errors import LRMError
from xplanes.files import stand_in
from xplanes.lrm.checkpoint import load
from xplanes.lrm.model import LRM
from xplanes.lrm.weights import read_config

FOLDER = Path(__file__).parent / "shipped"
"""Folder of NAME.safetensors (weights) and NAME.json (configuration, checksum of the weights)."""

CHECKSUM = "weights_sha256"


def bundled_models(folder: Path = FOLDER) -> list[str]:
    """Names of the models in a folder."""
    return sorted(path.stem for path in folder.glob("*.json"))


def load_bundled(name: str, folder: Path = FOLDER) -> tuple[LRM, Path]:
    """Load a bundled model, or one exported to a folder in the same format.

    Args:
        name: Name of the model.
        folder: Its folder.

    Returns:
        The model and the path of its weights.

    Raises:
        LRMError: If it does not exist, or its files are damaged or do not match.
    """
    path, described = folder / f"{name}.safetensors", folder / f"{name}.json"
    if not path.is_file() or not described.is_file():
        known = ", ".join(bundled_models(folder)) or "none"
        raise LRMError(f"{path} and {described.name}: no such model; {folder} contains {known}")
    if (other := stand_in(path)) is not None:
        raise LRMError(f"{path} {other}")
    config = read_config(described)
    expected = config.pop(CHECKSUM, None)
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    if found != expected:
        raise LRMError(
            f"{path} is damaged or belongs to another model: its SHA-256 begins with {found[:12]}, "
            f"{described.name} says {str(expected)[:12]}; reinstall the package"
        )
    return load(config, path), path
