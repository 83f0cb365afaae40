"""Runs on the Hugging Face hub: `xplanes push`, and `hf://USER/REPOSITORY` in place of a run."""

import json
import re
import shlex
from pathlib import Path
from typing import Any

from xplanes import __version__
from xplanes.errors import ConfigError
from xplanes.files import read_json
from xplanes.lrm.weights import answers
from xplanes.process import say
from xplanes.tools.runs import OUTPUTS, is_run
from xplanes.training.record import read_config

SCHEME = "hf://"
"""Prefix of the address of a run on the hub."""

PATTERNS = (
    *("README.md", "config.yaml", "overrides.txt", "run.json", "metrics.json", "curve.csv"),
    *("checkpoints/*.ckpt", "media/*"),
)
"""Files of a run that are uploaded; logs are not, since they name folders and machines."""

PRIVATE = ("directory", "process")
"""Keys of run.json that describe the machine and are not uploaded."""

_ADDRESS = re.compile(r"(?P<repository>[\w.-]+/[\w.-]+)(?:@(?P<revision>[\w./-]+))?")


def push(
    run: Path,
    repository: str,
    *,
    private: bool = False,
    endpoint: str | None = None,
) -> str:
    """Upload a run with a model card.

    Args:
        run: The run directory.
        repository: USER/REPOSITORY; created if it does not exist.
        private: Whether a new repository is private.
        endpoint: Address of the hub; the default when None.

    Returns:
        The repository's address.

    Raises:
        ConfigError: If the run has no checkpoint or no metrics, or the hub refuses.
    """
    from huggingface_hub import CommitOperationAdd, HfApi, constants
    from huggingface_hub.utils import filter_repo_objects

    repository, revision = _parsed(repository)
    if revision is not None:
        raise ConfigError(
            f"{repository}@{revision}: runs are pushed to main; leave out @{revision}"
        )
    for needed in ("checkpoints/last.ckpt", "metrics.json", "run.json"):
        if not (run / needed).is_file():
            raise ConfigError(f"{run} has no {needed}: push a run that has finished")
    files = [path.relative_to(run).as_posix() for path in run.rglob("*") if path.is_file()]
    wanted = filter_repo_objects(sorted(files), allow_patterns=list(PATTERNS))
    contents: dict[str, Path | bytes] = {name: run / name for name in wanted}
    record = read_json(run / "run.json")
    record = {name: value for name, value in record.items() if name not in PRIVATE}
    contents["run.json"] = json.dumps(record, indent=2).encode()
    contents["README.md"] = model_card(run, repository).encode()
    operations = [
        CommitOperationAdd(path_in_repo=name, path_or_fileobj=content)
        for name, content in contents.items()
    ]
    size = sum(operation.upload_info.size for operation in operations)
    say(f"uploading   {len(operations)} files, {size / 1e6:.1f} MB, to {repository}")
    api = HfApi(endpoint=endpoint)
    if constants.HF_HUB_OFFLINE or not answers(api.endpoint):
        raise ConfigError(f"{api.endpoint} cannot be reached, or HF_HUB_OFFLINE is set: try later")
    try:
        api.create_repo(repository, private=private, exist_ok=True)
        message = f"A run of xplanes {__version__}"
        api.create_commit(repository, operations, commit_message=message)
    except Exception as problem:  # The hub's errors have no common class.
        raise ConfigError(
            f"{repository} cannot be written ({_reason(problem)}): log in with `hf auth login`, or "
            "set HF_TOKEN to a token that may write"
        ) from problem
    return f"{api.endpoint}/{repository}"


def fetch(address: str, *, outputs: Path = OUTPUTS, endpoint: str | None = None) -> Path:
    """Download a run, or the files that have changed since its last download.

    Args:
        address: hf://USER/REPOSITORY, optionally with @REVISION.
        outputs: Folder of runs; the run is saved in its subfolder hub/USER/REPOSITORY.
        endpoint: Address of the hub; the default when None.

    Returns:
        The run directory.

    Raises:
        ConfigError: If the hub cannot be reached or has no such run.
    """
    from huggingface_hub import constants, snapshot_download

    repository, revision = _parsed(address.removeprefix(SCHEME))
    suffix = "" if revision is None else f"@{revision.replace('/', '-')}"
    run = outputs / "hub" / f"{repository}{suffix}"
    server = endpoint or constants.ENDPOINT
    if constants.HF_HUB_OFFLINE or not answers(server):
        if not is_run(run):
            raise ConfigError(
                f"{address} cannot be read: {server} cannot be reached, or HF_HUB_OFFLINE is set, "
                f"and {run} holds no earlier copy"
            )
        say(f"offline     using the earlier copy in {run}")
        return run
    say(f"fetching    {address} to {run}")
    try:
        files: Any = {"local_dir": run, "allow_patterns": list(PATTERNS)}
        snapshot_download(repository, revision=revision, endpoint=endpoint, **files)
    except Exception as problem:  # The hub's errors have no common class.
        raise ConfigError(
            f"{address} cannot be read ({_reason(problem)}): check its name; a private repository "
            "needs `hf auth login` or HF_TOKEN"
        ) from problem
    return run


def _parsed(text: str) -> tuple[str, str | None]:
    found = _ADDRESS.fullmatch(text)
    if found is None:
        raise ConfigError(f"{text}: a repository on the hub is written USER/REPOSITORY")
    return found["repository"], found["revision"]


def _reason(problem: Exception) -> str:
    return f"{type(problem).__name__}: {' '.join(str(problem).split())[:300]}"


def model_card(run: Path, repository: str) -> str:
    """The README of a run on the hub: metrics, command, and the licence of the LRM's weights."""
    from huggingface_hub import EvalResult, ModelCardData

    config, metrics = read_config(run), read_json(run / "metrics.json")
    data, model, lrm = config["data"], config["model"], config["lrm"]
    scene = f"{data['name']}/{data['scene']}"
    scores = {name: value for name, value in metrics["test"].items() if value is not None}
    place = {"dataset_type": data["name"], "dataset_name": scene, "dataset_split": metrics["split"]}
    results = [
        EvalResult("novel-view-synthesis", metric_type=name, metric_value=round(value, 4), **place)
        for name, value in scores.items()
    ]
    licence, origin = lrm.get("licence"), lrm.get("repository")
    card = ModelCardData(
        library_name="xplanes",
        tags=["xplanes", "dynamic-nerf", "novel-view-synthesis"],
        license=licence.lower() if licence else None,
        base_model=origin,
        model_name=repository.rpartition("/")[2],
        eval_results=results,
    )
    table = "".join(f"| {name} | {value:.4g} |\n" for name, value in scores.items())
    video = metrics.get("media")
    picture = f"![Video]({video})\n\n" if video and (run / video).is_file() else ""
    overrides = (run / "overrides.txt").read_text(encoding="utf-8").splitlines()
    command = f"with\n\n    xplanes train {shlex.join(overrides)}"
    if sweep := next((text for text in overrides if text.startswith("sweep=")), None):
        command = f"as a run of `{sweep}`, with the settings in `config.yaml`."
    return f"""---
{card.to_yaml()}
---

# {repository.rpartition("/")[2]}

A dynamic radiance field of the scene {scene}, model {model["name"]}, trained with X-Planes
{__version__}.

{picture}| metric ({metrics["split"]} split) | value |
|---|---|
{table}
{_weights(lrm, used=bool(metrics["lrm"]))}

Trained for {metrics["step"]:,} steps {command}

To use it:

    pip install "xplanes[export]"
    xplanes render {SCHEME}{repository}
    xplanes export {SCHEME}{repository} --what web

These commands read the scene, which is not part of this repository: it must be in the folder
`data.root` of `config.yaml` (the demo scene is rendered if it is missing). In Python,
`RadianceModule.load_from_checkpoint("checkpoints/last.ckpt")` needs no scene.
"""


def _weights(lrm: dict[str, Any], *, used: bool) -> str:
    """The card's sentence on the initial weights and their licence; ``used``: an LRM saw images."""
    name = lrm["name"]
    if name == "none" or (name == "auto" and not used):
        return "Training began with random initialisation: the field has no third-party weights."
    if (licence := lrm.get("licence")) is not None:
        return (
            f"Training began with the LRM `{name}` ({lrm['repository']}), whose weights have the "
            f"licence {licence}. The field contains the LRM's decoder."
        )
    if (bundled := lrm.get("bundled")) is not None:
        return (
            f"Training began with the LRM `{bundled}`, bundled with X-Planes (MIT licence). The "
            "field contains the LRM's decoder."
        )
    return f"Training began with `lrm={name}`, whose files have the licence of their author."
