"""Write the pages that follow from the code: `python docs/generate.py`.

docs/configuration.md comes from conf/ and the classes it names, docs/command_line.md from the
parser of the command line, docs/api.md from the signatures and docstrings of what it lists,
examples/first_minute.ipynb from the script beside it. The project's addresses in other files come
from pyproject.toml.
"""

import argparse
import ast
import importlib
import inspect
import json
import pkgutil
import re
import textwrap
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import yaml

from xplanes.cli import build_parser, further_commands
from xplanes.settings import Settings
from xplanes.synthetic.pretraining.settings import PretrainingSettings

ROOT = Path(__file__).resolve().parent.parent
CONF = ROOT / "conf"

GROUPS = ("data", "model", "model/sampler", "lrm", "preparation", "decomposition")
"""Groups of settings classes, in the order of the page."""

_FIELD = re.compile(r"    (\w+): .*?(?:  # (.+))?$")
_ARGUMENT = re.compile(r"^    (\w+): (.+?)(?=^    \w|\Z)", re.MULTILINE | re.DOTALL)
_CODE = re.compile(r"\+\S+=\{.*?\}|\b_\w+_\b")  # Markdown would set `_target_` in italics.
_TOP_LEVEL = re.compile(r"^(\w+): (.*?)(?:  # (.+))?$", re.MULTILINE)

LIGHTNING = (
    "See [Lightning's manual](https://lightning.ai/docs/pytorch/stable/common/trainer.html)."
)


def merged(base: Mapping[str, Any], more: Mapping[str, Any]) -> dict[str, Any]:
    """One mapping over another, at every depth."""
    whole = dict(base)
    for key, value in more.items():
        both = isinstance(value, dict) and isinstance(whole.get(key), dict)
        whole[key] = merged(whole[key], value) if both else value
    return whole


def values(group: str, option: str) -> dict[str, Any]:
    """The values of a YAML file, those it inherits from a sibling included."""
    text = (CONF / group / f"{option}.yaml").read_text(encoding="utf-8")
    content = yaml.safe_load(_CASE.sub(r"\1", text))
    found: dict[str, Any] = {}
    for parent in content.pop("defaults", []):
        if isinstance(parent, str) and parent != "_self_":
            found = merged(found, values(group, parent))
    return merged(found, content)


_CASE = re.compile(r"\$\{case:.*,(.*)\}")
"""A value that depends on the recipe; the last part is the one without."""

FIRST = "demo six_planes none default small base tineuvox_s tiny occupancy proposal csv".split()
"""Options that stand before others of their group."""


def options_of(group: str) -> dict[str, dict[str, Any]]:
    """The options of a group with their values."""
    names = sorted(path.stem for path in (CONF / group).glob("*.yaml"))
    order = [name for name in FIRST if name in names]
    return {name: values(group, name) for name in dict.fromkeys([*order, *names])}


def class_of(node: Mapping[str, Any]) -> type:
    """The class that a node names as ``_target_``."""
    module, _, name = node["_target_"].rpartition(".")
    return getattr(importlib.import_module(module), name)


def comments(cls: type) -> dict[str, str]:
    """What the source says of each setting: behind it, above it, or under "Args:"."""
    found: dict[str, str] = {}
    for parent in reversed(cls.__mro__):
        if not parent.__module__.startswith("xplanes"):
            continue
        found |= arguments(parent)
        above: list[str] = []
        for line in inspect.getsource(parent).splitlines():
            if line.startswith("    # "):
                above.append(line.removeprefix("    # "))
                continue
            if (match := _FIELD.fullmatch(line)) is not None:
                text = match[2] or " ".join(above)
                if text:
                    found[match[1]] = text
            above = []
    return found


def arguments(cls: type) -> dict[str, str]:
    """The section "Args:" of a docstring, one line for each."""
    _, _, section = (inspect.getdoc(cls) or "").partition("Args:\n")
    section = re.split(r"^\S", section, maxsplit=1, flags=re.MULTILINE)[0]
    return {name: in_yaml(" ".join(text.split())) for name, text in _ARGUMENT.findall(section)}


def about(cls: type) -> str:
    """The first line of a docstring."""
    return in_yaml((cls.__doc__ or "").split("\n")[0])


def in_yaml(text: str) -> str:
    """Words of a docstring, with values as YAML has them."""
    return re.sub(r"\bNone\b", "null", text.replace("``", "`"))


def choices(hint: Any) -> str:
    """The values of a setting that is one of a few, as a sentence."""
    if get_origin(hint) is not Literal:
        return ""
    return f"One of {', '.join(f'`{choice}`' for choice in get_args(hint))}."


def sentence(text: str) -> str:
    """Words that stand behind a key in a YAML file, as a sentence."""
    capital = text[:1].upper() + text[1:] if re.match(r"[a-z]+ [a-z]", text) else text
    return capital + ("" if text.endswith(".") else ".")


def listed(group: str, options: Iterable[str]) -> list[str]:
    """What each option is, where there are several."""
    lines = [f"- `{option}`: {head(CONF / group / f'{option}.yaml')}" for option in options]
    return [*lines, ""] if len(lines) > 1 else []


def shown(value: Any) -> str:
    """A value as YAML writes it, on one line."""
    return yaml.safe_dump(value, default_flow_style=True, width=10_000).split("\n")[0]


def row(key: str, meaning: str, of_options: Mapping[str, Any]) -> str:
    """A line of a table; one value where that of all options is the same."""
    cells = [shown(value) for value in of_options.values()]
    cells = cells[:1] if len(set(cells)) == 1 else cells
    return f"| `{key}` | {meaning} | {' · '.join(cells)} |"


def rows(cls: type[Settings], options: Mapping[str, Any], prefix: str) -> list[str]:
    """One line per setting: key, meaning, value in each option."""
    lines, meaning, hints = [], comments(cls), get_type_hints(cls)
    for entry in fields(cls):
        key, hint = f"{prefix}{entry.name}", hints[entry.name]
        if isinstance(hint, type) and issubclass(hint, Settings):
            if f"{prefix}{entry.name}".replace(".", "/") not in GROUPS:
                inner = {name: value[entry.name] for name, value in options.items()}
                lines += rows(hint, inner, f"{key}.")
            continue
        words = [meaning.get(entry.name, ""), choices(hint)]
        inner = {name: value[entry.name] for name, value in options.items()}
        own = [kind for kind in get_args(hint) if isinstance(kind, type)]
        if nested := [kind for kind in own if issubclass(kind, Settings)]:
            lines.append(row(key, " ".join(filter(None, words)), dict.fromkeys(inner, "below")))
            lines += rows(nested[0], inner, f"{key}.")
            continue
        lines.append(row(key, " ".join(filter(None, words)), inner))
    return lines


TABLE = ["| key | meaning | value |", "|---|---|---|"]


def section(group: str) -> list[str]:
    """The options of a group of settings: a table for each class."""
    by_class: dict[type, dict[str, dict[str, Any]]] = {}
    for option, content in options_of(group).items():
        by_class.setdefault(class_of(content), {})[option] = content
    parts: list[str] = []
    for cls, named in by_class.items():
        names = ", ".join(f"`{group}={option}`" for option in named)
        parts += ["", f"## {names}", "", about(cls), ""]
        parts += listed(group, named)
        parts += [*TABLE, *rows(cls, named, f"{group.replace('/', '.')}.")]
    return parts


def trainer() -> list[str]:
    """The Trainer's arguments."""
    options = options_of("trainer")
    cls = class_of(options["default"])
    names = ", ".join(f"`trainer={option}`" for option in options)
    told = arguments(cls)
    text = (CONF / "trainer" / "default.yaml").read_text(encoding="utf-8")
    told = {key: sentence(words) for key, _, words in _TOP_LEVEL.findall(text) if words} | told
    lines = ["", f"## {names}", "", about(cls)]
    lines += ["Further arguments of Lightning's are added with `+trainer.KEY=VALUE`.", ""]
    lines += [*listed("trainer", options), *TABLE]
    keys = [key for key in options["default"] if key != "_target_"]
    for key in keys:
        of_options = {name: content[key] for name, content in options.items()}
        lines.append(row(f"trainer.{key}", told.get(key, LIGHTNING), of_options))
    return lines


def nodes(group: str, words: str) -> list[str]:
    """A group of components by name: callbacks, loggers."""
    options = options_of(group)
    names = ", ".join(f"`{group}={option}`" for option in options)
    lines = ["", f"## {names}", "", words, ""]
    lines += [*listed(group, options), *TABLE]
    everything: dict[str, Any] = {}
    for content in options.values():
        everything = merged(everything, content)
    for name, node in everything.items():
        cls = class_of(node) if node["_target_"].startswith("xplanes.") else None
        words = "" if cls is None else about(cls)
        lines.append(f"| `{group}.{name}` | {words} | `{node['_target_']}` |")
        told = {} if cls is None else arguments(cls)
        for key, value in node.items():
            if key != "_target_":
                full = f"{group}.{name}.{key}"
                lines.append(row(full, told.get(key, ""), {"": value}))
    return lines


def document() -> str:
    """The whole page."""
    parts = [
        "# Configuration",
        "",
        "Generated from `conf/` and the classes that it names by `python docs/generate.py`.",
        "",
        "Every key can be set on the command line, `python train.py data.views=10 trainer=cpu`.",
        "Where the options of a group differ, values are listed in the order of the options.",
        "",
        *TABLE,
    ]
    text = (CONF / "train.yaml").read_text(encoding="utf-8")
    for key, value, words in _TOP_LEVEL.findall(text):
        if value:
            meaning = _CODE.sub(r"`\g<0>`", sentence(words))
            parts.append(f"| `{key}` | {meaning} | {value} |")
    for group in GROUPS:
        parts += section(group)
    parts += trainer()
    for group, words in NODES.items():
        parts += nodes(group, words)
    for group, words in SETS.items():
        parts += ["", f"## `{group}`", "", words, "", f"| {group} | what it is |", "|---|---|"]
        for path in sorted((CONF / group).glob("*.yaml")):
            parts.append(f"| `{group}={path.stem}` | {head(path)} |")
    parts += ["", "## Environment", "", "| variable | meaning |", "|---|---|"]
    parts += [f"| `{name}` | {meaning} |" for name, meaning in ENVIRONMENT.items()]
    return "\n".join([*parts, *pretraining()]) + "\n"


def pretraining() -> list[str]:
    """The settings of the other program."""
    shared = yaml.safe_load((CONF / "pretrain_lrm.yaml").read_text(encoding="utf-8"))
    shared.pop("defaults")
    options = {name: {**shared, "model": values("pretrain", name)} for name in ("tiny", "mini")}
    return [
        "",
        "## `xplanes pretrain-lrm`, with `pretrain=tiny`, `pretrain=mini`",
        "",
        "Training of a small LRM: cards of [tiny](lrm_tiny.md) and [mini](lrm_mini.md).",
        "",
        *TABLE,
        *rows(PretrainingSettings, options, ""),
    ]


NODES = {
    "callbacks": "Callbacks of the Trainer. `callbacks.NAME=null` leaves one out; any callback of "
    "Lightning is added with `+callbacks.NAME={_target_: MODULE.CLASS, ...}`. EarlyStopping and "
    "ModelCheckpoint see `val/psnr` and `val/ssim` after each evaluation "
    "(`callbacks.evaluation.at`).",
    "logger": "Where scalars and images go; any logger of Lightning is added with "
    "`+logger.NAME={_target_: MODULE.CLASS, ...}`. `save_dir` is the run directory, where a logger "
    "takes one.",
}
"""Groups of components that have names of their own."""

SETS = {
    "recipe": "The paper's settings, or equal ones; see [the method and the paper](paper.md).",
    "experiment": "Settings of one run for a purpose, or of each run of a sweep.",
    "sweep": "Many runs and their table: `python train.py -m sweep=NAME`.",
}
"""Groups whose files set keys of other groups."""

ENVIRONMENT = {
    "OMP_NUM_THREADS": "Maximum number of threads of torch and the compiled loops.",
    "OMP_WAIT_POLICY, GOMP_SPINCOUNT": "How threads wait; defaults apply if neither is set.",
    "ONEDNN_PRIMITIVE_CACHE_CAPACITY": "Compiled bfloat16 products that are kept; 256 unless set.",
    "NUMBA_CACHE_DIR": "Folder that keeps the compiled loops of the CPU; without one that can be "
    "written they are compiled at every start.",
    "TRITON_CACHE_DIR": "The same for the kernels of a GPU.",
    "XPLANES_CPU_LOOPS=0": "Plain torch instead of compiled loops on the CPU.",
    "XPLANES_GPU_KERNELS=0": "Plain torch instead of Triton kernels on a GPU.",
}


def head(path: Path) -> str:
    """The first sentence of the comment in a file that says what it is."""
    text = path.read_text(encoding="utf-8")
    lines = [line[2:] for line in text.splitlines() if line.startswith("# ")]
    words = " ".join(line for line in lines if not line.startswith("@"))
    return words.split(". ")[0].rstrip(".") + "."


def command_line() -> str:
    """The page of all commands and their options."""
    commands = next(
        action
        for action in build_parser(further_commands())._actions
        if isinstance(action, argparse._SubParsersAction)
    )
    lines = [
        "# Command line",
        "",
        "`xplanes COMMAND`, or `python -m xplanes COMMAND`. Written by `python docs/generate.py`.",
    ]
    words = {choice.dest: choice.help or "" for choice in commands._choices_actions}
    for name, parser in commands.choices.items():
        lines += ["", f"## xplanes {name}", "", f"{words[name][:1].upper()}{words[name][1:]}."]
        if name == "train":
            same = (
                "The same as `python train.py`; [configuration](configuration.md) lists its keys."
            )
            lines += ["", same]
            continue
        formatter = argparse.HelpFormatter(parser.prog)
        lines += ["", "| argument | meaning |", "|---|---|"]
        for action in parser._actions:
            if "-h" in action.option_strings:
                continue
            if not action.option_strings:
                shown = formatter._metavar_formatter(action, action.dest)(1)[0]
            elif action.nargs == 0:
                shown = action.option_strings[0]
            else:
                value = formatter._metavar_formatter(action, action.dest.upper())(1)[0]
                shown = f"{action.option_strings[0]} {value}"
            meaning = sentence(formatter._expand_help(action)) if action.help else ""
            meaning = re.sub("^default: ", "Default: ", meaning)
            lines.append(f"| `{shown}` | {meaning} |")
    return "\n".join(lines) + "\n"


API = """\
# Python API

Training in any Lightning Trainer, robust PCA alone, and LRMs alone. Written by
`python docs/generate.py`. [Recipes](recipes.md#lightning-alone) has a script that trains, tests and
reloads.

## Training

::: xplanes.scenes.datamodule.SceneDataModule
    options:
      members: [compose, of, from_run]

::: xplanes.training.module.RadianceModule
    options:
      members: [compose, of, load_from_checkpoint, build]

## The field

::: xplanes.fields.xplanes.XPlanes
    options:
      members: [forward]

## Decomposition

::: xplanes.decomposition.rpca.robust_pca

::: xplanes.decomposition.rpca.RobustPCA

::: xplanes.decomposition.rpca.decompose

::: xplanes.decomposition.rpca.Decomposition

::: xplanes.decomposition.conversion.space_planes

::: xplanes.decomposition.conversion.time_planes

::: xplanes.decomposition.sparse_loss.sparse_product_loss

## Large Reconstruction Models

::: xplanes.lrm.checkpoint.load

::: xplanes.lrm.model.LRM
    options:
      members: [encode, prepare]

## Cameras and scenes

::: xplanes.scenes.views.Scene

::: xplanes.scenes.views.Views
    options:
      members: [image, image_rays, subset]

## Base classes of plug-ins

[Contributing](CONTRIBUTING.md#adding-things) says which files a component needs.

::: xplanes.models.base.LossTerm

::: xplanes.models.base.ModelSettings

::: xplanes.models.base.Model

::: xplanes.fields.base.Representation

::: xplanes.fields.base.RadianceField

::: xplanes.rendering.sampler.Sampler

::: xplanes.rendering.sampler.SamplerSettings

::: xplanes.rendering.sampler.Site

::: xplanes.scenes.source.SceneSettings

## Rasterising Gaussians

::: xplanes.baselines.gaussians.rasteriser.rasterise

::: xplanes.baselines.gaussians.rasteriser.RasterisedImage

::: xplanes.baselines.gaussians.camera.Camera

::: xplanes.baselines.gaussians.harmonics.spherical_harmonics

## Errors

::: xplanes.errors.XPlanesError

::: xplanes.errors.ConfigError

::: xplanes.errors.SceneError

::: xplanes.errors.LRMError

::: xplanes.training.diagnosis.TrainingError

::: xplanes.files.StorageError

::: xplanes.optional.MissingExtraError
"""
"""The page of the Python API before `api` adds headings, sentences and signatures."""

_DIRECTIVE = re.compile(r"^::: ([\w.]+)(?:\n    options:\n      members: \[(.+)\])?$", re.MULTILINE)


def api() -> str:
    """The page of the Python API, which says what there is without the site's own directives."""

    def written(match: re.Match[str]) -> str:
        path, members = match[1], match[2]
        module, _, name = path.rpartition(".")
        thing = pkgutil.resolve_name(path)
        first = " ".join((inspect.getdoc(thing) or "").split("\n\n")[0].split())
        lines = [f"### {name}", "", first.replace("``", "`"), "", "```python"]
        lines += [f"from {shortest(module, name)} import {name}", "", ""]
        lines += stub(thing, members.split(", ") if members else None)
        return "\n".join([*lines, "```", "", match[0]])

    return _DIRECTIVE.sub(written, API)


def shortest(module: str, name: str) -> str:
    """The shortest path of a package that has the same thing by this name."""
    thing, parts = getattr(importlib.import_module(module), name), module.split(".")
    packages = [".".join(parts[:count]) for count in range(1, len(parts) + 1)]
    return next(p for p in packages if getattr(importlib.import_module(p), name, None) is thing)


def stub(thing: Any, members: Iterable[str] | None) -> list[str]:
    """The signature of a function; of a class, its attributes and the signatures of methods.

    Args:
        thing: A class or a function.
        members: The methods; all public ones when None.
    """
    source = textwrap.dedent(inspect.getsource(thing))
    lines, node = source.splitlines(), ast.parse(source).body[0]
    parts = signature(lines, node)
    if not isinstance(node, ast.ClassDef):
        return [*parts[:-1], f"{parts[-1]} ..."]
    for below, after in zip(node.body, [*node.body[1:], None], strict=True):
        if isinstance(below, ast.FunctionDef):
            chosen = members or [below.name]
            if below.name == "__init__" or (below.name[0] != "_" and below.name in chosen):
                if not parts[-1].startswith("class "):
                    parts.append("")
                parts += signature(lines, below)
                said = (ast.get_docstring(below) or "").split("\n")[0]
                if said:
                    parts.append(f'        """{said}"""')
                else:
                    parts[-1] += " ..."
        elif isinstance(below, ast.AnnAssign | ast.Assign):
            if isinstance(below, ast.Assign) and isinstance(below.value, ast.Name):  # An alias.
                continue
            first = below.lineno - 1
            while lines[first - 1].startswith("    # "):
                first -= 1
            told = isinstance(after, ast.Expr)
            parts += lines[first : after.end_lineno if told else below.end_lineno]
    return parts if len(parts) > 1 else [f"{parts[0]} ..."]


def signature(lines: list[str], node: Any) -> list[str]:
    """The lines of a definition up to its colon, with its decorators."""
    first = min([node.lineno, *(each.lineno for each in node.decorator_list)]) - 1
    body = node.body[0]
    above = [each.lineno for each in getattr(body, "decorator_list", [])]
    last = min([body.lineno, *above]) - 1
    head = lines[first:last]
    while not head[-1].endswith(":"):  # Comments and empty lines before the body.
        head.pop()
    return head


def notebook() -> str:
    """The notebook with the cells of examples/first_minute.py, without outputs."""
    script = (ROOT / "examples" / "first_minute.py").read_text(encoding="utf-8")
    cells: list[dict[str, Any]] = []
    for number, text in enumerate(re.split(r"^# %%", script, flags=re.MULTILINE)[1:]):
        kind, _, body = text.partition("\n")
        cell = {"id": f"cell-{number}", "metadata": {}}
        if kind.strip() == "[markdown]":
            body = re.sub(r"^# ?", "", body, flags=re.MULTILINE)
            cell |= {"cell_type": "markdown"}
        else:
            cell |= {"cell_type": "code", "execution_count": None, "outputs": []}
        cells.append(cell | {"source": body.strip().splitlines(keepends=True)})
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    metadata = {"kernelspec": kernel, "language_info": {"name": "python"}}
    whole = {"cells": cells, "metadata": metadata, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps(whole, indent=1) + "\n"


PAGES = {
    "configuration.md": document,
    "command_line.md": command_line,
    "api.md": api,
    "../examples/first_minute.ipynb": notebook,
}
"""The pages that are written, and what writes them."""


ADDRESSED = {
    "mkdocs.yml": {"site_url: ": "{Documentation}/", "repo_url: ": "{Repository}"},
    "CITATION.cff": {"repository-code: ": "{Repository}", "\nurl: ": "{Documentation}"},
    "README.md": {"  url = {": "{Repository}"},
    "docs/index.md": {"git clone ": "{Repository}"},
    "conf/hydra/help/train.yaml": {"Manual +": "{Documentation}/configuration/"},
}
"""Files with addresses of the project: what stands before one, and the address."""


def addressed(name: str) -> str:
    """A file with the addresses that pyproject.toml gives."""
    urls = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["urls"]
    text = (ROOT / name).read_text(encoding="utf-8")
    for before, address in ADDRESSED[name].items():
        pattern = rf"({before})https://[^\s}}]+"
        text, count = re.subn(pattern, rf"\g<1>{address.format(**urls)}", text)
        if count != 1:
            raise SystemExit(f"{name}: {count} addresses after {before!r}, not 1")
    return text


if __name__ == "__main__":
    for name, write in PAGES.items():
        (ROOT / "docs" / name).write_text(write(), encoding="utf-8", newline="\n")
    for name in ADDRESSED:
        (ROOT / name).write_text(addressed(name), encoding="utf-8", newline="\n")
