"""The commands `xplanes pretrain-lrm` and `xplanes score-lrm`."""

import argparse
from pathlib import Path

from xplanes.process import say


def add_commands(commands: "argparse._SubParsersAction") -> None:
    """Add both commands to the command line; heavy modules are imported when they run."""
    parser = commands.add_parser("pretrain-lrm", help="train a small LRM on procedural objects")
    parser.add_argument(
        "overrides", nargs="*", metavar="key=value", help="settings of conf/pretrain_lrm.yaml"
    )
    parser.set_defaults(command=_pretrain)
    parser = commands.add_parser("score-lrm", help="evaluate a small LRM on held-out objects")
    parser.add_argument("model", help="tiny, mini, or FOLDER/NAME.safetensors")
    parser.add_argument(
        "--objects", type=int, default=64, help="number of objects; default: %(default)s"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("outputs/score-lrm"),
        help="output folder; default: %(default)s",
    )
    parser.set_defaults(command=_score)


def _pretrain(options: argparse.Namespace) -> None:
    from xplanes.synthetic.pretraining.run import run_pretraining

    say(f"wrote {run_pretraining(options.overrides, say)}")


def _score(options: argparse.Namespace) -> None:
    from xplanes.errors import ConfigError
    from xplanes.lrm.weights import FOLDER, load_bundled
    from xplanes.synthetic.pretraining.score import score_all

    if options.objects < 1:
        raise ConfigError(f"--objects {options.objects}: must be at least 1")
    path = Path(options.model)
    own = path.suffix == ".safetensors"
    model, _ = load_bundled(path.stem if own else options.model, path.parent if own else FOLDER)
    score_all(model, options.out, objects=options.objects, announce=say)
    say(f"wrote {options.out}/scores.json, objects.png, failures.png and demo.png")
