"""The command line: `xplanes COMMAND ...`.

Heavy modules are imported by the commands that need them, so that the help is fast.
"""

import argparse
import difflib
import os
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from xplanes import __version__
from xplanes.errors import XPlanesError
from xplanes.process import defaults, keep_freed_memory, train_command

if TYPE_CHECKING:
    from xplanes.evaluation.runs import TrainedRun

T = TypeVar("T")

AddCommands = Callable[["argparse._SubParsersAction"], None]
"""Adds parsers of commands; each sets ``command``, which is called with the parsed options."""

_say = partial(print, flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        arguments: What follows ``xplanes``; taken from the command line when None.

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

        # Hydra parses the command line of training itself.
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
    """What a first word that is no command may have meant; empty for commands and options."""
    (known,) = (each.choices for each in parser._actions if each.dest == "COMMAND")
    assert known is not None
    if words[0] in known or words[0].startswith("-"):
        return ""
    near = ["train", *words] if "=" in words[0] else difflib.get_close_matches(words[0], known, n=1)
    hint = f"did you mean `xplanes {shlex.join(near)}`?" if near else "see `xplanes --help`"
    return f"{words[0]}: no such command; {hint}"


def further_commands() -> list[AddCommands]:
    """What installed packages add in the entry-point group ``xplanes.commands``."""
    from importlib.metadata import entry_points

    return [entry.load() for entry in sorted(entry_points(group="xplanes.commands"))]


def _download(options: argparse.Namespace) -> None:
    from xplanes.scenes.download import download_dnerf

    root = download_dnerf(options.root)
    print(f"train with: {train_command()} data=dnerf data.root={root} data.scene=lego")


def _inspect(options: argparse.Namespace) -> None:
    import contextlib
    import json

    from xplanes.errors import SceneError
    from xplanes.evaluation.inspect import check_out, choose, facts, inspect, next_command, table
    from xplanes.evaluation.inspect_picture import write_picture

    choice = choose(options.arguments)
    out = options.out or Path(f"inspect_{Path(choice.scene.scene).name}.png")
    check_out(out, choice.scene)
    # Readers may say what they do; standard output is for JSON alone.
    with contextlib.redirect_stdout(sys.stderr) if options.json else contextlib.nullcontext():
        capture = inspect(choice)
    write_picture(out, capture)
    if options.json:
        print(json.dumps({**facts(capture), "picture": str(out)}, indent=2))
    else:
        _say(f"{table(capture)}\n\nwrote   {out}")
    if capture.problem:
        raise SceneError(capture.problem)
    if not options.json:
        _say(f"train   {next_command(capture)}")


def _triplanes(options: argparse.Namespace) -> None:
    from xplanes.config import compose_plain, settings_and_paths

    changed, paths = settings_and_paths(options.arguments)
    outs = [text for text in changed if text.startswith("out=")]
    plain = compose_plain("train", [text for text in changed if text not in outs])
    out = outs[-1].removeprefix("out=") if outs else "triplanes.safetensors"

    from xplanes.evaluation.turntable import write_triplanes
    from xplanes.experiment import Experiment

    write_triplanes(paths, Path(out), Experiment.read(plain), say=_say)


def _load(options: argparse.Namespace, split: str | None = None) -> "TrainedRun":
    from xplanes.evaluation.hub import SCHEME, fetch
    from xplanes.evaluation.runs import find_run, load_run

    on_hub = options.run.startswith(SCHEME)
    run = fetch(options.run, say=_say) if on_hub else find_run(Path(options.run))
    given = {"checkpoint": options.checkpoint, "plugins": options.plugin, "announce": _say}
    return load_run(run, split=split, **given)


def _filled(cls: type[T], options: argparse.Namespace) -> T:
    """A dataclass whose fields are called as the options are."""
    return cls(**{entry.name: getattr(options, entry.name) for entry in fields(cls)})  # type: ignore[arg-type]


def _evaluate(options: argparse.Namespace) -> None:
    from xplanes.evaluation.evaluate import evaluate, score_table, write_scores

    trained = _load(options, options.split)
    views = trained.views
    _say(f"split       {trained.split}, {len(views)} views of {views.outline}\n")
    scores = evaluate(trained, options.lpips)
    _say(score_table(scores))
    _say(f"wrote {write_scores(trained.path, scores)}")


def _render(options: argparse.Namespace) -> None:
    from xplanes.evaluation.render import VideoOptions, check_out, render_video

    wanted = _filled(VideoOptions, options).written_to(options.out)
    wanted.check()
    check_out(options.out, wanted)
    trained = _load(options)
    height, width = wanted.shape(trained.scene.splits)
    written = "as written" if wanted.cameras is not None else "back-and-forth"
    camera = f"{options.path} camera, time {wanted.time or written}"
    _say(f"frames      {wanted.count} of {width}x{height} px, {options.what}, {camera}\n")
    _say(f"wrote {render_video(trained, wanted, options.out)}")


def _view(options: argparse.Namespace) -> None:
    from xplanes.evaluation.viewer import Viewer, check_address

    check_address(options.host, options.port, key="--{} ")
    trained = _load(options)
    module = trained.module
    viewer = Viewer(
        module, trained.scene, lambda: module.renderer, host=options.host, port=options.port
    )
    viewer.tell(f"**{trained.path.name}**  \nstep {trained.step}, {trained.checkpoint}.ckpt")
    port = viewer.port
    _say(f"\nopen        http://localhost:{port}")
    _say(f"remotely    ssh -L {port}:localhost:{port} USER@THIS_MACHINE, then the same address")
    _say("stop        Ctrl-C")
    try:
        viewer.run()
    except KeyboardInterrupt:
        _say("")
    finally:
        viewer.close()


def _export(options: argparse.Namespace) -> None:
    from xplanes.evaluation.export import ExportOptions, export
    from xplanes.files import require_empty

    wanted = _filled(ExportOptions, options)
    wanted.check()
    if options.out is not None:
        require_empty(options.out)
    _say(f"wrote {export(_load(options), wanted, options.out, say=_say)}")


def _push(options: argparse.Namespace) -> None:
    from xplanes.evaluation.hub import push
    from xplanes.evaluation.runs import find_run

    run = find_run(options.run)
    _say(f"wrote {push(run, options.repository, private=options.private, say=_say)}")


def _table(options: argparse.Namespace) -> None:
    from xplanes.evaluation.table import write_tables

    print(write_tables(options.folder, options.out), end="")


def _sheet(options: argparse.Namespace) -> None:
    from xplanes.errors import ConfigError
    from xplanes.evaluation.sheet import write_sheet

    words = [] if options.steps is None else options.steps.split(",")
    if not all(word.strip().isdecimal() for word in words):
        raise ConfigError(f"--steps {options.steps}: must be numbers separated by commas")
    chosen = {name: getattr(options, name) for name in ("what", "show", "view", "size")}
    steps = [int(word) for word in words] or None
    _say(f"wrote {write_sheet(options.folder, options.out, steps=steps, **chosen)}")


class Command(NamedTuple):
    """A command of the program.

    Attributes:
        text: What it does, for the help.
        arguments: Positional arguments and options by name, as `add_argument` takes them.
        run: Runs it with the parsed options; None where Hydra reads the command line.
    """

    text: str
    arguments: dict[str, dict[str, Any]]
    run: Callable[[argparse.Namespace], None] | None = None


def _option(text: str, usual: Any = None, /, **more: Any) -> dict[str, Any]:
    """An option as `add_argument` takes it; a usual value gives its type and is in the help."""
    if usual is None:
        return {"help": text, **more}
    text = f"{text}; default: %(default)s".removeprefix("; ")
    return {"help": text, "type": type(usual), "default": usual, **more}


FOLDER = {"type": Path, "metavar": "FOLDER"}

RUN = {
    "run": _option("the run directory, or hf://USER/REPOSITORY of the hub", metavar="RUN"),
    "--checkpoint": _option("", "last", choices=["last", "best"]),
    "--plugin": _option(
        "your module with classes that the run's settings name; repeatable",
        action="append",
        default=[],
        metavar="MODULE",
    ),
}

COMMANDS = {
    "train": Command("train a field: key=value ..., and the options of Hydra", {}),
    "resume": Command(
        "continue a run: RUN key=value ...",
        {
            "run": _option("the run directory", metavar="RUN"),
            "overrides": _option(
                "what changes, and options of Hydra", nargs="*", metavar="KEY=VALUE"
            ),
        },
    ),
    "download": Command(
        "download public scenes",
        {
            "dataset": _option("the eight D-NeRF scenes", choices=["dnerf"]),
            "--root": _option("", Path("data/dnerf")),
        },
        _download,
    ),
    "inspect": Command(
        "print and draw what was read from a capture, and warn of common problems",
        {
            "arguments": _option(
                "the folder of a scene, settings of train.py, or both",
                nargs="+",
                metavar="FOLDER data.KEY=VALUE",
            ),
            "--out": _option(
                "the picture, a PNG; default: inspect_SCENE.png in the current directory", type=Path
            ),
            "--json": _option("print the facts as JSON", action="store_true"),
        },
        _inspect,
    ),
    "triplanes": Command(
        "encode images into triplanes with an LRM",
        {
            "arguments": _option(
                "RGBA images or folders of them, and settings of train.py",
                nargs="+",
                metavar="IMAGES lrm=NAME lrm.weights=FILE out=FILE.safetensors",
            )
        },
        _triplanes,
    ),
    "evaluate": Command(
        "compute PSNR, SSIM and LPIPS of all views of a split",
        {
            **RUN,
            "--split": _option(
                "default: the split scored at the end of training", choices=["test", "val", "train"]
            ),
            "--lpips": _option(
                "backbone of LPIPS, downloaded if necessary; default: vgg if already downloaded",
                choices=["vgg", "alex", "none"],
            ),
        },
        _evaluate,
    ),
    "render": Command(
        "render a video along a path of cameras and times",
        {
            **RUN,
            "--path": _option(
                "orbit or fixed (square frames), view:FILE (camera of a view, in its shape), or "
                "FILE.json (camera_path.json of nerfstudio, or a transforms file)",
                "orbit",
            ),
            "--time": _option(
                "sweep, back-and-forth, own (that of view:FILE), or a number from 0 to 1; default: "
                "back-and-forth, own for an image of view:FILE, or the times of FILE.json"
            ),
            "--frames": _option(
                "number of frames; default: 48, or 1 if neither camera nor time moves", type=int
            ),
            "--fps": _option("frames per second; default: 16, or as FILE.json says", type=int),
            "--size": _option(
                "pixels of the longer side; default: that of the training views, of the view, or "
                "as FILE.json says",
                type=int,
            ),
            "--elevation": _option("elevation of orbit and fixed in degrees", 20.0),
            "--what": _option("rendered quantity", "colour", choices=["colour", "depth"]),
            "--out": _option(
                "FILE.webp, FILE.mp4, FILE.png or FILE.jpg for one frame, or FOLDER/ for one PNG "
                "per frame"
            ),
        },
        _render,
    ),
    "view": Command(
        "interactive viewer in the browser (extra: viewer)",
        {
            **RUN,
            "--port": _option("port that is served; 0: any free one", 8080),
            "--host": _option("address that is served", "127.0.0.1"),
        },
        _view,
    ),
    "export": Command(
        "write meshes, points, a web page, planes, Gaussians or camera paths",
        {
            **RUN,
            "--what": _option(
                "what to write: mesh or points (extra: export), web (one HTML file below 20 MB "
                "that plays them; extra: export), planes (X-Planes only), path (of the training "
                "cameras), or what a model adds, such as gaussians",
                "mesh",
            ),
            "--out": _option("empty or new; default: RUN/export/WHAT", **FOLDER),
            "--times": _option(
                "a number of times spread evenly from 0 to 1, or times separated by commas; "
                "default: 10, 24 with --what web, or 1 in a static scene"
            ),
            "--resolution": _option("grid points along each side of the field's cube", 128),
            "--threshold": _option(
                "density of the surface; default: the one whose silhouettes match the field's best",
                type=float,
            ),
            "--points": _option(
                "points of a point cloud; default: 100000; with --what web, in place of the mesh",
                type=int,
                dest="count",
                metavar="COUNT",
            ),
            "--format": _option(
                "of meshes and point clouds", "ply", dest="form", choices=["ply", "glb"]
            ),
        },
        _export,
    ),
    "push": Command(
        "upload a run to the Hugging Face hub",
        {
            "run": _option("the run directory", type=Path, metavar="RUN"),
            "repository": _option("made if it does not exist yet", metavar="USER/REPOSITORY"),
            "--private": _option("make a private repository", action="store_true"),
        },
        _push,
    ),
    "table": Command(
        "compare the runs of a sweep in a table",
        {
            "folder": _option("a sweep or folder of runs", type=Path, metavar="SWEEP_DIR"),
            "--out": _option(
                "output folder of table.md and table.csv; default: SWEEP_DIR", **FOLDER
            ),
        },
        _table,
    ),
    "sheet": Command(
        "put pictures of runs side by side: the same view over runs or steps",
        {
            "folder": _option("a run, or a folder of runs", **FOLDER),
            "--what": _option(
                "a column per run (one seed per setting), a column per step, or the low-rank and "
                "sparse parts of the LRM's triplanes",
                "runs",
                choices=["runs", "steps", "parts"],
            ),
            "--show": _option(
                "what is shown of a view", "colour", choices=["colour", "error", "depth"]
            ),
            "--view": _option(
                "a view, as named in RUN/media, or the end of its name; default: one that all show"
            ),
            "--steps": _option("numbers of steps, separated by commas; default: all, or the last"),
            "--size": _option("pixels of a picture", 160),
            "--out": _option(
                "FILE.png, or with --what steps a video, FILE.webp; default: sheet_WHAT.png in "
                "FOLDER",
                type=Path,
                metavar="FILE",
            ),
        },
        _sheet,
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
    for name, command in COMMANDS.items():
        added = commands.add_parser(name, help=command.text)
        for argument, how in command.arguments.items():
            added.add_argument(argument, **how)
        added.set_defaults(command=command.run)
    for add in further:
        add(commands)
    return parser
