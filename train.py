"""Reconstruct a dynamic scene: `python train.py key=value ...`."""

import os
import sys
from pathlib import Path

from xplanes.threads import waiting

os.environ.update(waiting(os.environ))  # before torch is loaded

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from xplanes.config import ConfigError, register_schemas, to_plain
from xplanes.files import StorageError
from xplanes.launch import prepare


@hydra.main(config_path="conf", config_name="train", version_base="1.3")
def main(config: DictConfig) -> float:
    """Run one job; the score goes to sweepers."""
    from xplanes.pipeline import KNOWN_ERRORS, run

    settings = HydraConfig.get()
    sweep = settings.mode == RunMode.MULTIRUN
    folder = Path(settings.runtime.output_dir)
    try:
        plain = to_plain(config)
        if sweep and plain["trainer"]["devices"] > 1:
            raise ConfigError(
                "trainer.devices > 1 in a multirun: helper processes would start the whole sweep "
                "again. Use one device per job, with hydra/launcher=joblib for several at a time"
            )
        auto = plain["resume"] == "auto" and (folder / "run.json").is_file()
        resume = auto or plain["resume"] not in (None, "auto")
        return run(plain, folder, list(settings.overrides.task), resume=resume)
    except KNOWN_ERRORS as error:
        if sweep:
            raise
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    register_schemas()
    try:
        sys.argv[1:] = prepare(sys.argv[1:])
    except (ConfigError, StorageError) as error:
        sys.exit(f"error: {error}")
    main()
