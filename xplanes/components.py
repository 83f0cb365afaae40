"""Builds objects from configuration nodes; no other module resolves class names."""

import importlib
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar, cast, get_args, get_origin

from xplanes.config import to_plain
from xplanes.errors import ConfigError
from xplanes.settings import Settings, check_arguments, hints_of, kinds_of

T = TypeVar("T")
S = TypeVar("S", bound=Settings)

TRUSTED = ("xplanes", "lightning", "torchmetrics")
"""Packages whose classes any configuration may name."""

MOVED = {
    "xplanes.evaluation.live": "xplanes.tools.live",
    "xplanes.evaluation.table": "xplanes.tools.table",
    "xplanes.models.densification": "xplanes.baselines.gaussians.densification",
    "xplanes.models.gaussians": "xplanes.baselines.gaussians.model",
    "xplanes.models.gaussians_deform": "xplanes.baselines.gaussians.deform",
    "xplanes.models.gaussians_hexplane": "xplanes.baselines.gaussians.hexplane",
    "xplanes.models.gaussians_spacetime": "xplanes.baselines.gaussians.spacetime",
    "xplanes.models.kplanes": "xplanes.baselines.kplanes.model",
    "xplanes.models.tensor4d": "xplanes.baselines.tensor4d.model",
    "xplanes.models.tineuvox": "xplanes.baselines.tineuvox.model",
    "xplanes.preparation.points": "xplanes.baselines.gaussians.points",
    "xplanes.pretraining.settings": "xplanes.synthetic.pretraining.settings",
    "xplanes.rendering.fixed_step": "xplanes.baselines.tineuvox.fixed_step",
    "xplanes.rendering.gaussians.renderer": "xplanes.baselines.gaussians.renderer",
    "xplanes.rendering.neus": "xplanes.baselines.tensor4d.neus",
    "xplanes.rendering.proposal": "xplanes.baselines.proposal",
    **{
        f"xplanes.scenes.{name}": f"xplanes.readers.{name}"
        for name in ("colmap", "dnerf", "llff", "multicamera", "nerfies", "nerfstudio")
    },
    "xplanes.scenes.demo.write": "xplanes.synthetic.demo.write",
}
"""Old names of modules in runs and checkpoints of early 0.3, and their current names."""

_plugins: ContextVar[tuple[str, ...]] = ContextVar("plugins", default=())


@contextmanager
def plugins(modules: Sequence[str]) -> Iterator[None]:
    """Allow configurations to name classes of the user's own modules, too.

    Args:
        modules: Names of modules or packages that the user asked for. They are imported.

    Raises:
        ConfigError: If one cannot be imported.
    """
    if isinstance(modules, str):
        raise ConfigError(f"plugins={modules}: must be a list, plugins=[{modules}]")
    for name in modules:
        try:
            importlib.import_module(name)
        except ImportError as error:
            raise ConfigError(
                f"plugins: {name} cannot be imported ({error}): it must be on Python's path "
                "(PYTHONPATH=FOLDER)"
            ) from error
    token = _plugins.set((*_plugins.get(), *modules))
    try:
        yield
    finally:
        _plugins.reset(token)


def build(node: Mapping[str, Any], kind: type[T], key: str, **more: Any) -> T:
    """The object that a node describes.

    Args:
        node: Its class as ``_target_``, and its arguments. Settings without alternatives may leave
            ``_target_`` out.
        kind: Required base class.
        key: Dotted name of the node, for messages.
        **more: Further arguments.

    Raises:
        ConfigError: If the class is not allowed here, or rejects its arguments.
    """
    from hydra.errors import InstantiationException
    from hydra.utils import instantiate
    from omegaconf import DictConfig

    if isinstance(node, DictConfig):
        node = to_plain(node)
    if not isinstance(node, Mapping):
        raise ConfigError(f"{key}={node}: must be a mapping")
    target = node.get("_target_")
    if target is None:
        if not issubclass(kind, Settings):
            raise ConfigError(f"{key}._target_: it is not set; name a class as module.Class")
        cls: type = kind
    else:
        cls = class_of(target, kind, f"{key}._target_")
    arguments = {name: value for name, value in node.items() if name != "_target_"}
    try:
        if issubclass(cls, Settings):
            # Faster than `instantiate`, with the same result.
            return cast(T, read_settings(cls, {**arguments, **more}))
        for name, value in arguments.items():
            if isinstance(value, Mapping) and "_target_" in value:
                raise ConfigError(
                    f"{name}._target_={value['_target_']}: {cls.__name__} takes plain values here; "
                    "name a class of your own that builds this object (plugins)"
                )
        if cls.__module__.startswith("xplanes."):
            check_arguments(cls.__init__, arguments)
        # Passed as a dict: an argument may share a name with one of `instantiate`, such as config.
        whole = {**arguments, "_target_": cls, "_recursive_": False, "_convert_": "all"}
        return instantiate(whole, **more)
    except ConfigError as error:
        raise ConfigError(f"{key}.{error}") from None
    except InstantiationException as error:
        cause = error.__cause__
        if isinstance(cause, ConfigError):
            raise ConfigError(f"{key}.{cause}") from None
        unknown = re.search(r"unexpected keyword argument '(\w+)'", str(cause))
        if isinstance(cause, TypeError) and unknown and (name := unknown[1]) in arguments:
            raise ConfigError(
                f"{key}.{name}={arguments[name]}: {cls.__name__} has no such argument; leave it out"
            ) from error
        raise ConfigError(f"{key}: {cause or error}") from error


def read_settings(cls: type[S], values: Mapping[str, Any]) -> S:
    """Settings, and those nested in them, from builtins.

    Raises:
        ConfigError: For a name that does not exist or is missing, or a value out of range.
    """
    cls.require_names(values)
    hints = dict(hints_of(cls))
    return cls(**{name: _nested(name, value, hints[name]) for name, value in values.items()})


def _nested(key: str, value: Any, hint: Any) -> Any:
    """A value, converted to nested settings where its type asks for them."""
    kinds, _ = kinds_of(hint)
    if isinstance(value, Mapping):
        for kind in kinds:
            if isinstance(kind, type) and issubclass(kind, Settings):
                return build(value, kind, key)
    if isinstance(value, list | tuple):
        items = [get_args(kind)[0] for kind in kinds if get_origin(kind) in (list, Sequence)]
        return [_nested(key, item, items[0]) for item in value] if items else value
    return value


def class_of(target: Any, kind: type, key: str) -> type:
    """The class of a dotted name, if it is allowed in that place.

    Args:
        target: The name, as module.Class.
        kind: Required base class.
        key: Dotted name of the setting, for messages.

    Raises:
        ConfigError: If there is no such class, or it is not allowed there.
    """
    name = str(target)
    allowed = (*TRUSTED, *_plugins.get())
    if not any(name == root or name.startswith(f"{root}.") for root in allowed):
        raise ConfigError(
            f"{key}={name}: only classes of {', '.join(allowed)} are allowed here; name a module "
            "of your own with plugins=[MODULE], or --plugin MODULE for commands that read a run"
        )
    module, _, attribute = name.rpartition(".")
    module = MOVED.get(module, module)
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"{key}={name}: there is no such class ({error})") from error
    if not (isinstance(found, type) and issubclass(found, kind)):
        raise ConfigError(
            f"{key}={name}: must be a class derived from {kind.__module__}.{kind.__qualname__}"
        )
    # A trusted module also contains names that it has only imported.
    if not any(f"{found.__module__}.".startswith(f"{root}.") for root in allowed):
        raise ConfigError(
            f"{key}={name}: it is defined in {found.__module__}, which is not allowed"
        )
    return found
