"""Weights of a model: bundled ones, a local file, the hub's cache, or the hub."""

import hashlib
import json
import os
import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import getproxies, proxy_bypass

import yaml

from xplanes.errors import LRMError
from xplanes.files import stand_in
from xplanes.lrm.checkpoint import MismatchError, load
from xplanes.lrm.model import LRM
from xplanes.optional import require
from xplanes.settings import Count, Location, Settings

PATIENCE_SECONDS = 3.0
"""Time for name lookup and connection; a refusal ends the wait early."""


def answers(url: str) -> bool:
    """Whether a server, or the proxy to it, accepts a connection within `PATIENCE_SECONDS`.

    Checked before a download, because the hub's own client retries for half a minute.

    Args:
        url: Address of the server, http or https.
    """
    parts = urlsplit(url)
    proxies = getproxies()
    proxy = proxies.get(parts.scheme) or proxies.get("all")
    if proxy and not proxy_bypass(parts.hostname or ""):
        parts = urlsplit(proxy if "//" in proxy else f"//{proxy}")
    port = parts.port or {"https": 443, "http": 80}.get(parts.scheme, 1080)
    accepted = threading.Event()

    def connect() -> None:
        address = (parts.hostname or "", port)
        with suppress(OSError), socket.create_connection(address, PATIENCE_SECONDS):
            accepted.set()

    # The name lookup has no time limit, hence the thread.
    thread = threading.Thread(target=connect, daemon=True)
    thread.start()
    thread.join(PATIENCE_SECONDS)
    return accepted.is_set()


CONFIG_FILES = ("config.json", "config.yaml")


@dataclass(frozen=True, kw_only=True)
class WeightSource(Settings):
    """Source of a published model's weights: the Hugging Face hub, or a local file."""

    architecture: str  # One of openlrm-{small,base,large}-{1.0,1.1} and triposr.
    repository: str  # Repository on the Hugging Face hub.
    file: str  # File name of the weights in the repository.
    revision: str  # Branch, tag or commit of the repository.
    licence: str  # Licence of the weights.
    megabytes: Count  # Size of the file in MB.
    weights: Location | None  # Local file of weights; null: downloaded or bundled weights.
    config: Location | None  # A config.json or config.yaml for weights of another model size.

    @property
    def url(self) -> str:
        """Address of the file on the hub."""
        return f"https://huggingface.co/{self.repository}/resolve/{self.revision}/{self.file}"


def load_weights(
    source: WeightSource, path: Path, *, announce: Callable[[str], None] = print
) -> LRM:
    """Load the weights of a model from a file that `find_weights` found.

    Weights of other than the published sizes need a configuration: ``source.config``, or a
    config.json or config.yaml in the folder of the weights.

    Raises:
        LRMError: If they do not fit the architecture.
    """
    if source.config is not None:
        return load(read_config(Path(source.config)), path)
    try:
        return load({"architecture": source.architecture}, path)
    except MismatchError as problem:
        beside = [path.parent / name for name in CONFIG_FILES if (path.parent / name).is_file()]
        # Weights of another published model are an error, even if a configuration exists.
        if problem.fits or not beside or source.weights is None:
            raise
        announce(f"{path} does not have the published sizes: using {beside[0]}")
        return load(read_config(beside[0]), path)


def find_weights(
    source: WeightSource,
    *,
    announce: Callable[[str], None] = print,
    endpoint: str | None = None,
    cache: Path | None = None,
) -> Path:
    """Find the weights of a model; download them if necessary.

    Args:
        source: Source of the weights.
        announce: Receives a message before a download.
        endpoint: Address of the hub; the default when None.
        cache: The hub's cache; the default when None.

    Returns:
        A local file, or one in the hub's cache.

    Raises:
        LRMError: If the local file is missing, the hub cannot be reached, or the hub lacks it.
    """
    if source.weights is not None:
        if not (path := Path(source.weights)).is_file():
            raise LRMError(f"lrm.weights={path} is not a file. {_advice(source)}")
        return path
    hub = require("huggingface_hub", extra="lrm")
    place = {"repo_id": source.repository, "filename": source.file, "revision": source.revision}
    cached = hub.try_to_load_from_cache(**place, cache_dir=cache)
    if isinstance(cached, str):
        return Path(cached)
    if hub.constants.HF_HUB_OFFLINE or os.environ.get("HF_HUB_OFFLINE", "").upper() in _YES:
        raise LRMError(f"HF_HUB_OFFLINE forbids the download of {source.url}. {_advice(source)}")
    server = endpoint or hub.constants.ENDPOINT
    if not answers(server):
        raise LRMError(f"{server} cannot be reached for {source.file}. {_advice(source)}")
    announce(
        f"Downloading {source.repository}/{source.file} ({source.megabytes} MB, licence "
        f"{source.licence})"
    )
    try:
        return Path(hub.hf_hub_download(**place, cache_dir=cache, endpoint=endpoint))
    except Exception as problem:  # the hub's errors have no common class
        reason = " ".join(str(problem).split())[:300]
        raise LRMError(
            f"{source.url} cannot be downloaded ({type(problem).__name__}: {reason}). "
            f"{_advice(source)}"
        ) from problem


_YES = {"1", "ON", "YES", "TRUE"}


def read_config(path: Path) -> dict[str, Any]:
    """A published config.json or config.yaml.

    Raises:
        LRMError: If it cannot be read.
    """
    if (other := stand_in(path)) is not None:
        raise LRMError(f"{path} {other}")
    try:
        text = path.read_text(encoding="utf-8")
        content = json.loads(text) if path.suffix == ".json" else yaml.safe_load(text)
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as problem:
        raise LRMError(f"{path} cannot be read: {problem}") from problem
    if not isinstance(content, dict):
        raise LRMError(f"{path} is not a configuration: it has no keys")
    return content


def _advice(source: WeightSource) -> str:
    return (
        f"{source.architecture} needs weights of {source.megabytes} MB (licence {source.licence}): "
        f"download {source.url} on a machine with a network and set lrm.weights=FILE, or train "
        f"without them: lrm=none"
    )


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
            f"{described.name} says {str(expected)[:12]}; restore both files"
        )
    return load(config, path), path
