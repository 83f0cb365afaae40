"""Write docs/configuration.md from the schemas and the YAML files: `python docs/generate.py`."""

import inspect
import re
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import yaml

from xplanes import config as schemas
from xplanes.pretraining.settings import PretrainConfig
from xplanes.schemas import kplanes, samplers, tensor4d, tineuvox

ROOT = Path(__file__).resolve().parent.parent
TARGET = ROOT / "docs" / "configuration.md"

_FIELD = re.compile(r"^    (\w+): [^#\n]*#\s*(.+)$", re.MULTILINE)

GROUPS: dict[str, dict[str, type]] = {
    "data": {"demo": schemas.DemoConfig, "dnerf": schemas.DataConfig},
    "model": {
        **dict.fromkeys(("six_planes", "nine_planes"), schemas.ModelConfig),
        **dict.fromkeys(("kplanes", "kplanes_explicit"), kplanes.KPlanesConfig),
        **dict.fromkeys(("tineuvox_s", "tineuvox_b"), tineuvox.TiNeuVoxConfig),
        "tensor4d": tensor4d.Tensor4DConfig,
        "tensor4d_density": tensor4d.Tensor4DDensityConfig,
    },
    "lrm": {
        "none": schemas.LRMConfig,
        "file": schemas.TriplaneFileConfig,
        **dict.fromkeys(("tiny", "mini"), schemas.BundledLRMConfig),
        **dict.fromkeys(("small", "base", "large", "xlarge"), schemas.PretrainedLRMConfig),
    },
    "preparation": {"default": schemas.PreparationConfig},
    "decomposition": dict.fromkeys(("default", "paper"), schemas.DecompositionConfig),
    "sampler": {
        "occupancy": samplers.SamplerConfig,
        **dict.fromkeys(("proposal", "kplanes", "kplanes_explicit"), samplers.ProposalConfig),
        "fixed_step": samplers.FixedStepConfig,
        "neus": samplers.NeusConfig,
    },
    "loss": {
        "default": schemas.LossConfig,
        "kplanes": kplanes.KPlanesLossConfig,
        "tineuvox": tineuvox.TiNeuVoxLossConfig,
        "tensor4d": tensor4d.Tensor4DLossConfig,
        "tensor4d_density": tensor4d.Tensor4DDensityLossConfig,
    },
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
        "Generated from `xplanes/config.py`, `xplanes/schemas/` and `conf/` by "
        "`python docs/generate.py`.",
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
    parts += ["", "## `recipe`", "", RECIPE, "", "| recipe | key | value |", "|---|---|---|"]
    for path in sorted((ROOT / "conf" / "recipe").glob("*.yaml")):
        parts += [f"| `recipe={path.stem}` | `{key}` | {value} |" for key, value in settings(path)]
    for group, words in SETS.items():
        parts += ["", f"## `{group}`", "", words, "", f"| {group} | what it is |", "|---|---|"]
        for path in sorted((ROOT / "conf" / group).glob("*.yaml")):
            parts.append(f"| `{group}={path.stem}` | {head(path)} |")
    parts += ["", "## Environment", "", "| variable | meaning |", "|---|---|"]
    parts += [f"| `{name}` | {meaning} |" for name, meaning in ENVIRONMENT.items()]
    return "\n".join([*parts, *pretraining()]) + "\n"


def pretraining() -> list[str]:
    """The settings of the other program."""
    shared = yaml.safe_load((ROOT / "conf" / "pretrain_lrm.yaml").read_text())
    shared.pop("defaults")
    options = {name: {**shared, "model": values("pretrain", name)} for name in ("tiny", "mini")}
    return [
        "",
        "## `xplanes pretrain-lrm`, with `pretrain=tiny`, `pretrain=mini`",
        "",
        "Training of a small LRM: cards of [tiny](lrm_tiny.md) and [mini](lrm_mini.md).",
        "",
        "| key | meaning | value |",
        "|---|---|---|",
        *rows(PretrainConfig, options, ""),
    ]


RECIPE = (
    "What a published baseline sets in other groups. Its model chooses it; `recipe=none` trains "
    "it on the same rays and batches as X-Planes."
)


SETS = {
    "experiment": "Settings for a purpose; most are sweeps.",
    "entry": "One model with its start, as a row of a table: `entry=six_planes_tiny,kplanes`.",
}
"""Groups whose files set keys of other groups."""

ENVIRONMENT = {
    "OMP_NUM_THREADS": "The most threads that torch and the compiled loops use.",
    "OMP_WAIT_POLICY, GOMP_SPINCOUNT": "How threads wait; set unless one of them is.",
    "XPLANES_CPU_LOOPS=0": "Plain torch instead of compiled loops on the CPU.",
    "XPLANES_GPU_KERNELS=0": "Plain torch instead of Triton kernels on a GPU.",
}


def head(path: Path) -> str:
    """The first sentence of the comment in a file that says what it is."""
    lines = [line[2:] for line in path.read_text().splitlines() if line.startswith("# ")]
    return next(line for line in lines if not line.startswith("@")).split(". ")[0].rstrip(".") + "."


def settings(path: Path) -> list[tuple[str, Any]]:
    """Dotted keys of a YAML file of groups, and their values."""
    content = yaml.safe_load(path.read_text()) or {}
    return [(f"{group}.{key}", v) for group, keys in content.items() for key, v in keys.items()]


if __name__ == "__main__":
    TARGET.write_text(document(), encoding="utf-8")
