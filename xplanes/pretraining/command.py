"""From overrides on the command line to a pretraining."""

from collections.abc import Callable, Sequence
from pathlib import Path

from xplanes.config import ConfigError, to_plain
from xplanes.pretraining.settings import PretrainConfig, parse_pretraining

CONF = Path(__file__).resolve().parents[2] / "conf"


def compose_pretraining(overrides: Sequence[str]) -> dict:
    """The configuration as builtins.

    Raises:
        ConfigError: For a key or option that does not exist, or a value of another type.
    """
    from hydra import compose, initialize_config_dir
    from hydra.core.config_store import ConfigStore
    from hydra.errors import HydraException

    ConfigStore.instance().store(name="pretrain_schema", node=PretrainConfig)
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            return to_plain(compose("pretrain_lrm", list(overrides)))
    except HydraException as problem:
        raise ConfigError(
            f"{problem}. All settings are in docs/configuration.md, models in conf/pretrain/"
        ) from problem


def run_pretraining(overrides: Sequence[str], announce: Callable[[str], None]) -> Path:
    """Train a small model of our own; returns its weights.

    Raises:
        ConfigError: If settings cannot work.
    """
    plain = compose_pretraining(overrides)
    config = parse_pretraining(plain)
    from xplanes.pretraining.run import pretrain

    return pretrain(plain, config, announce)
