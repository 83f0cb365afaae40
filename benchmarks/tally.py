"""Runs the stress tests in a folder and prints what they counted, as JSON in the last line.

    python benchmarks/tally.py FOLDER [--short]

A row per test function, named by its docstring. --short runs one file. Fails if a test does. Some
minutes for faults, of which a few mount a small disk and need root; half an hour for stress.
"""

import os

from xplanes.process import defaults

os.environ.update(defaults(os.environ))
# What one thread computes is compared with what two compute.
os.environ.setdefault("NUMBA_NUM_THREADS", "2")

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent
SHORT = {"stress": "test_rays.py", "faults": "test_together.py"}


class Gatherer:
    """A pytest plugin that adds up the property "tally" of all tests."""

    def __init__(self) -> None:
        self.rows: dict[str, dict[str, Any]] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        tallies: list[Any] = [value for name, value in report.user_properties if name == "tally"]
        if report.when != "call" or not tallies:
            return
        row = self.rows.setdefault(tallies[0]["kind"], {"case": tallies[0]["kind"]})
        for name, value in tallies[0].items():
            if isinstance(value, int):
                row[name] = row.get(name, 0) + value
            elif isinstance(value, float):
                row[name] = max(row.get(name, 0.0), value)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("folder", choices=("stress", "faults"))
    parser.add_argument("--short", action="store_true")
    args = parser.parse_args()
    gatherer = Gatherer()
    chosen = ROOT / "tests" / args.folder / (SHORT[args.folder] if args.short else "")
    words = ["-q", "-p", "no:cacheprovider", "-m", "stress", str(chosen)]
    code = pytest.main(words, plugins=[gatherer])
    print(json.dumps({"rows": list(gatherer.rows.values())}))
    return int(code)


if __name__ == "__main__":
    sys.exit(main())
