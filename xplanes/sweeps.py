"""Sweeps: their list of jobs, and checks before the first one."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from xplanes.config import to_plain
from xplanes.errors import ConfigError
from xplanes.process import train_command

if TYPE_CHECKING:
    from xplanes.experiment import Experiment


GRIDS = (".RowSweeper", ".BasicSweeper")
"""Sweepers whose jobs are known in advance."""

SMALL = "experiment=demo"
"""Override that chooses the small version of a sweep."""


def jobs(hydra: Mapping[str, Any], loader: ConfigLoader | None = None) -> list[list[str]]:
    """Overrides of each job of a multirun.

    Every combination of the grid is run for each row. If the command line or the grid sets a key
    that all rows set, only rows with that value are run; otherwise rows override the grid.

    Args:
        hydra: Hydra's part of the configuration as builtins, as in multirun.yaml, with a sweeper
            over a grid.
        loader: Lists the options that ``glob(...)`` stands for.

    Raises:
        HydraException: For overrides that Hydra cannot read, or ranges without steps.
    """
    sweeper, task = hydra["sweeper"], hydra["overrides"]["task"]
    grid = dict(sweeper)
    if SMALL in task:
        grid |= sweeper.get("demo") or {}
    given = [f"{key}={value}" for key, value in (grid["params"] or {}).items()]
    parser = OverridesParser.create(config_loader=loader)
    overrides = parser.parse_overrides([*given, *task])
    combinations = [_by_key(job) for job in BasicSweeper.split_arguments(overrides, None)[0]]
    rows = [_by_key(str(row).split()) for row in grid.get("rows") or [""]]
    shared = set(rows[0]).intersection(*rows)
    return [
        list({**job, **row}.values())
        for job in combinations
        for row in rows
        if all(job.get(key, row[key]) == row[key] for key in shared)
    ]


def _by_key(overrides: Sequence[str]) -> dict[str, str]:
    return {text.partition("=")[0]: text for text in overrides}


def look_ahead(config: DictConfig) -> str:
    """Check that data and weights of all jobs of a multirun exist, before the first one begins.

    Missing weights are downloaded. Jobs check their other settings themselves, so that an invalid
    one does not stop the sweep.

    Args:
        config: The configuration of the multirun.

    Returns:
        A line with the number of runs and their training time; empty if the sweeper is not over a
        grid, or if Hydra itself will report an error.

    Raises:
        ConfigError, SceneError, LRMError: If sweeps cannot be run together, or data or weights are
            missing.
    """
    hydra: Any = OmegaConf.to_container(config.hydra, resolve=False)
    if not str(hydra["sweeper"]["_target_"]).endswith(GRIDS):
        return ""
    loader = GlobalHydra.instance().config_loader()
    HydraConfig.instance().set_config(config)  # As Hydra does for a job, for ${hydra:...}.
    known: dict[tuple[str, ...], Experiment | None] = {}
    try:
        found = [tuple(t for t in job if not t.startswith("seed=")) for job in jobs(hydra, loader)]
        _require_one_sweep(hydra, found)
        for job in dict.fromkeys(found):
            known[job] = _read(loader.load_sweep_config(config, list(job)))
    except HydraException:
        return ""
    runs = [run for job in found if (run := known[job]) is not None]
    for run in {str(run.data): run for run in runs}.values():
        run.require_folder()
    for lrm in {str(run.method.lrm): run.method.lrm for run in runs}.values():
        lrm.load()
    return _length(len(found), [run.trainer for run in runs])


def _require_one_sweep(hydra: Mapping[str, Any], found: Sequence[Sequence[str]]) -> None:
    names = dict.fromkeys(text for job in found for text in job if text.startswith("sweep="))
    if len(names) > 1:
        commands = "; ".join(f"{train_command()} -m {name}" for name in names)
        raise ConfigError(f"{', '.join(names)}: run one sweep at a time: {commands}")
    sweep, sweeper = hydra["runtime"]["choices"].get("sweep"), hydra["sweeper"]
    if sweep and SMALL in hydra["overrides"]["task"] and not sweeper.get("demo"):
        raise ConfigError(f"{SMALL}: sweep={sweep} has no small version; leave it out")
    if not found:
        rows = "; ".join(map(str, sweeper["rows"]))
        raise ConfigError(f"no row of the sweep matches the command line; its rows: {rows}")


def _read(job: DictConfig) -> "Experiment | None":
    """The settings of a job; None if they are invalid, which the job itself reports."""
    from xplanes.experiment import Experiment

    own = [str(name) for name in job if name != "hydra"]
    try:
        return Experiment.read(to_plain(OmegaConf.masked_copy(job, own)))
    except ConfigError:
        return None


def _length(runs: int, trainers: Sequence[Mapping[str, Any]]) -> str:
    """How many runs a sweep has, and how long they train."""
    seconds, steps = (
        [value for each in trainers if isinstance(value := each.get(key), int | float)]
        for key in ("max_seconds", "max_steps")
    )
    if trainers and len(seconds) == len(trainers):
        budget = f"at most {sum(seconds) / 60:.3g} minutes of training"
    else:
        budget = f"{sum(steps)} steps"
    return f"{runs} runs, {budget} in all; the header of each says how long it takes"
