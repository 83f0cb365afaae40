"""The configuration files and what Hydra makes of them. Must stay quick: it imports no torch."""

import difflib
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from xplanes.errors import ConfigError

_PACKAGE = Path(__file__).resolve().parent
CONF = _PACKAGE / "conf" if (_PACKAGE / "conf").is_dir() else _PACKAGE.parent / "conf"
"""The configuration files: inside an installed package, beside it in a checkout."""


CHOICES = ("experiment", "entry", "recipe", "scale")
"""Groups whose files set keys of other groups."""


def compose_plain(name: str | None, overrides: Sequence[str], conf: Path = CONF) -> dict[str, Any]:
    """A configuration with some settings changed, resolved to builtins.

    Args:
        name: Its file in ``conf``, without ending; None for nothing but what ``overrides`` add.
        overrides: ``key=value`` each.
        conf: The configuration folder.

    Raises:
        ConfigError: For a key or option that does not exist.
    """
    from hydra import compose

    with _hydra(conf):
        return to_plain(compose(name, list(overrides)))


def group_options(
    group: str, overrides: Sequence[str] = (), name: str = "train", conf: Path = CONF
) -> list[str]:
    """Names of a group's options, those of the folders in ``hydra.searchpath`` included.

    Args:
        group: The group, such as ``data``.
        overrides: ``key=value`` each.
        name: File of the configuration in ``conf``, without ending.
        conf: The configuration folder.

    Raises:
        ConfigError: For overrides that Hydra cannot read.
    """
    from hydra.core.global_hydra import GlobalHydra

    with _hydra(conf):
        loader = GlobalHydra.instance().config_loader()
        return loader.get_group_options(group, config_name=name, overrides=list(overrides))


@contextmanager
def _hydra(conf: Path) -> Iterator[None]:
    """A Hydra of our own, whose errors say what is nearest to an unknown name."""
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.singleton import Singleton
    from hydra.errors import HydraException

    # Inside a job there is a Hydra already, which must be there again afterwards.
    outer = Singleton.get_state()
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(conf), version_base="1.3"):
            yield
    except HydraException as error:
        raise ConfigError(f"{error}{near_names(str(error), conf)}") from error
    finally:
        Singleton.set_state(outer)


def to_plain(config: Any) -> dict[str, Any]:
    """The resolved configuration as dicts, lists, numbers and strings, without Hydra's part."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    try:
        plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        raise ConfigError(" ".join(str(error).split())) from error
    assert isinstance(plain, dict)
    plain.pop("hydra", None)
    return {str(key): value for key, value in plain.items()}


def quoted(text: str) -> str:
    """Text as Hydra reads it in an override."""
    if re.fullmatch(r"[A-Za-z_./][\w./-]*", text):
        return text
    escaped = re.sub(r"(\\*)'", r"\1\1\'", text)
    return f"'{escaped}'"


def near_names(message: str, conf: Path = CONF) -> str:
    """Names that Hydra's message about an unknown key may have meant, as a sentence; or nothing."""
    key = next((word.strip("'\"") for word in message.split() if word.startswith("'")), "")
    marker = "Could not override '"
    if marker in message:
        key = message.split(marker, 1)[1].split("'", 1)[0]
    if not key or not ("." in key or "Key" in message or "override" in message):
        return ""
    names = _keys(conf)
    if (options := names.pop(key, set())) and "Could not override" in message:
        return f"\n{key} belongs to {' and '.join(sorted(options))}, not to what is chosen"
    near = difflib.get_close_matches(key, sorted(names), n=3, cutoff=0.6)
    last = key.rsplit(".", 1)[-1]
    near = near or [name for name in sorted(names) if name.rsplit(".", 1)[-1] == last][:5]
    return f"\nDid you mean {' or '.join(near)}?" if near else ""


def _keys(conf: Path) -> dict[str, set[str]]:
    """Dotted names of the settings of all files, each with the options that set it."""
    import yaml

    found: dict[str, set[str]] = {}

    def add(node: Any, prefix: str, option: str) -> None:
        if isinstance(node, dict):
            for key, value in node.items():
                if key not in ("defaults", "hydra", "_target_"):
                    add(value, f"{prefix}.{key}" if prefix else str(key), option)
        elif prefix:
            found.setdefault(prefix, set()).update([option] if option else [])

    for path in conf.rglob("*.yaml"):
        groups = path.relative_to(conf).parts[:-1]
        if groups and groups[0] in CHOICES:
            found.setdefault(groups[0], set())
            continue
        text = path.read_text(encoding="utf-8")
        prefix = "" if "_global_" in text.split("\n", 1)[0] else ".".join(groups)
        add(yaml.safe_load(text), prefix, f"{'/'.join(groups)}={path.stem}" if groups else "")
        if groups:
            found.setdefault("/".join(groups), set())
    return found
