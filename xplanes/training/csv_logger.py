"""Lightning's CSVLogger for runs that are resumed."""

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
    def _check_log_dir_exists(self) -> None:
        """Read an earlier file, where Lightning's class would delete it."""
        path = Path(self.metrics_file_path)
        rows = read_rows(path)
        if rows and not path.read_bytes().endswith(b"\n"):  # Its process was killed.
            rows.pop()
        self._earlier: list[Any] = [
            row for row in rows if None not in (*row, *row.values()) and row["step"].isdigit()
        ]
        if not self._earlier:
            path.unlink(missing_ok=True)

    def log_metrics(self, metrics_dict: dict[str, float], step: int | None = None) -> None:
        if step is not None and self._earlier:
            Path(self.metrics_file_path).unlink()
            self.metrics = [row for row in self._earlier if int(row["step"]) < step]
            self._earlier = []
            self.save()
        super().log_metrics(metrics_dict, step)
