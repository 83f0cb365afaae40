"""The table of a sweep: table.md and table.csv, and the Hydra callback that writes them."""

import atexit
import os
import re
import sys
import traceback
from collections import Counter
from collections.abc import MutableMapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig

from xplanes.errors import ConfigError
from xplanes.files import write_json, write_rows, write_text
from xplanes.process import say
from xplanes.tools.curves import plot_against, plot_curves
from xplanes.tools.published import beside, check_published
from xplanes.tools.sheet import check_what, write_sheet
from xplanes.tools.sweep import RunRow, published_tables, read_rows
from xplanes.tools.tabulate import (
    SEED,
    decomposition_table,
    differing,
    run_table,
    seed_groups,
    seed_table,
    shown,
)


def write_tables(folder: Path, out: Path | None = None) -> str:
    """Tabulate all runs in a folder.

    Args:
        folder: A sweep, or any folder of runs.
        out: Output folder; ``folder`` when None. It gets table.md, table.csv, table_seeds.csv (if
            there are several seeds), and with the extra ``plots`` curves.png and against.png.

    Returns:
        Content of table.md.

    Raises:
        ConfigError: If there are no runs in the folder.
    """
    rows, out = read_rows(folder), out or folder
    names = differing(rows)
    lines = run_table(rows, names)
    text = [f"# {folder.resolve().name}", f"{_counts(rows)} {_protocol(rows)}".strip()]
    text.append(shown(lines))
    write_rows(out / "table.csv", lines[0], (line.values() for line in lines))
    (out / "table_seeds.csv").unlink(missing_ok=True)
    if seeds := seed_groups(rows):
        means = seed_table(seeds, [name for name in names if name != SEED])
        text += ["Mean and standard deviation over seeds:", shown(means)]
        write_rows(out / "table_seeds.csv", means[0], (line.values() for line in means))
    if (published := beside(rows, published_tables(folder))) is not None:
        text.append(published)
    if parts := decomposition_table(rows, names):
        text += ["Decomposition of the LRM's triplanes (means over xy, xz, yz):", shown(parts)]
    if len(rows) > 1 and plot_curves(rows, names, out / "curves.png"):
        text.append("![PSNR against seconds and steps](curves.png)")
    if plot_against(rows, names, out / "against.png"):
        text.append("![PSNR at the end](against.png)")
    whole = "\n\n".join(text) + "\n"
    write_text(out / "table.md", whole)
    return whole


def _counts(rows: Sequence[RunRow]) -> str:
    """Number of runs by status, and the split of their scores."""
    kinds = Counter(re.split("[:,;]", row.status)[0] for row in rows)
    tally = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
    splits = {row.split for row in rows if row.split}
    scored = f" Scores of the {splits.pop()} split." if len(splits) == 1 else ""
    return f"{len(rows)} runs: {tally}.{scored}"


PROTOCOL = {
    "data.name": ("data", ""),
    "data.resolution": ("width, px", "native"),
    "data.views": ("training views", "all"),
    "data.eval_views": ("scored views", "all"),
    "model.rays.background": ("background", ""),
    "trainer.max_steps": ("steps", ""),
    "trainer.max_seconds": ("seconds", "no limit"),
}
"""Settings of the protocol of training and scoring, each with its name and the word for null."""


def _protocol(rows: Sequence[RunRow]) -> str:
    """The protocol of training and scoring, as far as known: data, budget, machine."""
    known = [row.settings for row in rows if row.settings and not row.missing]
    parts = []
    for key, (name, unset) in PROTOCOL.items():
        values = [settings[key] for settings in known if key in settings]
        if shown := dict.fromkeys(unset if value is None else str(value) for value in values):
            parts.append(f"{name}: {', '.join(shown)}")
    if machines := dict.fromkeys(row.machine for row in rows if row.machine):
        parts.append(f"machine: {'; '.join(machines)}")
    return f"Protocol: {' · '.join(parts)}." if parts else ""


class SweepTable(Callback):
    """Reports the result of each job of a multirun, and writes and prints the table at its end.

    The table is also written at exit, since Hydra does not call ``on_multirun_end`` if a job has
    failed or the sweep was stopped.

    Args:
        published: Published tables to add, whatever the data.
        sheet: Kind of the contact sheet, one of `xplanes.tools.sheet.WHAT`; None for no sheet.
    """

    def __init__(self, published: Sequence[str] = (), sheet: str | None = None) -> None:
        self._folder: Path | None = None
        self._published, self._sheet = list(published), sheet

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        try:
            check_published(self._published)
            check_what(self._sheet)
        except ConfigError as error:
            sys.exit(f"error: {error}")  # Hydra turns other exceptions into warnings.
        self._folder = Path(config.hydra.sweep.dir).absolute()
        atexit.register(self._finish)

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        if config.hydra.mode == RunMode.MULTIRUN:
            gpu = choose_gpu(config.hydra.job.num, os.environ)
            if gpu is not None:
                say(f"job {config.hydra.job.num} on GPU {gpu}")

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        if config.hydra.mode != RunMode.MULTIRUN:
            return
        run = Path(config.hydra.runtime.output_dir)
        # The public property raises the job's own error.
        value = job_return._return_value
        if job_return.status != JobStatus.FAILED:
            say(f"job {config.hydra.job.num} finished: psnr {value:.2f}  {run.name}")
            return
        reason = f"{type(value).__name__}: {value}"
        say(f"job {config.hydra.job.num} failed: {reason}  {run.name}")
        if not (run / "run.json").exists():
            write_json(run / "run.json", {"status": "failed", "reason": reason})

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        self._finish()

    def _finish(self) -> None:
        folder, self._folder = self._folder, None
        if folder is None or not folder.is_dir():
            return
        atexit.unregister(self._finish)
        try:
            say(f"\n{write_tables(folder)}\nwrote {folder / 'table.md'} and table.csv")
        except ConfigError:
            return  # No job has begun.
        except Exception:
            # The runs are complete; only their table is missing.
            traceback.print_exc()
            say(f"no table: xplanes table {folder}")
        if self._sheet is None:
            return
        try:
            say(f"wrote {write_sheet(folder, folder / 'sheet.png', what=self._sheet)}")
        except ConfigError as error:
            say(f"no sheet: {error}")


def choose_gpu(job: int, environment: MutableMapping[str, str]) -> str | None:
    """Choose a GPU for a parallel job: job number modulo number of GPUs.

    A process keeps the GPU of its first job, because CUDA reads ``CUDA_VISIBLE_DEVICES`` only once.

    Args:
        job: Number of the job within the sweep.
        environment: Environment; its ``CUDA_VISIBLE_DEVICES`` is read, and set to the chosen GPU.

    Returns:
        The GPU; None if there are fewer than two.
    """
    listed = environment.get("CUDA_VISIBLE_DEVICES")
    if listed is None:
        import torch

        gpus = [str(number) for number in range(torch.cuda.device_count())]
    else:
        gpus = [name.strip() for name in listed.split(",") if name.strip()]
    if len(gpus) < 2:
        return None
    environment["CUDA_VISIBLE_DEVICES"] = gpu = gpus[job % len(gpus)]
    return gpu
