"""Runs tests and gathers what they counted: one row per test function, named by its docstring."""

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from xplanes.files import write_text

ROOT = Path(__file__).resolve().parent.parent


@dataclass
class Row:
    """Counts of one kind of stress or fault."""

    counts: dict[str, int] = field(default_factory=dict)
    failed: int = 0
    skipped: list[str] = field(default_factory=list)
    error: float | None = None

    def add(self, content: dict[str, Any], outcome: str) -> None:
        for name, value in content.items():
            if isinstance(value, int):
                self.counts[name] = self.counts.get(name, 0) + value
        if content.get("error") is not None:
            self.error = max(self.error or 0.0, content["error"])
        self.failed += outcome == "failed"


class Gatherer:
    """A pytest plugin that adds up the property "tally" of all tests."""

    def __init__(self) -> None:
        self.rows: dict[str, Row] = {}
        self.seconds = 0.0
        self.other_failures: list[str] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.seconds += report.duration
        tallies = [value for name, value in report.user_properties if name == "tally"]
        if report.when == "call" and tallies:
            self.rows.setdefault(tallies[0]["kind"], Row()).add(tallies[0], report.outcome)
        elif report.failed:
            self.other_failures.append(report.nodeid)
        if report.skipped and tallies:
            row = self.rows.setdefault(tallies[0]["kind"], Row())
            row.skipped.append(str(report.longrepr[2] if report.longrepr else ""))  # type: ignore[index]


def gather(arguments: list[str]) -> Gatherer:
    """Run pytest with these arguments."""
    gatherer = Gatherer()
    pytest.main(["-q", "-p", "no:cacheprovider", *arguments], plugins=[gatherer])
    return gatherer


def write_page(
    folder: str,
    page: Callable[[Gatherer], str],
    name: str,
    words: str,
    plot: Callable[[Gatherer], None] | None = None,
) -> None:
    """Run a folder of the stress suite, write its page, and exit with whether anything failed.

    Args:
        folder: Folder below tests.
        page: From what was counted to markdown.
        name: File below docs/results.
        words: What the script does, for its help.
        plot: Draws what was counted.
    """
    parser = argparse.ArgumentParser(description=words)
    parser.add_argument("--select", help="as pytest -k: these tests alone, printed, not written")
    args = parser.parse_args()
    chosen = ["-k", args.select] if args.select else []
    found = gather(["-m", "stress", str(ROOT / "tests" / folder), *chosen])
    text = page(found)
    if args.select:
        print(text)
    else:
        write_text(ROOT / "docs" / "results" / name, text)
        if plot is not None:
            plot(found)
    sys.exit(bool(found.other_failures) or any(row.failed for row in found.rows.values()))
