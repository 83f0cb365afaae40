"""Models that come with the package."""

import hashlib
from pathlib import Path

from xplanes.lrm.checkpoint import load
from xplanes.lrm.errors import LRMError
from xplanes.lrm.model import LRM
from xplanes.lrm.weights import read_config

FOLDER = Path(__file__).parent / "shipped"
"""NAME.safetensors beside NAME.json, its config.json with the checksum of the weights."""

CHECKSUM = "weights_sha256"


def bundled_models(folder: Path = FOLDER) -> list[str]:
    """Names of the models in a folder."""
    return sorted(path.stem for path in folder.glob("*.json"))


def load_bundled(name: str, folder: Path = FOLDER) -> tuple[LRM, Path]:
    """Load a model that comes with the package, or was exported into a folder in the same form.

    Args:
        name: Name of the model.
        folder: Where it lies.

    Returns:
        The model and the file of its weights.

    Raises:
        LRMError: If there is none of that name, or its files are damaged or do not belong together.
    """
    path, described = folder / f"{name}.safetensors", folder / f"{name}.json"
    if not path.is_file() or not described.is_file():
        known = ", ".join(bundled_models(folder)) or "none"
        raise LRMError(f"{path} and {described.name}: no such model; in {folder} there is {known}")
    config = read_config(described)
    expected = config.pop(CHECKSUM, None)
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    if found != expected:
        raise LRMError(
            f"{path} is damaged or belongs to another model: its SHA-256 begins with {found[:12]}, "
            f"{described.name} says {str(expected)[:12]}; install the package again"
        )
    return load(config, path), path
