"""The configuration files, composed by Hydra. Imports fast, without torch."""

import difflib
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from xplanes.errors import ConfigError
from xplanes.settings import at_home

_PACKAGE = Path(__file__).resolve().parent
CONF = _PACKAGE / "conf" if (_PACKAGE / "conf").is_dir() else _PACKAGE.parent / "conf"
"""The configuration files: inside an installed package, beside it in a checkout."""


NAMES = (
    *("data.root", "data.scene", "data.cache", "data.masks", "data.images", "data.model"),
    *("data.times", "lrm.weights", "lrm.config", "lrm.triplanes", "preparation.cache"),
    *("resume", "hydra.run.dir", "hydra.sweep.dir", "run", "pool.root", "init_from"),
)
"""Settings whose values are names or paths, even if they look like numbers or lists."""

VALUE = re.compile(r"""('(?:\\.|[^'\\])*'|"(?:\\.|[^"\\])*"|[^,]*),""")
"""A value before a comma, which may be in quotes."""

ELSEWHERE = {
    "gpus": "trainer=ddp trainer.devices={}",
    "lr": "model.plane_lr={}",
    "batch_size": "model.rays.per_batch={}",
    "epochs": "+trainer.max_epochs={}",
    "iterations": "trainer.max_steps={}",
    "device": "trainer.accelerator={}",
    "output_dir": "hydra.run.dir={}",
    "entry": "model={}",
    "world_variation": "model.loss.total_variation_with_background={}",
    "world_time": "model.loss.time_factor_with_background={}",
    "world_threshold": "model.sampler.threshold_with_background={}",
}
"""Settings by their names in other programs or earlier versions; {} stands for the value."""

LAUNCHERS = ("joblib", "submitit_local", "submitit_slurm")
"""Hydra's launchers that the extra ``sweep`` installs."""

_PLAIN = re.compile(r"(?!\.\d)[A-Za-z_./][A-Za-z0-9_./-]*")
"""Text that Hydra reads verbatim; all other text needs quotes."""

_WORDS = ("null", "none", "true", "false", "inf", "nan")
"""Words that Hydra does not read as text unless they are quoted."""


def compose_plain(name: str | None, overrides: Sequence[str]) -> dict[str, Any]:
    """A configuration with some settings changed, resolved to builtins.

    Args:
        name: Its file in ``conf``, without suffix; None for an empty configuration.
        overrides: ``key=value`` each.

    Raises:
        ConfigError: For a key or option that does not exist, or an override that is not a string.
    """
    from hydra import compose

    for override in overrides:
        if not isinstance(override, str):
            raise ConfigError(
                f"compose({override!r}): pass each setting as one string, as in "
                'compose("model=nine_planes", "lrm=none")'
            )
    with _hydra(name, overrides):
        return to_plain(compose(name, [with_names(override) for override in overrides]))


def group_options(group: str, overrides: Sequence[str] = ()) -> list[str]:
    """Names of a group's options, including those from ``hydra.searchpath``.

    Args:
        group: The group, such as ``data``.
        overrides: ``key=value`` each.

    Raises:
        ConfigError: For overrides that Hydra cannot read.
    """
    from hydra.core.global_hydra import GlobalHydra

    with _hydra("train", overrides):
        loader = GlobalHydra.instance().config_loader()
        return loader.get_group_options(group, config_name="train", overrides=list(overrides))


@contextmanager
def _hydra(name: str | None, overrides: Sequence[str]) -> Iterator[None]:
    """Initialise a separate Hydra; its errors suggest names similar to an unknown one."""
    from hydra.errors import HydraException

    try:
        with _initialized():
            yield
    except HydraException as error:
        near = near_names(overrides, name)
        raise ConfigError("\n".join(filter(None, (str(error), near)))) from error


@contextmanager
def _initialized() -> Iterator[None]:
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.plugins import Plugins
    from hydra.core.singleton import Singleton

    Plugins.instance()  # Plug-ins register themselves in the state that is saved next.
    # Inside a job Hydra is already initialised; its state is restored afterwards.
    outer = Singleton.get_state()
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            yield
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


def key_and_value(override: str) -> tuple[str, str]:
    """Key and value of an override; both are empty for any other argument."""
    key, equals, value = override.partition("=")
    return (key.lstrip("+~"), value) if equals and not key.startswith("-") else ("", "")


def without(overrides: Iterable[str], *groups: str) -> list[str]:
    """Sorted overrides, without those of the given settings and groups."""
    return sorted(t for t in overrides if t and key_and_value(t)[0].split(".")[0] not in groups)


def settings_and_paths(arguments: Sequence[str]) -> tuple[list[str], list[Path]]:
    """Splits the words of a command line into settings, and files or folders."""
    changed = [text for text in arguments if "=" in text and not Path(text).exists()]
    return changed, [Path(text) for text in arguments if text not in changed]


def quoted(text: str) -> str:
    """Text in quotes and escapes, so that Hydra reads it unchanged in an override."""
    if _PLAIN.fullmatch(text) and text.lower() not in _WORDS:
        return text
    # Backslashes need escaping only before a quote, the closing one included.
    escaped = re.sub(r"(\\+)$", r"\1\1", re.sub(r"(\\*)'", r"\1\1\'", text))
    return f"'{escaped}'"


def unquoted(text: str) -> str:
    """The value of an override as text: the inverse of `quoted`."""
    if text[:1] not in ("'", '"'):
        return text
    from hydra.core.override_parser.overrides_parser import OverridesParser

    return str(OverridesParser.create().parse_override(f"key={text}").value())


def with_names(override: str, *, several: bool = False) -> str:
    """An override with its name or path quoted for Hydra and ``~`` expanded.

    Unquoted, Hydra would read 2024_05_01 as a number, and reject accents, spaces and brackets.

    Args:
        override: ``key=value``; anything else is returned unchanged.
        several: Whether a comma separates values, as in a multirun.
    """
    key, equals, value = override.partition("=")
    if not equals or key.lstrip("+~") not in NAMES:
        return override
    if (_is_quoted(value) and not several) or "${" in value or value.lower() in ("", "null"):
        return override
    if "(" in value and re.fullmatch(r"(choice|range|interval|glob|sort|shuffle)\(.*\)", value):
        return override
    if "," in value and not several and key.lstrip("+~") == "data.scene":
        return override  # Hydra's own error says that several scenes need --multirun.
    parts = VALUE.findall(f"{value},") if several else [value]
    parts = [part if _is_quoted(part) else quoted(at_home(part)) for part in parts]
    return f"{key}={','.join(parts)}"


def _is_quoted(value: str) -> bool:
    return value[:1] in ("'", '"') and value[:1] == value[-1:]


def near_names(overrides: Sequence[str], name: str | None = "train") -> str:
    """Suggestions for the first override with an unknown option or key; empty if there is none.

    Args:
        overrides: ``key=value`` each.
        name: File of the configuration in ``conf``, without suffix.
    """
    from hydra import compose
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException
    from omegaconf import OmegaConf

    try:
        parsed = OverridesParser.create().parse_overrides(list(overrides))
        chosen = [
            str(each.input_line) for each in parsed if each.key_or_group == "hydra.searchpath"
        ]
        keys = {}
        with _initialized():
            loader = GlobalHydra.instance().config_loader()
            search = list(chosen)
            for each in parsed:
                group = each.key_or_group
                options = loader.get_group_options(group, config_name=name, overrides=search)
                if not options:
                    known = each.is_add() or each.is_force_add() or group.startswith("hydra.")
                    keys |= {} if known else {group: each.get_value_element_as_str()}
                    continue
                swept = each.is_sweep_override()
                values = list(each.sweep_string_iterator()) if swept else [each.value()]
                for option in values:
                    if isinstance(option, str) and option not in options:
                        if group == "hydra/launcher" and option in LAUNCHERS:
                            return (
                                f"{group}={option} is not installed: pip install "
                                '"xplanes[sweep]"; in a checkout: pip install -e ".[sweep]"'
                            )
                        named = {f"{group}={name}": name for name in options}
                        if group == "experiment":
                            sweeps = loader.get_group_options("sweep", config_name=name)
                            named |= {f"-m sweep={sweep}": sweep for sweep in sweeps}
                        near = difflib.get_close_matches(option, named.values(), n=1)
                        meant = [each for each, name in named.items() if name in near]
                        meant = meant or _described(group, option)
                        return f"Did you mean {' or '.join(meant)}?" if meant else ""
                line = str(each.input_line)
                chosen.append(f"{line.partition('=')[0]}={values[0]}" if swept else line)
            config = OmegaConf.to_container(compose(name, chosen, return_hydra_config=True))
    except HydraException:
        return ""
    assert isinstance(config, dict)
    hydra = config.pop("hydra")
    groups = [str(group).partition("@")[0] for group in hydra["runtime"]["choices"]]
    known = {*_names(config), *(group for group in groups if not group.startswith("hydra/"))}
    key = next((key for key in keys if key not in known), None)
    if key is None:
        return ""
    if options := _options_with(key, groups):
        return f"{key} belongs to {' and '.join(options)}, which is not selected"
    prefix, _, last = key.rpartition(".")
    if last in ELSEWHERE:
        return f"Did you mean {ELSEWHERE[last].format(keys[key])}?"
    beside = [each for each in known if each.rpartition(".")[0] == prefix]
    alike = [each for each in known if each.rpartition(".")[2] == last]
    near = (
        difflib.get_close_matches(key, beside, n=3, cutoff=0.75)
        or difflib.get_close_matches(key, alike, n=3, cutoff=0)
        or difflib.get_close_matches(key, sorted(known), n=3, cutoff=0.6)
    )
    return f"Did you mean {' or '.join(near)}?" if near else ""


def _described(group: str, word: str) -> list[str]:
    """Options whose first comment begins with ``word``, and the beginning of that comment."""
    found = []
    for path in sorted((CONF / group).glob("*.yaml")):
        words = re.match("# ([^.,:]+)", path.read_text(encoding="utf-8"))
        if words and words[1].lower().startswith(word.lower()):
            found.append(f"{group}={path.stem} ({words[1]})")
    return found


def _names(node: Any, prefix: str = "") -> Iterator[str]:
    """Dotted names of settings and of the nodes above them."""
    for key, value in node.items() if isinstance(node, dict) else ():
        yield f"{prefix}{key}"
        yield from _names(value, f"{prefix}{key}.")


def _options_with(key: str, groups: Sequence[str]) -> list[str]:
    """Options of the given groups whose files set ``key``."""
    import yaml

    return sorted(
        f"{group}={path.stem}"
        for group in groups
        if key.startswith(prefix := f"{group.replace('/', '.')}.")
        for path in (CONF / group).glob("*.yaml")
        if key.removeprefix(prefix) in _names(yaml.safe_load(path.read_text(encoding="utf-8")))
    )
