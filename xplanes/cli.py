"""The command line: `xplanes COMMAND ...`.

Heavy modules are imported by the commands that need them, so that the help is fast.
"""

import argparse
import difflib
import os
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from xplanes import __version__
from xplanes.errors import XPlanesError
from xplanes.process import defaults, train_command

if TYPE_CHECKING:
    from xplanes.evaluation.runs import TrainedRun

AddCommands = Callable[["argparse._SubParsersAction"], None]
"""Adds parsers of commands; each sets ``command``, which is called with the parsed options."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        arguments: What follows ``xplanes``; taken from the command line when None.

    Returns:
        The exit code: 0, 1 after a reported error, 130 after Ctrl-C.
    """
    os.environ.update(defaults(os.environ))  # before torch is loaded
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
    commands.add_parser("train", help="train a field: key=value ..., and the options of Hydra")
    resume = commands.add_parser("resume", help="continue a run: RUN key=value ...")
    resume.add_argument("run", metavar="RUN", help="the run directory")
    resume.add_argument(
        "overrides", nargs="*", metavar="KEY=VALUE", help="what changes, and options of Hydra"
    )
    verbs = (_add_download, _add_inspect, _add_triplanes, _add_evaluate, _add_render, _add_view)
    for add in (*verbs, _add_export, _add_push, _add_table, _add_sheet, *further):
        add(commands)
    return parser


def _add_download(commands: "argparse._SubParsersAction") -> None:
    parser = commands.add_parser("download", help="download public scenes")
    parser.add_argument("dataset", choices=["dnerf"], help="the eight D-NeRF scenes")
    parser.add_argument(
        "--root", type=Path, default=Path("data/dnerf"), help="default: %(default)s"
    )
    parser.set_defaults(command=_download)


def _download(options: argparse.Namespace) -> None:
    from xplanes.scenes.download import download_dnerf

    root = download_dnerf(options.root)
    print(f"train with: {train_command()} data=dnerf data.root={root} data.scene=lego")


def _add_inspect(commands: "argparse._SubParsersAction") -> None:
    parser = commands.add_parser(
        "inspect", help="print and draw what was read from a capture, and warn of common problems"
    )
    parser.add_argument(
        "arguments",
        nargs="+",
        metavar="FOLDER data.KEY=VALUE",
        help="the folder of a scene, settings of train.py, or both",
    )
    parser.add_argument(
        "--out",
        type=Path,
        help="the picture, a PNG; default: inspect_SCENE.png in the current directory",
    )
    parser.add_argument("--json", action="store_true", help="print the facts as JSON")
    parser.set_defaults(command=_inspect)


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


def _add_triplanes(commands: "argparse._SubParsersAction") -> None:
    parser = commands.add_parser("triplanes", help="encode images into triplanes with an LRM")
    parser.add_argument(
        "arguments",
        nargs="+",
        metavar="IMAGES lrm=NAME lrm.weights=FILE out=FILE.safetensors",
        help="RGBA images or folders of them, and settings of train.py",
    )
    parser.set_defaults(command=_triplanes)


def _triplanes(options: argparse.Namespace) -> None:
    from xplanes.config import compose_plain

    changed = [text for text in options.arguments if "=" in text and not Path(text).exists()]
    paths = [Path(text) for text in options.arguments if text not in changed]
    outs = [text for text in changed if text.startswith("out=")]
    plain = compose_plain("train", [text for text in changed if text not in outs])
    out = outs[-1].removeprefix("out=") if outs else "triplanes.safetensors"

    from xplanes.evaluation.turntable import write_triplanes
    from xplanes.experiment import Experiment

    write_triplanes(paths, Path(out), Experiment.read(plain), say=_say)


def _add_run(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "run", metavar="RUN", help="the run directory, or hf://USER/REPOSITORY of the hub"
    )
    parser.add_argument(
        "--checkpoint", choices=["last", "best"], default="last", help="default: %(default)s"
    )
    parser.add_argument(
        "--plugin",
        action="append",
        default=[],
        metavar="MODULE",
        help="your module with classes that the run's settings name; repeatable",
    )


def _load(options: argparse.Namespace, split: str | None = None) -> "TrainedRun":
    from xplanes.evaluation.hub import SCHEME, fetch
    from xplanes.evaluation.runs import find_run, load_run

    on_hub = options.run.startswith(SCHEME)
    run = fetch(options.run, say=_say) if on_hub else find_run(Path(options.run))
    return load_run(
        run,
        checkpoint=options.checkpoint,
        split=split,
        plugins=options.plugin,
        announce=_say,
    )


def _say(text: str) -> None:
    print(text, flush=True)


def _add_evaluate(commands: "argparse._SubParsersAction") -> None:
    parser = commands.add_parser(
        "evaluate", help="compute PSNR, SSIM and LPIPS of all views of a split"
    )
    _add_run(parser)
    parser.add_argument(
        "--split",
        choices=["test", "val", "train"],
        help="default: the split scored at the end of training",
    )
    parser.add_argument(
        "--lpips",
        choices=["vgg", "alex", "none"],
        help="backbone of LPIPS, downloaded if necessary; default: vgg if already downloaded",
    )
    parser.set_defaults(command=_evaluate)


def _evaluate(options: argparse.Namespace) -> None:
    from xplanes.evaluation.evaluate import evaluate, score_table, write_scores

    trained = _load(options, options.split)
    views = trained.views
    _say(f"split       {trained.split}, {len(views)} views of {views.outline}\n")
    scores = evaluate(trained, options.lpips)
    _say(score_table(scores))
    _say(f"wrote {write_scores(trained.path, scores)}")


def _add_render(commands: "argparse._SubParsersAction") -> None:
    parser = commands.add_parser("render", help="render a video along a path of cameras and times")
    _add_run(parser)
    parser.add_argument(
        "--path",
        default="orbit",
        help="orbit or fixed (square frames), view:FILE (camera of a view, in its shape), or "
        "FILE.json (camera_path.json of nerfstudio, or a transforms file); default: %(default)s",
    )
    parser.add_argument(
        "--time",
        help="sweep, back-and-forth, own (that of view:FILE), or a number from 0 to 1; default: "
        "back-and-forth, own for an image of view:FILE, or the times of FILE.json",
    )
    parser.add_argument(
        "--frames",
        type=int,
        help="number of frames; default: 48, or 1 if neither camera nor time moves",
    )
    parser.add_argument(
        "--fps", type=int, help="frames per second; default: 16, or as FILE.json says"
    )
    parser.add_argument(
        "--size",
        type=int,
        help="pixels of the longer side; default: that of the training views, of the view, or as "
        "FILE.json says",
    )
    parser.add_argument(
        "--elevation",
        type=float,
        default=20.0,
        help="elevation of orbit and fixed in degrees; default: %(default)s",
    )
    parser.add_argument(
        "--what",
        choices=["colour", "depth"],
        default="colour",
        help="rendered quantity; default: %(default)s",
    )
    parser.add_argument(
        "--out",
        help="FILE.webp, FILE.mp4, FILE.png or FILE.jpg for one frame, or FOLDER/ for one PNG per "
        "frame",
    )
    parser.set_defaults(command=_render)


def _render(options: argparse.Namespace) -> None:
    from xplanes.evaluation.render import VideoOptions, check_out, render_video

    wanted = VideoOptions(
        path=options.path,
        time=options.time,
        frames=options.frames,
        fps=options.fps,
        size=options.size,
        elevation=options.elevation,
        what=options.what,
    ).written_to(options.out)
    wanted.check()
    check_out(options.out, wanted)
    trained = _load(options)
    height, width = wanted.shape(trained.scene.splits)
    written = "as written" if wanted.cameras is not None else "back-and-forth"
    camera = f"{options.path} camera, time {wanted.time or written}"
    _say(f"frames      {wanted.count} of {width}x{height} px, {options.what}, {camera}\n")
    _say(f"wrote {render_video(trained, wanted, options.out)}")


def _add_view(commands: "argparse._SubParsersAction") -> None:
    parser = commands.add_parser("view", help="interactive viewer in the browser (extra: viewer)")
    _add_run(parser)
    parser.add_argument(
        "--port",
        type=int,
        default=8080,
        help="port that is served; 0: any free one; default: %(default)s",
    )
    parser.add_argument(
        "--host", default="127.0.0.1", help="address that is served; default: %(default)s"
    )
    parser.set_defaults(command=_view)


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


def _add_export(commands: "argparse._SubParsersAction") -> None:
    parser = commands.add_parser(
        "export",
        help="write meshes, points, a web page, planes, Gaussians or camera paths",
    )
    _add_run(parser)
    parser.add_argument(
        "--what",
        default="mesh",
        help="what to write: mesh or points (extra: export), web (one HTML file below 20 MB that "
        "plays them; extra: export), planes (X-Planes only), path (of the training cameras), or "
        "what a model adds, such as gaussians; default: %(default)s",
    )
    parser.add_argument(
        "--out", type=Path, metavar="FOLDER", help="empty or new; default: RUN/export/WHAT"
    )
    parser.add_argument(
        "--times",
        help="a number of times spread evenly from 0 to 1, or times separated by commas; "
        "default: 10, 24 with --what web, or 1 in a static scene",
    )
    parser.add_argument(
        "--resolution",
        type=int,
        default=128,
        help="grid points along each side of the field's cube; default: %(default)s",
    )
    parser.add_argument(
        "--threshold",
        type=float,
        help="density of the surface; default: the one whose silhouettes match the field's best",
    )
    parser.add_argument(
        "--points",
        type=int,
        metavar="COUNT",
        help="points of a point cloud; default: 100000; with --what web, points replace the mesh",
    )
    parser.add_argument(
        "--format",
        choices=["ply", "glb"],
        default="ply",
        help="of meshes and point clouds; default: %(default)s",
    )
    parser.set_defaults(command=_export)


def _export(options: argparse.Namespace) -> None:
    from xplanes.evaluation.export import ExportOptions, check_folder, export

    wanted = ExportOptions(
        what=options.what,
        times=options.times,
        resolution=options.resolution,
        threshold=options.threshold,
        count=options.points,
        form=options.format,
    )
    wanted.check()
    if options.out is not None:
        check_folder(options.out)
    _say(f"wrote {export(_load(options), wanted, options.out, say=_say)}")


def _add_push(commands: "argparse._SubParsersAction") -> None:
    parser = commands.add_parser("push", help="upload a run to the Hugging Face hub")
    parser.add_argument("run", type=Path, metavar="RUN", help="the run directory")
    parser.add_argument(
        "repository", metavar="USER/REPOSITORY", help="made if it does not exist yet"
    )
    parser.add_argument("--private", action="store_true", help="make a private repository")
    parser.set_defaults(command=_push)


def _push(options: argparse.Namespace) -> None:
    from xplanes.evaluation.hub import push
    from xplanes.evaluation.runs import find_run

    run = find_run(options.run)
    _say(f"wrote {push(run, options.repository, private=options.private, say=_say)}")


def _add_table(commands: "argparse._SubParsersAction") -> None:
    parser = commands.add_parser("table", help="compare the runs of a sweep in a table")
    parser.add_argument("folder", type=Path, metavar="SWEEP_DIR", help="a sweep or folder of runs")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FOLDER",
        help="output folder of table.md and table.csv; default: SWEEP_DIR",
    )
    parser.set_defaults(command=_table)


def _table(options: argparse.Namespace) -> None:
    from xplanes.evaluation.table import write_tables

    print(write_tables(options.folder, options.out), end="")


def _add_sheet(commands: "argparse._SubParsersAction") -> None:
    parser = commands.add_parser(
        "sheet", help="put pictures of runs side by side: the same view over runs or steps"
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="a run, or a folder of runs")
    parser.add_argument(
        "--what",
        choices=["runs", "steps", "parts"],
        default="runs",
        help="a column per run (one seed per setting), a column per step, or the low-rank and "
        "sparse parts of the LRM's triplanes; default: %(default)s",
    )
    parser.add_argument(
        "--show",
        choices=["colour", "error", "depth"],
        default="colour",
        help="what is shown of a view; default: %(default)s",
    )
    parser.add_argument(
        "--view",
        help="a view, as named in RUN/media, or the end of its name; default: one that all show",
    )
    parser.add_argument(
        "--steps", help="numbers of steps, separated by commas; default: all, or the last"
    )
    parser.add_argument(
        "--size", type=int, default=160, help="pixels of a picture; default: %(default)s"
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="FILE.png, or with --what steps a video, FILE.webp; default: sheet_WHAT.png in FOLDER",
    )
    parser.set_defaults(command=_sheet)


def _sheet(options: argparse.Namespace) -> None:
    from xplanes.errors import ConfigError
    from xplanes.evaluation.sheet import write_sheet

    words = [] if options.steps is None else options.steps.split(",")
    if not all(word.strip().isdecimal() for word in words):
        raise ConfigError(f"--steps {options.steps}: must be numbers separated by commas")
    path = write_sheet(
        options.folder,
        options.out,
        what=options.what,
        show=options.show,
        view=options.view,
        steps=[int(word) for word in words] or None,
        size=options.size,
    )
    _say(f"wrote {path}")
