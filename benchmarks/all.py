"""The pages of results: drawn from their records in a minute, or measured again.

    python benchmarks/all.py                          draw all sections again, from their records
    python benchmarks/all.py --list                   say which sections are stale, and why
    python benchmarks/all.py --check                  measure a part of each, and compare
    python benchmarks/all.py --measure --only NAME    measure sections in full, and record them

A section stands between two comments of README.md or of a page below docs/results; the words
around it are written by hand. Its record is docs/results/records/NAME.json: what was measured, with
which settings, when and on what. It is stale if the settings or inputs of what it measures have
changed since. That code has changed is no reason: --check, an hour and a half on two cores with
--together 2, sees whether it matters. A measurement that was interrupted goes on where it stopped.
D-NeRF's lego (`xplanes download dnerf`) and real captures lie below --dnerf and --real. Needs the
extra `dev`; nothing else should run.
"""

import os

from xplanes.process import defaults

os.environ.update(defaults(os.environ))
os.environ["OMP_NUM_THREADS"] = "1"

import argparse
import importlib
import re
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path

import sections
from runner import RESULTS, markdown
from sections import DATA, LIMITS, WORK, Row, Section, read_record

from xplanes.files import write_text

MODULES = ("baselines", "initialisation", "ablations", "paper", "engineering")
"""Modules beside this one, with their SECTIONS."""

BLOCK = re.compile(r"(<!-- measured: (\w+) -->\n).*?(?=<!-- end -->)", re.DOTALL)
"""What stands between the comments of a section."""


def every_section() -> dict[str, Section]:
    modules = [importlib.import_module(name) for name in MODULES]
    return {section.name: section for module in modules for section in module.SECTIONS}


def summaries() -> dict[str, Callable[[], str]]:
    """Tables of several records, by the name in their comments."""
    modules = [importlib.import_module(name) for name in MODULES]
    return {
        name: table
        for module in modules
        for name, table in getattr(module, "SUMMARIES", {}).items()
    }


def pages() -> list[Path]:
    """Files that hold sections."""
    return [RESULTS.parent.parent / "README.md", *sorted(RESULTS.glob("*.md"))]


def draw(known: dict[str, Section], chosen: set[str]) -> None:
    """Write the chosen sections, and all summaries, into their pages."""
    tables = summaries()
    for path in pages():
        text = path.read_text(encoding="utf-8")

        def drawn(match: re.Match[str]) -> str:
            if match[2] in tables:
                return f"{match[1]}{tables[match[2]]()}\n"
            if match[2] not in chosen:
                return match[0]
            return match[1] + block(known[match[2]])

        if (new := BLOCK.sub(drawn, text)) != text:
            write_text(path, new)


def block(section: Section) -> str:
    """What a record shows: whether it is stale, figure and table, and how it was made."""
    record = read_record(section.name)
    if record is None:
        return "Not measured yet.\n"
    reason = sections.why_stale(section)
    stale = f"**Stale**: {reason}.\n\n" if reason else ""
    made = made_words(section.name, record["made"])
    return f"{stale}{section.show(record['rows'])}\n\n{made}\n"


def made_words(name: str, made: Row) -> str:
    """How, when and on what a section was measured."""
    when = ", ".join(str(made[key]) for key in ("date", "commit") if made.get(key))
    hours = f", {made['hours']:g} hours of a core" if made.get("hours") else ""
    return (
        f"*Version {made['version']}{f' ({when})' if when else ''}; {made['machine']}{hours}. "
        f"`python benchmarks/all.py --measure --only {name}`*"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--list", action="store_true", help="what is stale, and why")
    parser.add_argument("--check", action="store_true", help="measure one seed of a part")
    parser.add_argument("--measure", action="store_true", help="measure in full, and record")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="sections")
    parser.add_argument("--together", type=int, default=1, help="runs side by side")
    parser.add_argument("--seeds", type=int, help="at most, fewer than a section has")
    parser.add_argument("--minutes", type=float, help="begin no run after these")
    parser.add_argument("--dnerf", type=Path, help="folder of D-NeRF's scenes")
    parser.add_argument("--real", type=Path, help="folder of real captures")
    args = parser.parse_args()
    DATA.update({name: path for name in ("dnerf", "real") if (path := getattr(args, name))})
    LIMITS["together"] = args.together
    LIMITS["seeds"] = args.seeds or LIMITS["seeds"]
    if args.minutes is not None:
        LIMITS["until"] = time.monotonic() + 60 * args.minutes
    known = every_section()
    if unknown := set(args.only or ()) - set(known):
        parser.error(f"--only {' '.join(sorted(unknown))}: must be of {', '.join(known)}")
    chosen = {name: known[name] for name in known if args.only is None or name in args.only}
    if args.list:
        for name, section in chosen.items():
            print(f"{name:<16}{sections.why_stale(section) or 'up to date'}")
        return 0
    failed = []
    if args.check or args.measure:
        failed = [name for name, each in chosen.items() if not measured(each, quick=args.check)]
    if not args.check:
        draw(known, set(chosen))
    if failed:
        print(f"failed, changed or not finished: {', '.join(failed)}")
    return bool(failed)


def measured(section: Section, *, quick: bool) -> bool:
    """Measure a section, or a part to be compared with its record; whether that went well."""
    work = WORK / f"{section.name}{'_check' if quick else ''}"
    try:
        if quick:
            found = sections.drift(section, section.measure(work, True))
            print(markdown(("case", "quantity", "record", "now", ""), found), flush=True)
            if any(words for *_, words in found):
                return False
        else:
            sections.measure(section, work)
    except (RuntimeError, sections.OutOfTimeError, OSError) as error:
        print(f"{section.name}: {error}", flush=True)
        return False
    shutil.rmtree(work, ignore_errors=True)
    return True


if __name__ == "__main__":
    sys.exit(main())
