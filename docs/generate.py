"""Write docs/configuration.md from the schemas and the YAML files: `python docs/generate.py`."""

import inspect
import re
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import yaml

from xplanes import config as schemas
from xplanes.pretraining.settings import PretrainConfig

ROOT = Path(__file__).resolve().parent.parent
TARGET = ROOT / "docs" / "configuration.md"

_FIELD = re.compile(r"^    (\w+): [^#\n]*#\s*(.+)$", re.MULTILINE)

GROUPS: dict[str, dict[str, type]] = {
    "data": {"demo": schemas.DemoConfig, "dnerf": schemas.DataConfig},
    "model": {"six_planes": schemas.ModelConfig, "nine_planes": schemas.ModelConfig},
    "lrm": {
        "none": schemas.LRMConfig,
        "file": schemas.TriplaneFileConfig,
        **dict.fromkeys(("small", "base", "large", "xlarge"), schemas.PretrainedLRMConfig),
    },
    "preparation": {"default": schemas.PreparationConfig},
    "decomposition": dict.fromkeys(("default", "paper"), schemas.DecompositionConfig),
    "sampler": {"occupancy": schemas.SamplerConfig},
    "loss": {"default": schemas.LossConfig},
    "trainer": dict.fromkeys(("default", "cpu", "gpu", "ddp", "debug"), schemas.TrainerConfig),
}


def comments(schema: type) -> dict[str, str]:
    """What the source says behind each field, inherited fields included."""
    found: dict[str, str] = {}
    for parent in reversed(schema.__mro__):
        if is_dataclass(parent):
            found.update(_FIELD.findall(inspect.getsource(parent)))
    return found


def values(group: str, option: str) -> dict[str, Any]:
    """The values of a YAML file, those it inherits from a sibling included."""
    content = yaml.safe_load((ROOT / "conf" / group / f"{option}.yaml").read_text())
    merged: dict[str, Any] = {}
    for parent in content.pop("defaults", []):
        if (ROOT / "conf" / group / f"{parent}.yaml").is_file():
            merged.update(values(group, parent))
    return {**merged, **content}


def rows(schema: type, options: dict[str, dict[str, Any]], prefix: str) -> list[str]:
    """One line per setting: key, meaning, value in each option."""
    lines, meaning = [], comments(schema)
    for entry in fields(schema):
        inner = {name: value.get(entry.name) for name, value in options.items()}
        if isinstance(entry.type, type) and is_dataclass(entry.type):
            lines += rows(entry.type, inner, f"{prefix}{entry.name}.")  # type: ignore[arg-type]
            continue
        shown = [yaml.safe_dump(v, default_flow_style=True).split("\n")[0] for v in inner.values()]
        cells = shown[:1] if len(set(shown)) == 1 else shown
        lines.append(f"| `{prefix}{entry.name}` | {meaning[entry.name]} | {' · '.join(cells)} |")
    return lines


def document() -> str:
    """The whole page."""
    parts = [
        "# Configuration",
        "",
        "Generated from `xplanes/config.py` and `conf/` by `python docs/generate.py`.",
        "",
        "Every key can be set on the command line, `python train.py data.views=10 trainer=cpu`.",
        "Where the options of a group differ, their values stand in the order of the options.",
        "",
        "| key | meaning | value |",
        "|---|---|---|",
        "| `seed` | Source of all randomness. | 0 |",
        "| `resume` | A run directory to go on with, or `auto`: the newest unfinished run with the "
        "same overrides, or the job's own folder in a sweep. | null |",
    ]
    for group, options in GROUPS.items():
        by_schema: dict[type, dict[str, dict[str, Any]]] = {}
        for option, schema in options.items():
            by_schema.setdefault(schema, {})[option] = values(group, option)
        for schema, named in by_schema.items():
            names = ", ".join(f"`{group}={option}`" for option in named)
            parts += ["", f"## {names}", "", (schema.__doc__ or "").split("\n")[0], ""]
            parts += ["| key | meaning | value |", "|---|---|---|"]
            parts += rows(schema, named, f"{group}.")
    return "\n".join([*parts, *pretraining()]) + "\n"


def pretraining() -> list[str]:
    """The settings of the other program."""
    shared = yaml.safe_load((ROOT / "conf" / "pretrain_lrm.yaml").read_text())
    shared.pop("defaults")
    options = {name: {**shared, "model": values("pretrain", name)} for name in ("tiny", "mini")}
    return [
        "",
        "## `python -m xplanes pretrain-lrm`, with `pretrain=tiny`, `pretrain=mini`",
        "",
        "Training of a small LRM on procedural objects, [its card](lrm_tiny.md).",
        "",
        "| key | meaning | value |",
        "|---|---|---|",
        *rows(PretrainConfig, options, ""),
    ]


if __name__ == "__main__":
    TARGET.write_text(document(), encoding="utf-8")
