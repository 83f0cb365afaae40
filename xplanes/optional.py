"""Packages that only optional extras install."""

import importlib
from types import ModuleType

from xplanes.errors import XPlanesError


class MissingExtraError(XPlanesError, ImportError):
    """A package of an optional extra is not installed; the message names the extra."""


def require(module: str, *, extra: str) -> ModuleType:
    """Import ``module``, or say which extra installs it.

    Raises:
        MissingExtraError: If it is not installed; the message names the extra.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtraError(
            f'{module.split(".")[0]} is not installed: pip install "xplanes[{extra}]"; '
            f'in a checkout: pip install -e ".[{extra}]"'
        ) from error
