"""Training from the command line: resumed runs, sweeps, and the job that Hydra runs.

For a fast start, neither torch nor lightning is imported before the job begins.
"""

import os
import re
import shlex
import sys
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from hydra.utils import to_absolute_path
from omegaconf import DictConfig, OmegaConf

import hydra_plugins.xplanes  # noqa: F401  # Launchers' processes need its resolvers.
from xplanes import __version__
from xplanes.config import (
    CONF,
    key_and_value,
    near_names,
    quoted,
    to_plain,
    unquoted,
    with_names,
    without,
)
from xplanes.errors import ConfigError, XPlanesError
from xplanes.files import StorageError, read_json, require_writable
from xplanes.process import STARTED, train_command

SEARCHPATH = "hydra.searchpath"

MAY_DIFFER = ("resume", "hydra", "trainer", "callbacks", "logger", "media", "viewer")
"""Settings that a resumed run may change: of the Trainer, its outputs and its folder."""

SHOWING = {
    *("--help", "-h", "--hydra-help", "--version", "--cfg", "-c", "--info", "-i"),
    *("--shell-completion", "-sc"),
}
"""Hydra's options that show something instead of running a job."""

FORMER = {
    "figure3": "sweep=rank data.scene=hook,lego lrm=xlarge",
    "figures5_7_9_10": "sweep=table1",
    "initialisation": "data.scene=excavator,walker,balls,windmill model=six_planes,nine_planes "
    "lrm=none,tiny,mini seed=0,1,2",
    "planes": "model=six_planes,nine_planes model.resolution=32,64,128",
    "table2": "sweep=tables2_3",
    "table3": "sweep=tables2_3",
    "views": "lrm=none,tiny data.views=5,10,20,null",
}
"""Old names of experiments and sweeps, each with the overrides that replace it."""


def train(arguments: Sequence[str], words: Sequence[str] = ()) -> None:
    """Run one training job, or a multirun.

    Args:
        arguments: Overrides and options of Hydra.
        words: Words between the program and these arguments on the command line.

    Raises:
        SystemExit: With a message after a known error, or 130 after Ctrl-C.
    """
    try:
        prepared = prepare(list(arguments))
    except (ConfigError, StorageError) as error:
        sys.exit(f"error: {error}")
    program, begun = sys.argv[0], False

    def job(config: DictConfig) -> float:
        nonlocal begun
        begun = True
        # Lightning starts the other processes of a distributed run with this command line.
        sys.argv = [program, *words, *prepared]
        return _job(config)

    sys.argv = [program, *prepared]
    try:
        hydra.main(config_path=str(CONF), config_name="train", version_base="1.3")(job)()
    except SystemExit as end:
        if isinstance(end.code, int) and end.code and not begun:  # A str is our own message.
            chosen = [text for text in prepared if key_and_value(text)[0]]
            if near := near_names(chosen):
                print(near, file=sys.stderr)
        raise


_prepared: dict[str, Any] = {}
"""Jobs that `SettingsCheck` has prepared, by run directory, for use in the job."""


class SettingsCheck(Callback):
    """Checks settings before Hydra makes the run directory; jobs of a sweep are checked later.

    Hydra turns exceptions in callbacks into warnings, hence ``sys.exit``.
    """

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        if config.hydra.runtime.choices.get("sweep") and config.resume is None:
            task: Any = OmegaConf.to_container(config.hydra.overrides.task, resolve=False)
            given = shlex.join(text for text in task if key_and_value(text)[0] != "resume")
            sys.exit(f"error: a sweep has many runs: {train_command()} -m {given}")
        names = [str(name) for name in config if name != "hydra"]
        HydraConfig.instance().set_config(config)  # As Hydra does for the job, for ${hydra:...}.
        try:
            if (plain := _resolved(OmegaConf.masked_copy(config, names))) is None:
                return
            _find_root(plain)
            from xplanes.experiment import Experiment

            experiment = Experiment.read(plain)
            if config.resume is None:  # A resumed run may find its scene elsewhere.
                experiment.require_folder()
        except XPlanesError as error:
            sys.exit(f"error: {error}")
        # Imported now, because it takes long: wrong settings have been refused.
        from xplanes.run import KNOWN_ERRORS, claim, prepare

        try:
            # Fails here if a setting that names the run directory is missing.
            folder = config.hydra.run.dir
            _prepared[folder] = prepare(experiment, Path(folder).absolute())
            # Otherwise Hydra would overwrite the record of an existing run.
            if config.resume is None and "LOCAL_RANK" not in os.environ:
                claim(Path(folder), resume=False)
        except KNOWN_ERRORS as error:
            sys.exit(f"error: {error}")

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        from xplanes.sweeps import look_ahead

        try:
            if words := look_ahead(config):
                print(words, flush=True)
        except XPlanesError as error:
            sys.exit(f"error: {error}")


def _resolved(config: DictConfig) -> dict[str, Any] | None:
    """Settings with interpolations resolved; None if one needs values known only in the job."""
    try:
        return to_plain(config)
    except ConfigError:
        if "${hydra:" in OmegaConf.to_yaml(config):
            return None
        raise


def _find_root(plain: dict[str, Any]) -> None:
    """Make a relative data.root absolute if the job runs in its own folder (hydra.job.chdir)."""
    data = plain.get("data")
    if HydraConfig.get().job.chdir and isinstance(data, dict) and isinstance(data.get("root"), str):
        data["root"] = to_absolute_path(str(Path(data["root"]).expanduser()))


def _job(config: DictConfig) -> float:
    """Run one job and return its score, which optimising sweepers use."""
    from xplanes.run import KNOWN_ERRORS, run

    settings = HydraConfig.get()
    sweep = settings.mode == RunMode.MULTIRUN
    folder = Path(settings.runtime.output_dir)
    try:
        plain = to_plain(config)
        _find_root(plain)
        if sweep and plain["trainer"].get("devices") not in (1, "1"):
            raise ConfigError(
                "trainer.devices > 1 in a multirun: helper processes would start the whole sweep "
                "again. Use one device per job, with hydra/launcher=joblib for several at a time"
            )
        auto = plain["resume"] == "auto" and (folder / "run.json").is_file()
        resume = auto or plain["resume"] not in (None, "auto")
        if auto:
            _require_same_job(folder, settings.overrides.task)
        # A resumed run needs the user's own configuration groups, too.
        own = _search_paths(settings.overrides.hydra)
        task = [text for text in settings.overrides.task if key_and_value(text)[0] != "resume"]
        job = None if sweep else _prepared.pop(settings.run.dir, None)
        began = None if sweep else STARTED
        return run(plain, folder, [*own, *task], resume=resume, job=job, began=began)
    except KNOWN_ERRORS as error:
        if sweep:
            raise
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        if sweep:
            place = shlex.quote(f"hydra.sweep.dir={settings.sweep.dir}")
            print(f"to resume the whole sweep, repeat the command with {place} resume=auto")
        sys.exit(130)


def _require_same_job(folder: Path, overrides: Iterable[str]) -> None:
    """Refuse to resume a sweep's job in a folder that holds the run of another job."""
    try:
        kept = (folder / "overrides.txt").read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return  # Damaged: it will be overwritten.
    before, now = (without(set(each), *MAY_DIFFER) for each in (kept, overrides))
    if before != now:
        raise ConfigError(
            f"{folder} holds the run with {' '.join(before) or 'no settings'}, not that with "
            f"{' '.join(now) or 'none'}: repeat the command of its sweep, or choose another "
            "hydra.sweep.dir"
        )


def prepare(arguments: list[str]) -> list[str]:
    """Replace ``resume=RUN`` by that run's overrides, and check that its folder is writable.

    Args:
        arguments: Overrides and options of Hydra.

    Returns:
        Arguments for Hydra.

    Raises:
        ConfigError: If Hydra cannot read the arguments, or the run cannot be resumed.
        StorageError: If the folder of the run cannot be written.
    """
    arguments = require_readable(_with_searchpath(arguments))
    mode = dict(map(key_and_value, arguments)).get("hydra.mode")
    several = mode == "MULTIRUN" or not {"-m", "--multirun"}.isdisjoint(arguments)
    _require_present_names(arguments, several=several)
    arguments = [with_names(text, several=several) for text in arguments]
    require_parsed([text for text in arguments if key_and_value(text)[0]])
    # Lightning passes names in quotes to the other processes of a run.
    values = {key: unquoted(value) for key, value in map(key_and_value, arguments) if key}
    for text in arguments:
        if (key := key_and_value(text)[0]).isalpha() and text[0] == "+" and (CONF / key).is_dir():
            raise ConfigError(f"{text}: the group is already set; write {text.lstrip('+')}")
    for key, value in values.items():
        if value in ("null", "None") and (CONF / key).is_dir():
            known = ", ".join(sorted(path.stem for path in (CONF / key).glob("*.yaml")))
            raise ConfigError(f"{key}={value}: must be one of {known}")
    resume, folder = values.get("resume", "null"), values.get("hydra.run.dir")
    if resume in ("null", "", "None", "auto"):
        if not SHOWING.isdisjoint(text.partition("=")[0] for text in arguments):
            return arguments
        # Checked before Hydra makes the folder, because it would fail with a traceback.
        place = values.get("hydra.sweep.dir") if several else folder
        require_writable(Path(place or "outputs"))
        if resume != "auto" or several:
            return arguments
        own = [a for a in arguments if not a.startswith("resume=")]
        found = Path(folder) if folder else _latest(own)
        if found is None or not (found / "run.json").is_file():
            print("resume=auto: no unfinished run with these settings; starting a new one")
            return [*own, "resume=null"]
        resume = str(found)
    if several:
        raise ConfigError(f"resume={resume} with --multirun: resume one run at a time, or auto")
    if folder is not None and Path(folder).resolve() != Path(resume).resolve():
        raise ConfigError(
            f"resume={resume} with hydra.run.dir={folder}: a run continues in its own folder; "
            "leave hydra.run.dir out"
        )
    return _resumed(Path(resume), arguments)


def _with_searchpath(arguments: list[str]) -> list[str]:
    """Write ``--config-dir`` as ``hydra.searchpath``, which is kept for a resumed run.

    Not with ``--config-name``: Hydra looks for that file before it reads the search path.
    """
    folder, kept, words = "", [], iter(arguments)
    for word in words:
        option, _, value = word.partition("=")
        if option in ("--config-name", "-cn"):
            return arguments
        if option in ("--config-dir", "-cd"):
            folder = value or next(words, "")
        else:
            kept.append(word)
    if not folder:
        return arguments
    if not Path(folder).is_dir():
        raise ConfigError(f"--config-dir {folder}: there is no such folder")
    place = quoted(f"file://{Path(folder).absolute()}")
    given = next((word for word in kept if key_and_value(word)[0] == SEARCHPATH), None)
    if given is None:
        return [f"{SEARCHPATH}=[{place}]", *kept]
    kept[kept.index(given)] = given.replace("[", f"[{place},", 1).replace(",]", "]")
    return kept


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


def _resumed(run: Path, arguments: list[str]) -> list[str]:
    """A run's overrides, the new ones that replace or extend them, and its folder."""
    path = run / "overrides.txt"
    if not path.is_file():
        found = _newest("overrides.txt")
        newest = ", ".join(str(each.parent) for each in found[:3]) or "there is none in outputs"
        raise ConfigError(
            f"resume={run}: not a run directory, no overrides.txt in it. The newest runs: {newest}"
        )
    require_writable(run)
    _require_version(run)
    text = path.read_text(encoding="utf-8")
    if text and not text.endswith("\n"):
        raise ConfigError(
            f"{path} is damaged: its last line is cut off. Repair it from {run / 'config.yaml'}, "
            "one key=value per line"
        )
    new = [a for a in arguments if not a.startswith(("resume=", "hydra.run.dir="))]
    changed = {key for key, _ in map(key_and_value, new) if key}
    # Options that the run added with a plus sign are not in the configuration without it.
    added = {
        key_and_value(line)[0]: "++" if line.startswith("++") else "+"
        for line in text.splitlines()
        if line.startswith("+")
    }
    new = [a if a[:1] in "+~" else added.get(key_and_value(a)[0], "") + a for a in new]
    old = [line for line in text.splitlines() if line and not _gives_way(line, changed)]
    old = [line for line in old if line[0] != "~" or line not in new]
    try:
        _require_present_names(old, several=False)
    except ConfigError as error:
        raise ConfigError(
            f"resume={run}: it began with settings of an earlier version. {error}"
        ) from None
    place = quoted(str(run))
    options = [a for a in new if not a.startswith("~") and not key_and_value(a)[0]]
    new = [a for a in new if a not in options]
    return [*old, *new, f"hydra.run.dir={place}", f"resume={place}", *options]


def _gives_way(line: str, changed: set[str]) -> bool:
    """Whether a run's override is dropped, because a new one sets its key or needs its group."""
    key = line.lstrip("+~").partition("=")[0]  # Also of one that deletes (~key).
    return key in changed or (line[0] == "~" and any(e.startswith(f"{key}.") for e in changed))


def _require_present_names(arguments: Sequence[str], *, several: bool) -> None:
    """Refuse options of earlier versions, and name their replacements."""
    former, now = [], []
    for text in arguments:
        key, value = text.partition("=")[::2]
        choice = same = shlex.quote(text)
        if text in ("-m", "--multirun"):
            continue
        if key in ("experiment", "sweep") and value in FORMER:
            choice, several = FORMER[value], True
        elif key == "experiment" and value and (CONF / "sweep" / f"{value}.yaml").is_file():
            choice, several = f"sweep={value}", True
        elif key == "scale":
            choice = "experiment=demo"
        former += [text] * (choice != same)
        now.append(choice)
    if former:
        program = f"{train_command()} -m" if several else train_command()
        raise ConfigError(f"{' '.join(former)}: that is now\n  {program} {' '.join(now)}")


def _require_version(run: Path) -> None:
    """Refuse a run of a version with different settings."""
    try:
        version = str(read_json(run / "run.json").get("xplanes", __version__))
    except (OSError, ValueError):
        return
    if version.split(".")[:2] != __version__.split(".")[:2]:
        raise ConfigError(
            f"resume={run}: it was made by xplanes {version}, whose settings differ from "
            f"{__version__}; continue it with that version, or start a new run in another folder"
        )


def _latest(overrides: list[str]) -> Path | None:
    """The newest unfinished run with the same overrides."""
    wanted = _without_resume(overrides)
    for record in _newest("run.json"):
        listed = record.parent / "overrides.txt"
        with suppress(OSError, ValueError):
            same = _without_resume(listed.read_text(encoding="utf-8").splitlines()) == wanted
            if same and read_json(record).get("status") != "finished":
                return record.parent
    return None


def _without_resume(overrides: Iterable[str]) -> list[str]:
    """Overrides without those that only say which run to resume, and without options."""
    settings = [text for text in overrides if text and text[0] != "-"]
    return sorted([*without(settings, "resume", "hydra"), *_search_paths(settings)])


def _search_paths(overrides: Iterable[str]) -> list[str]:
    """Overrides that name folders of the user's own configuration groups."""
    return [text for text in overrides if key_and_value(text)[0] == SEARCHPATH]


def _newest(name: str) -> list[Path]:
    """Files called ``name`` in run directories, newest first."""
    found = Path("outputs").glob(f"*/{name}")
    return sorted(found, key=lambda path: path.stat().st_mtime, reverse=True)
