"""The command line: `xplanes COMMAND ...`.

Heavy modules are imported by the commands that need them, so that the help is fast.
"""

import argparse
import difflib
import os
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from xplanes import __version__
from xplanes.errors import XPlanesError
from xplanes.process import defaults, keep_freed_memory

AddCommands = Callable[["argparse._SubParsersAction"], None]
"""Adds parsers of commands; each sets ``command``, which is called with the parsed options."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        arguments: Arguments after ``xplanes``; those of the command line when None.

    Returns:
        The exit code: 0, 1 after a reported error, 130 after Ctrl-C.
    """
    os.environ.update(defaults(os.environ))  # before torch is loaded
    keep_freed_memory()
    words = sys.argv[1:] if arguments is None else list(arguments)
    if words[:1] == ["resume"] and len(words) > 1 and words[1] not in ("-h", "--help"):
        from xplanes.config import quoted

        words = ["train", f"resume={quoted(words[1])}", *words[2:]]
        sys.argv[1:] = words if arguments is None else sys.argv[1:]
    if words[:1] == ["train"]:
        from xplanes.launch import train

        # Hydra parses the command line of training.
        train(words[1:], words[:1] if sys.argv[1:] == words else ())
        return 0
    parser = build_parser(further_commands())
    if not words:
        parser.print_help()
        return 0
    if problem := _unknown_command(parser, words):
        print(f"error: {problem}", file=sys.stderr)
        return 2
    options = parser.parse_args(words)
    try:
        options.command(options)
        sys.stdout.flush()
    except KeyboardInterrupt:
        print("\nstopped", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of the pipe (such as head) has exited; closing suppresses Python's warning.
        sys.stderr.close()
        return 0
    except (XPlanesError, PermissionError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def _unknown_command(parser: argparse.ArgumentParser, words: Sequence[str]) -> str:
    """An error with suggestions if the first word is not a command or option; otherwise empty."""
    (known,) = (each.choices for each in parser._actions if each.dest == "COMMAND")
    assert known is not None
    if words[0] in known or words[0].startswith("-"):
        return ""
    near = ["train", *words] if "=" in words[0] else difflib.get_close_matches(words[0], known, n=1)
    hint = f"did you mean `xplanes {shlex.join(near)}`?" if near else "see `xplanes --help`"
    return f"{words[0]}: no such command; {hint}"


def further_commands() -> list[AddCommands]:
    """Commands that installed packages register in the entry-point group ``xplanes.commands``."""
    from importlib.metadata import entry_points

    return [entry.load() for entry in sorted(entry_points(group="xplanes.commands"))]


class Command(NamedTuple):
    """A command of the program.

    Attributes:
        text: Help text.
        arguments: Positional arguments and options by name, as `add_argument` takes them.
        run: Runs it with the parsed options; None where Hydra reads the command line.
    """

    text: str
    arguments: dict[str, dict[str, Any]]
    run: Callable[[argparse.Namespace], None] | None = None


def add_table(commands: "argparse._SubParsersAction", table: Mapping[str, Command]) -> None:
    """Add the parsers of a table of commands by name."""
    for name, command in table.items():
        added = commands.add_parser(name, help=command.text)
        for argument, how in command.arguments.items():
            added.add_argument(argument, **how)
        added.set_defaults(command=command.run)


def option(text: str, usual: Any = None, /, **more: Any) -> dict[str, Any]:
    """Arguments of `add_argument`; the default, if any, sets the type and is shown in the help."""
    if usual is None:
        return {"help": text, **more}
    text = f"{text}; default: %(default)s".removeprefix("; ")
    return {"help": text, "type": type(usual), "default": usual, **more}


COMMANDS = {
    "train": Command("train a field: key=value ..., and the options of Hydra", {}),
    "resume": Command(
        "continue a run: RUN key=value ...",
        {
            "run": option("the run directory", metavar="RUN"),
            "overrides": option(
                "changed settings, and options of Hydra", nargs="*", metavar="KEY=VALUE"
            ),
        },
    ),
}


def build_parser(further: Sequence[AddCommands] = ()) -> argparse.ArgumentParser:
    """All commands and their options.

    Args:
        further: Add the commands of plug-ins to the subparsers.
    """
    parser = argparse.ArgumentParser(
        prog="xplanes",
        description="Dynamic radiance fields initialised from Large Reconstruction Models.",
    )
    parser.add_argument("--version", action="version", version=f"xplanes {__version__}")
    commands = parser.add_subparsers(
        title="commands", metavar="COMMAND", dest="COMMAND", required=True
    )
    add_table(commands, COMMANDS)
    for add in further:
        add(commands)
    return parser
