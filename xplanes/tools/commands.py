"""All commands except training: inspect, evaluate, render, view, export, table and others."""

import argparse
import sys
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from xplanes.cli import Command, add_table, option
from xplanes.process import say, train_command

if TYPE_CHECKING:
    from xplanes.tools.runs import TrainedRun

T = TypeVar("T")


def add_commands(commands: "argparse._SubParsersAction") -> None:
    """Add the parsers of the commands of `xplanes.tools`."""
    add_table(commands, COMMANDS)


RUN = {
    "run": option("the run directory, or hf://USER/REPOSITORY of the hub", metavar="RUN"),
    "--checkpoint": option("", "last", choices=["last", "best"]),
    "--plugin": option(
        "your module with classes used in the run's settings; repeatable",
        action="append",
        default=[],
        metavar="MODULE",
    ),
}

FOLDER = {"type": Path, "metavar": "FOLDER"}


def _download(options: argparse.Namespace) -> None:
    from xplanes.tools.download import download_dnerf

    root = download_dnerf(options.root)
    print(f"train with: {train_command()} data=dnerf data.root={root} data.scene=lego")


def _inspect(options: argparse.Namespace) -> None:
    import contextlib
    import json

    from xplanes.errors import SceneError
    from xplanes.tools.inspect import check_out, choose, facts, inspect, next_command, table
    from xplanes.tools.inspect_picture import write_picture

    choice = choose(options.arguments)
    out = options.out or Path(f"inspect_{Path(choice.scene.scene).name}.png")
    check_out(out, choice.scene)
    # Readers may print messages; standard output is reserved for the JSON.
    with contextlib.redirect_stdout(sys.stderr) if options.json else contextlib.nullcontext():
        capture = inspect(choice)
    write_picture(out, capture)
    if options.json:
        print(json.dumps({**facts(capture), "picture": str(out)}, indent=2))
    else:
        say(f"{table(capture)}\n\nwrote   {out}")
    if capture.problem:
        raise SceneError(capture.problem)
    if not options.json:
        say(f"train   {next_command(capture)}")


def _triplanes(options: argparse.Namespace) -> None:
    from xplanes.config import compose_plain, settings_and_paths

    changed, paths = settings_and_paths(options.arguments)
    outs = [text for text in changed if text.startswith("out=")]
    plain = compose_plain("train", [text for text in changed if text not in outs])
    out = outs[-1].removeprefix("out=") if outs else "triplanes.safetensors"

    from xplanes.experiment import Experiment
    from xplanes.tools.turntable import write_triplanes

    write_triplanes(paths, Path(out), Experiment.read(plain))


def _load(options: argparse.Namespace, split: str | None = None) -> "TrainedRun":
    """Load the run that the options of `RUN` name, from this machine or the hub."""
    from xplanes.tools.hub import SCHEME, fetch
    from xplanes.tools.runs import find_run, load_run

    on_hub = options.run.startswith(SCHEME)
    run = fetch(options.run) if on_hub else find_run(Path(options.run))
    given = {"checkpoint": options.checkpoint, "plugins": options.plugin, "announce": say}
    return load_run(run, split=split, **given)


def _filled(cls: type[T], options: argparse.Namespace) -> T:
    """A dataclass with the options as its fields, by name."""
    return cls(**{entry.name: getattr(options, entry.name) for entry in fields(cls)})  # type: ignore[arg-type]


def _evaluate(options: argparse.Namespace) -> None:
    from xplanes.tools.evaluate import evaluate, score_table, write_scores

    trained = _load(options, options.split)
    views = trained.views
    say(f"split       {trained.split}, {len(views)} views of {views.outline}\n")
    scores = evaluate(trained, options.lpips)
    say(score_table(scores))
    say(f"wrote {write_scores(trained.path, scores)}")


def _render(options: argparse.Namespace) -> None:
    from xplanes.tools.render import VideoOptions, render_video

    wanted = _filled(VideoOptions, options)
    wanted.check()
    say(f"wrote {render_video(_load(options), wanted)}")


def _view(options: argparse.Namespace) -> None:
    from xplanes.tools.viewer import Viewer, check_address

    check_address(options.host, options.port, key="--{} ")
    trained = _load(options)
    viewer = Viewer(trained.module, trained.scene, host=options.host, port=options.port)
    viewer.tell(f"**{trained.path.name}**  \nstep {trained.step}, {trained.checkpoint}.ckpt")
    port = viewer.port
    say(f"\nopen        http://localhost:{port}")
    say(f"remotely    ssh -L {port}:localhost:{port} USER@THIS_MACHINE, then the same address")
    say("stop        Ctrl-C")
    try:
        viewer.run()
    except KeyboardInterrupt:
        say("")
    finally:
        viewer.close()


def _export(options: argparse.Namespace) -> None:
    from xplanes.files import require_empty
    from xplanes.tools.export import ExportOptions, export

    wanted = _filled(ExportOptions, options)
    wanted.check()
    if options.out is not None:
        require_empty(options.out)
    say(f"wrote {export(_load(options), wanted, options.out)}")


def _push(options: argparse.Namespace) -> None:
    from xplanes.tools.hub import push
    from xplanes.tools.runs import find_run

    run = find_run(options.run)
    say(f"wrote {push(run, options.repository, private=options.private)}")


def _table(options: argparse.Namespace) -> None:
    from xplanes.tools.table import write_tables

    print(write_tables(options.folder, options.out), end="")


def _sheet(options: argparse.Namespace) -> None:
    from xplanes.errors import ConfigError
    from xplanes.tools.sheet import write_sheet

    words = [] if options.steps is None else options.steps.split(",")
    if not all(word.strip().isdecimal() for word in words):
        raise ConfigError(f"--steps {options.steps}: must be numbers separated by commas")
    chosen = {name: getattr(options, name) for name in ("what", "show", "view", "size")}
    steps = [int(word) for word in words] or None
    say(f"wrote {write_sheet(options.folder, options.out, steps=steps, **chosen)}")


COMMANDS = {
    "download": Command(
        "download public scenes",
        {
            "dataset": option("the eight D-NeRF scenes", choices=["dnerf"]),
            "--root": option("", Path("data/dnerf")),
        },
        _download,
    ),
    "inspect": Command(
        "summarise a capture in a table and a picture, and warn of common problems",
        {
            "arguments": option(
                "the folder of a scene, settings of train.py, or both",
                nargs="+",
                metavar="FOLDER data.KEY=VALUE",
            ),
            "--out": option(
                "the picture, a PNG; default: inspect_SCENE.png in the current directory", type=Path
            ),
            "--json": option("print the facts as JSON", action="store_true"),
        },
        _inspect,
    ),
    "triplanes": Command(
        "encode images into triplanes with an LRM",
        {
            "arguments": option(
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
            "--split": option(
                "default: the split scored at the end of training", choices=["test", "val", "train"]
            ),
            "--lpips": option(
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
            "--path": option(
                "orbit or fixed (square frames), cameras (where training cameras were), view:FILE "
                "(camera and aspect ratio of a view), FILE.json (camera_path.json of nerfstudio or "
                "a transforms file) or auto: cameras in scenes with surroundings, else orbit",
                "auto",
            ),
            "--time": option(
                "sweep, back-and-forth, own (time of view:FILE), or a number from 0 to 1; default: "
                "back-and-forth, own for cameras and images of view:FILE, the times of FILE.json"
            ),
            "--frames": option(
                "number of frames; default: 48, or 1 if neither camera nor time moves", type=int
            ),
            "--fps": option("frames per second; default: 16, or the rate in FILE.json", type=int),
            "--size": option(
                "pixels of the longer side; default: that of the training views, of the view, or "
                "of FILE.json",
                type=int,
            ),
            "--elevation": option("elevation of orbit and fixed in degrees", 20.0),
            "--what": option("rendered quantity", "colour", choices=["colour", "depth"]),
            "--out": option(
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
            "--port": option("port to serve on; 0: any free one", 8080),
            "--host": option("address to serve on", "127.0.0.1"),
        },
        _view,
    ),
    "export": Command(
        "write meshes, points, a web page, planes, Gaussians or camera paths",
        {
            **RUN,
            "--what": option(
                "what to write: mesh or points (extra: export), web (one HTML file below 20 MB "
                "that animates them; extra: export), planes (X-Planes only), path (through the "
                "training cameras), or a format of the model, such as gaussians",
                "mesh",
            ),
            "--out": option("empty or new; default: RUN/export/WHAT", **FOLDER),
            "--times": option(
                "a number of times spread evenly from 0 to 1, or times separated by commas; "
                "default: 10, 24 with --what web, or 1 in a static scene"
            ),
            "--resolution": option("grid points along each side of the field's cube", 128),
            "--threshold": option(
                "density of the surface; default: the one whose silhouettes match the field's best",
                type=float,
            ),
            "--points": option(
                "points of a point cloud; default: 100000; with --what web, in place of the mesh",
                type=int,
                dest="count",
                metavar="COUNT",
            ),
            "--format": option(
                "for meshes and point clouds", "ply", dest="form", choices=["ply", "glb"]
            ),
        },
        _export,
    ),
    "push": Command(
        "upload a run to the Hugging Face hub",
        {
            "run": option("the run directory", type=Path, metavar="RUN"),
            "repository": option("created if it does not exist", metavar="USER/REPOSITORY"),
            "--private": option("create a private repository", action="store_true"),
        },
        _push,
    ),
    "table": Command(
        "compare the runs of a sweep in a table",
        {
            "folder": option("a sweep or folder of runs", type=Path, metavar="SWEEP_DIR"),
            "--out": option(
                "output folder of table.md and table.csv; default: SWEEP_DIR", **FOLDER
            ),
        },
        _table,
    ),
    "sheet": Command(
        "put pictures of runs side by side: the same view over runs or steps",
        {
            "folder": option("a run, or a folder of runs", **FOLDER),
            "--what": option(
                "a column per run (one seed per setting), a column per step, or the low-rank and "
                "sparse parts of the LRM's triplanes",
                "runs",
                choices=["runs", "steps", "parts"],
            ),
            "--show": option("quantity to show", "colour", choices=["colour", "error", "depth"]),
            "--view": option(
                "a view, as named in RUN/media, or the end of its name; default: one that all have"
            ),
            "--steps": option("numbers of steps, separated by commas; default: all, or the last"),
            "--size": option("pixels of a picture", 160),
            "--out": option(
                "FILE.png, or with --what steps a video, FILE.webp; default: sheet_WHAT.png in "
                "FOLDER",
                type=Path,
                metavar="FILE",
            ),
        },
        _sheet,
    ),
}
