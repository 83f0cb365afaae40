"""Training from the command line: checks, resumed runs, and the job that Hydra runs.

Must stay quick: it imports neither torch nor lightning before the job begins.
"""

import difflib
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hydra
import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from xplanes.checks import parse
from xplanes.config import (
    CONF,
    ConfigError,
    TrainConfig,
    compose_plain,
    register_schemas,
    to_plain,
)
from xplanes.files import StorageError, read_json, require_writable
from xplanes.schemas.families import XPLANES_RATES

_OVERRIDE = re.compile(r"^(?P<mark>\+\+?|~)?(?P<key>[\w./@-]+)=(?P<value>.*)$", re.DOTALL)


def train(arguments: Sequence[str], words: Sequence[str] = ()) -> None:
    """Run one job of training, or a multirun.

    Args:
        arguments: Overrides and options of Hydra.
        words: What stands before them on the command line, after the program.

    Raises:
        SystemExit: With a message after an error that was explained, or 130 after Ctrl-C.
    """
    register_schemas()
    try:
        prepared = prepare(list(arguments))
    except (ConfigError, StorageError) as error:
        sys.exit(f"error: {error}")
    program = sys.argv[0]

    def job(config: DictConfig) -> float:
        # Lightning starts the other processes of a distributed run with this command line.
        sys.argv = [program, *words, *prepared]
        return _job(config)

    sys.argv = [program, *prepared]
    hydra.main(config_path=str(CONF), config_name="train", version_base="1.3")(job)()


def _job(config: DictConfig) -> float:
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


def prepare(arguments: list[str], conf: Path = CONF) -> list[str]:
    """Check overrides and turn ``resume=`` into the overrides of the run that goes on.

    Args:
        arguments: Overrides and options of Hydra.
        conf: The configuration folder.

    Returns:
        Arguments for Hydra.

    Raises:
        ConfigError: For an unknown key, with near matches, or a run that cannot be resumed.
        StorageError: If the folder of the run cannot be written.
    """
    check_keys(arguments, conf)
    values = dict(_split(arguments))
    if not _is_multirun(arguments) and _is_sweep(values.get("experiment", ""), conf):
        # Hydra from 1.4 on takes the mode from here, not from the experiment's file.
        arguments = [*arguments, "--multirun"]
    resume = values.get("resume", "null")
    if resume in ("null", "", "None", "auto"):
        place = "hydra.sweep.dir" if _is_multirun(arguments) else "hydra.run.dir"
        require_writable(Path(values.get(place, "outputs")))
    if resume in ("null", "", "None"):
        return arguments
    folder = values.get("hydra.run.dir")
    if folder is not None:
        folder = folder.strip("\"'")  # As Lightning hands it on to the other processes of a run.
    if resume == "auto":
        if _is_multirun(arguments):
            return arguments
        own = [a for a in arguments if not a.startswith("resume=")]
        found = Path(folder) if folder else _latest(Path("outputs"), own)
        if found is None or not (found / "run.json").is_file():
            return [*own, "resume=null"]
        resume = str(found)
    if _is_multirun(arguments):
        raise ConfigError(f"resume={resume} with --multirun: resume one run at a time, or auto")
    if folder is not None and Path(folder).resolve() != Path(resume).resolve():
        raise ConfigError(
            f"resume={resume} with hydra.run.dir={folder}: a run goes on in its own folder; leave "
            "hydra.run.dir out"
        )
    return _resumed(Path(resume), arguments)


def _resumed(run: Path, arguments: list[str]) -> list[str]:
    """The run's own overrides, then the new ones, in the run's own folder."""
    path = run / "overrides.txt"
    if not path.is_file():
        raise ConfigError(f"resume={run}: not a run directory, no overrides.txt in it")
    require_writable(run)
    text = path.read_text(encoding="utf-8")
    if text and not text.endswith("\n"):
        raise ConfigError(
            f"{path} is damaged: its last line is cut short. Mend it from {run / 'config.yaml'}, "
            "one key=value a line"
        )
    new = [a for a in arguments if not a.startswith(("resume=", "hydra.run.dir="))]
    changed = {key for key, _ in _split(new)}
    old = [
        line
        for line in text.splitlines()
        if line and not {key for key, _ in _split([line])} & changed
    ]
    return [*old, *new, f"hydra.run.dir={run}", f"resume={run}"]


def _latest(outputs: Path, overrides: list[str]) -> Path | None:
    """The newest unfinished run with the same overrides."""
    wanted = sorted(overrides)
    for record in sorted(outputs.glob("*/run.json"), key=_mtime, reverse=True):
        listed = record.parent / "overrides.txt"
        try:
            done = read_json(record).get("status") == "finished"
            same = sorted(filter(None, listed.read_text().splitlines())) == wanted
        except (OSError, ValueError):
            continue
        if same and not done:
            return record.parent
    return None


def _mtime(path: Path) -> float:
    return path.stat().st_mtime


def settings(overrides: list[str], conf: Path = CONF) -> TrainConfig:
    """The settings of train.py with some of them changed.

    Raises:
        ConfigError: If a setting does not exist or cannot work.
    """
    check_keys(overrides, conf)
    return parse(compose_plain("train", overrides, conf))


def check_keys(arguments: list[str], conf: Path = CONF) -> None:
    """Refuse overrides of keys that do not exist, naming those that are spelled alike."""
    groups = {str(p.relative_to(conf)) for p in conf.rglob("*") if p.is_dir()}
    pairs = [
        (match["key"], match["value"])
        for match in map(_OVERRIDE.match, arguments)
        if match and not match["mark"] and not match["key"].startswith("hydra")
    ]
    chosen = [f"{key}={value.split(',')[0]}" for key, value in pairs if key in groups]
    keys = _known_keys(conf, chosen)
    for key, _ in pairs:
        if "model.family" in keys and key in XPLANES_RATES:
            own = sorted(name for name in keys if re.match(r"model\..*learning_rate", name))
            raise ConfigError(f"{key}: only X-Planes use it; this model has {', '.join(own)}")
        if key in groups or key in keys:
            continue
        if any(known.startswith(f"{key}.") for known in keys):
            continue
        near = difflib.get_close_matches(key, sorted(keys | groups), n=3, cutoff=0.5)
        near = near or [k for k in sorted(keys) if k.rsplit(".", 1)[-1] == key.rsplit(".", 1)[-1]]
        hint = f" Did you mean {' or '.join(near)}?" if near else ""
        raise ConfigError(
            f"{key}: there is no such setting.{hint} All are in docs/configuration.md"
        )


def _known_keys(conf: Path, overrides: list[str]) -> set[str]:
    """Dotted names of all settings under a choice of groups."""
    from hydra import compose, initialize_config_dir
    from hydra.errors import HydraException
    from omegaconf import OmegaConf

    register_schemas()
    try:
        with initialize_config_dir(str(conf), version_base="1.3"):
            config = compose("train", overrides)
    except HydraException:
        # An unknown option of a group: Hydra's own message lists those that exist.
        with initialize_config_dir(str(conf), version_base="1.3"):
            config = compose("train")
    return set(_dotted(OmegaConf.to_container(config, resolve=False)))


def _dotted(node: Any, prefix: str = "") -> list[str]:
    if not isinstance(node, dict):
        return [prefix]
    names = []
    for key, value in node.items():
        names += _dotted(value, f"{prefix}.{key}" if prefix else str(key))
    return names


def _split(arguments: list[str]) -> list[tuple[str, str]]:
    matches = map(_OVERRIDE.match, arguments)
    return [(match["key"], match["value"]) for match in matches if match]


def _is_multirun(arguments: list[str]) -> bool:
    return not {"-m", "--multirun", "hydra.mode=MULTIRUN"}.isdisjoint(arguments)


def _is_sweep(experiment: str, conf: Path) -> bool:
    """Whether the experiment's file says that it is a multirun."""
    path = conf / "experiment" / f"{experiment}.yaml"
    if not path.is_file():
        return False
    content = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    return (content.get("hydra") or {}).get("mode") == "MULTIRUN"
