"""Lightning's CSVLogger for runs that are resumed."""

import warnings
from pathlib import Path
from typing import Any, cast

from lightning.fabric.loggers.logger import rank_zero_experiment
from lightning.pytorch import loggers
from lightning.pytorch.loggers.csv_logs import ExperimentWriter

from xplanes.files import read_rows


class CSVLogger(loggers.CSVLogger):
    """Lightning's CSVLogger; a resumed run continues ``metrics.csv``, which Lightning deletes.

    Rows of repeated steps are replaced.
    """

    @property
    @rank_zero_experiment
    def experiment(self) -> ExperimentWriter:
        """Writes the file."""
        if self._experiment is None:
            Path(self.root_dir).mkdir(parents=True, exist_ok=True)
            self._experiment = _Writer(self.log_dir)
        return cast(ExperimentWriter, self._experiment)


class _Writer(ExperimentWriter):
    def __init__(self, log_dir: str) -> None:
        self._file = Path(log_dir) / self.NAME_METRICS_FILE
        rows = read_rows(self._file)  # The last is cut off if the run was killed.
        self._earlier: list[dict[str, Any]] = [
            row for row in rows if None not in (*row, *row.values()) and row["step"].isdigit()
        ]
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".* exists and is not empty")  # Rows are kept here.
            super().__init__(log_dir)
        self._begin_with(self._earlier)

    def log_metrics(self, metrics_dict: dict[str, float], step: int | None = None) -> None:
        if step is not None and self._earlier:
            kept = [row for row in self._earlier if int(row["step"]) < step]
            if len(kept) < len(self._earlier):
                self._file.unlink()
                self._begin_with(kept)
            self._earlier = []
        super().log_metrics(metrics_dict, step)

    def _begin_with(self, rows: list[dict[str, Any]]) -> None:
        self.metrics = list(rows)
        self.save()
