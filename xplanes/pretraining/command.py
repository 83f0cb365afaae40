"""From overrides on the command line to a pretraining."""

from collections.abc import Callable, Sequence
from pathlib import Path

from xplanes.config import compose_plain
from xplanes.pretraining.settings import PretrainConfig, parse_pretraining


def compose_pretraining(overrides: Sequence[str]) -> dict:
    """The configuration as builtins.

    Raises:
        ConfigError: For a key or option that does not exist, or a value of another type.
    """
    from hydra.core.config_store import ConfigStore

    ConfigStore.instance().store(name="pretrain_schema", node=PretrainConfig)
    return compose_plain("pretrain_lrm", overrides)


def run_pretraining(overrides: Sequence[str], announce: Callable[[str], None]) -> Path:
    """Train a small model of our own; returns its weights.

    Raises:
        ConfigError: If settings cannot work.
    """
    plain = compose_pretraining(overrides)
    config = parse_pretraining(plain)
    from xplanes.pretraining.run import pretrain

    return pretrain(plain, config, announce)
