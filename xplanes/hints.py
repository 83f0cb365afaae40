"""Clear errors for command lines that Hydra answers with a traceback. Must import without torch."""

import re
import shlex
from collections.abc import Sequence

from xplanes.config import CONF, near_names, quoted
from xplanes.errors import ConfigError


def require_readable(arguments: Sequence[str]) -> list[str]:
    """Refuse arguments that are neither ``key=value`` nor an option of Hydra.

    Returns:
        The arguments; options come last if they stood between settings, which Hydra cannot read.

    Raises:
        ConfigError: With the arguments that were probably meant.
    """
    from hydra._internal.utils import get_args_parser

    chosen, others = get_args_parser().parse_known_args(list(arguments))
    if option := next((word for word in others if word.startswith("-")), None):
        key, equals, value = option.lstrip("-").replace("-", "_").partition("=")
        after = [*arguments, ""][list(arguments).index(option) + 1]
        if not equals and after and after[0] != "-" and "=" not in after:
            value = after
        meant = f"{key}={value or '...'}"
        words = filter(None, (f"{option}: write {_in_shell(meant)}", near_names([meant])))
        raise ConfigError(". ".join(words))
    words = [*chosen.overrides, *others]
    _require_pairs(words)
    if chosen.multirun and (shows := (chosen.cfg and "--cfg") or (chosen.info and "--info")):
        raise ConfigError(
            f"-m with {shows}: Hydra shows one run; leave -m out, and give each key one value"
        )
    options = [word for word in arguments if word not in words]
    return [*words, *options] if others else list(arguments)


def _require_pairs(words: Sequence[str]) -> None:
    """Refuse words that are not overrides, such as a value that the shell split at a space."""
    for number, word in enumerate(words):
        if "=" in word or word.startswith("~"):
            continue
        after = words[number + 1] if number + 1 < len(words) else ""
        if after and "=" not in after and _is_key(word):
            raise ConfigError(f"{word} {after}: write {_in_shell(f'{word}={after}')}")
        if number == 0 or _is_key(word):
            raise ConfigError(f"{word}: write key=value, such as data.scene=NAME or model=NAME")
        end = next((n for n in range(number, len(words)) if "=" in words[n]), len(words))
        whole = _in_shell(" ".join(words[number - 1 : end]))
        raise ConfigError(f"{word}: the shell has split a value at its space; write {whole}")


def _is_key(word: str) -> bool:
    """Whether a word looks like the name of a setting or of a group."""
    dotted = re.fullmatch(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)+", word)
    return dotted is not None or word in ("seed", "resume") or (CONF / word).is_dir()


def _in_shell(text: str) -> str:
    """Quote a word for the shell if needed, in double quotes (as in the manual) if possible."""
    plain = shlex.quote(text) == text or set(text) & set('"$`\\!')
    return shlex.quote(text) if plain else f'"{text}"'


def require_parsed(overrides: Sequence[str]) -> None:
    """Refuse values that Hydra cannot read.

    Raises:
        ConfigError: With the override in quotes.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    parser = OverridesParser.create()
    for override in overrides:
        key, _, value = override.partition("=")
        try:
            parser.parse_override(override)
        except HydraException as error:
            whole = _in_shell(f"{key}={quoted(value)}")
            raise ConfigError(f"{override}: Hydra cannot read the value; write {whole}") from error
