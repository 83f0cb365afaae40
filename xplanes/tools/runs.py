"""Run directories: finding them, and loading their scene and trained field."""

import difflib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from xplanes import __version__
from xplanes.backend import find_device
from xplanes.errors import ConfigError
from xplanes.experiment import Experiment
from xplanes.files import read_json
from xplanes.process import train_command
from xplanes.scenes.datamodule import SceneDataModule, found_root
from xplanes.scenes.frame import Frame
from xplanes.scenes.views import Scene, Views
from xplanes.training.checkpoints import load_checkpoint
from xplanes.training.module import RadianceModule
from xplanes.training.record import read_config, require_same_views

OUTPUTS = Path("outputs")
LISTED = 5
"""Most runs that an error message lists."""


@dataclass(frozen=True)
class TrainedRun:
    """A run with its scene and trained field.

    Attributes:
        path: The run directory.
        experiment: The settings.
        scene: The scene, with the training views and one more split; poses that training has
            corrected are corrected.
        split: Name of the other split.
        frame: The field's frame.
        module: The trained module, in evaluation mode.
        checkpoint: ``last`` or ``best``.
        step: Step of the checkpoint.
    """

    path: Path
    experiment: Experiment
    scene: Scene
    split: str
    frame: Frame
    module: RadianceModule
    checkpoint: str
    step: int

    @property
    def views(self) -> Views:
        """The views of the split."""
        return self.scene.splits[self.split]


def find_run(path: Path) -> Path:
    """The path, if it is a run directory; else a `ConfigError` lists similar or the newest runs."""
    if is_run(path):
        return path
    inside = find_runs(path) if path.is_dir() else []
    if inside:
        names = _listed(inside[:LISTED])
        raise ConfigError(f"{path} is a folder of {len(inside)} runs; name one of them:{names}")
    problem = "is not a run directory" if path.exists() else "does not exist"
    runs = {run.resolve(): run for folder in (OUTPUTS, path.parent) for run in find_runs(folder)}
    if not runs:
        raise ConfigError(
            f"{path} {problem}, and there are no runs in {OUTPUTS}: {train_command()}"
        )
    names = difflib.get_close_matches(path.name, {run.name for run in runs}, n=LISTED)
    near = [run for name in names for run in runs.values() if run.name == name]
    if near:
        raise ConfigError(f"{path} {problem}. Similar names:{_listed(near[:LISTED])}")
    newest = sorted(runs.values(), key=lambda run: run.stat().st_mtime, reverse=True)
    raise ConfigError(f"{path} {problem}. The newest runs:{_listed(newest[:LISTED])}")


def is_run(path: Path) -> bool:
    """Whether a folder is a run directory, of a finished run or not."""
    return (path / "run.json").is_file() or (path / "config.yaml").is_file()


def find_runs(folder: Path) -> list[Path]:
    """Runs in a folder, up to three levels down: outputs/sweeps/<sweep>/<run>."""
    patterns = ("*", "*/*", "*/*/*")
    return sorted({path.parent for p in patterns for path in folder.glob(f"{p}/run.json")})


def _listed(runs: list[Path]) -> str:
    return "".join(f"\n  {run}" for run in runs)


def load_run(
    run: Path,
    *,
    checkpoint: str = "last",
    split: str | None = None,
    plugins: Sequence[str] = (),
    announce: Callable[[str], None] | None = None,
) -> TrainedRun:
    """Load a trained run from a checkpoint to the CPU, if it was trained there, or a GPU if found.

    Args:
        run: The run directory.
        checkpoint: ``last`` or ``best``.
        split: Split to read; None for the split of the run's final scores.
        plugins: User modules with classes that the run's settings may name.
        announce: Receives messages about what is loaded.

    Raises:
        ConfigError, SceneError: If the run or its data are missing, damaged or changed.
    """
    experiment = read_experiment(run, plugins)
    data = replace(experiment.data, root=found_root(run, experiment.data.root))
    # A run that was trained on a GPU may be loaded on a machine without one.
    device = find_device("cpu" if experiment.trainer.get("accelerator") == "cpu" else "auto")
    path = run / "checkpoints" / f"{checkpoint}.ckpt"
    state = load_checkpoint(path)
    step = state.get("global_step")
    if not isinstance(step, int) or "state_dict" not in state or "progress" not in state:
        raise ConfigError(f"{path} is not a checkpoint of xplanes")
    if announce is not None:
        announce(f"run         {run}")
        announce(f"checkpoint  {checkpoint}.ckpt, step {step}, on {device}")
    served = SceneDataModule(data, seed=experiment.method.seed)
    served.setup("fit")  # Holds out the same views as in training.
    name = split or served.test_split
    served.read_split(name)
    scene = served.scene
    require_same_views(run, _record(run), scene.splits["train"])
    module = RadianceModule(experiment.method, plugins)
    try:
        module.on_load_checkpoint(state)
        module.load_state_dict(state["state_dict"])
    except ConfigError as error:
        raise ConfigError(f"{path} cannot be used: {error}") from error
    module.to(device).eval()
    scene = module.corrected_scene(scene)
    assert module.frame is not None
    return TrainedRun(
        run, replace(experiment, data=data), scene, name, module.frame, module, checkpoint, step
    )


def read_experiment(run: Path, plugins: Sequence[str] = ()) -> Experiment:
    """The settings of a run directory.

    Args:
        run: The run directory.
        plugins: User modules with classes that the settings may name.

    Raises:
        ConfigError: If they are missing, damaged, or from another version.
    """
    content, version = read_config(run), _record(run).get("xplanes")
    try:
        return Experiment.read(content, plugins)
    except (ConfigError, KeyError, TypeError, AttributeError) as error:
        if isinstance(version, str) and version != __version__:
            raise ConfigError(
                f"{run} was made by xplanes {version}, this is {__version__}, which cannot read "
                f"its settings ({error}): install that version to use it, or start a new run"
            ) from error
        if isinstance(error, ConfigError) and not isinstance(error.__cause__, KeyError):
            raise ConfigError(f"{run}/config.yaml: {error}") from error
        raise ConfigError(
            f"{run}/config.yaml cannot be used ({error}): it is damaged, or from another version "
            "of xplanes"
        ) from error


def _record(run: Path) -> dict[str, Any]:
    """Content of run.json; empty if it is missing or damaged, since only messages use it."""
    try:
        return read_json(run / "run.json")
    except (OSError, ValueError):
        return {}
