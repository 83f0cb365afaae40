"""Contracts between conf/, the schemas and the code, and between the packages."""

import ast
import copy
import functools
import itertools
import re
import subprocess
import sys
from dataclasses import fields, is_dataclass
from pathlib import Path

import pytest
import torch
import yaml
from hydra.errors import HydraException

from tests.synthetic import ball_scene
from tests.training.runs import changed, composed, composing_once
from xplanes import checks
from xplanes.checks import parse
from xplanes.config import CONF, SCHEMAS, ConfigError, to_plain
from xplanes.launch import check_keys, prepare
from xplanes.scenes.frame import scene_frame
from xplanes.training.builder import build_batches, build_frame, build_module

ROOT = Path(__file__).resolve().parents[1]

OPTIONS = sorted(
    (str(path.parent.relative_to(CONF)), path.stem)
    for path in CONF.rglob("*.yaml")
    if path.parent != CONF and not {"hydra", "pretrain"} & set(path.relative_to(CONF).parts)
)
"""Every option of every group that train.py knows; tests/pretraining looks after the other."""

FILES_OF_KEYS = [o for o in OPTIONS if o[0] not in ("entry", "experiment", "recipe")]
"""Options that set one group; the others set keys of several."""

MODELS = [name for group, name in OPTIONS if group == "model"]

COMPOSITIONS = [
    # The groups that go with all others, as many options of them at once as there are.
    ["data=demo", "lrm=none", "decomposition=default", "trainer=default", "preparation=default"],
    ["data=dnerf", "lrm=tiny", "decomposition=paper", "trainer=cpu", "loss=default"],
    ["lrm=mini", "trainer=debug", "sampler=occupancy", "recipe=none", "model=six_planes"],
    ["lrm=base", "trainer=ddp", "model=nine_planes"],
    ["lrm=large", "trainer=gpu"],
    ["lrm=small", "sampler=proposal"],
    ["lrm=xlarge", "sampler=kplanes"],
    ["lrm=file", "sampler=kplanes_explicit"],
    # A model brings the three others along; here they are named.
    ["model=kplanes", "loss=kplanes", "recipe=kplanes"],
    ["model=tineuvox_s", "loss=tineuvox", "recipe=tineuvox", "sampler=fixed_step"],
    ["model=tensor4d", "loss=tensor4d", "recipe=tensor4d", "sampler=neus"],
    ["model=tensor4d_density", "loss=tensor4d_density"],
    ["model=kplanes_explicit"],
    ["model=tineuvox_b"],
    *(
        [f"{group}={name}" for group, name in both if name is not None]
        for both in itertools.zip_longest(
            (option for option in OPTIONS if option[0] == "entry"),
            (option for option in OPTIONS if option[0] == "experiment"),
            fillvalue=(None, None),
        )
    ),
]
"""What is composed, so that every option is in it."""

TINY_MODELS = {
    None: ("model.resolution=6", "model.channels=2", "model.decoder.width=8"),
    "kplanes": ("model.resolution=4", "model.scales=[1,2]", "model.channels=2", "model.width=16"),
    "tineuvox": ("model.resolution=12", "model.channels=2", "model.width=8"),
    **dict.fromkeys(
        ("tensor4d", "tensor4d_density"),
        ("model.resolution=6", "model.fine_resolution=8", "model.channels=2", "model.width=8"),
    ),
}
TINY_SAMPLERS = {
    "occupancy": ("sampler.grid_resolution=6", "sampler.samples=16"),
    "proposal": (
        "sampler.samples=6",
        "sampler.proposal_samples=[12,8]",
        "sampler.resolutions=[4,6]",
        "sampler.time_resolution=3",
    ),
    "fixed_step": (),
    "neus": ("sampler.samples=8", "sampler.more_samples=5"),
}


@functools.cache
def small(*overrides, **changes):
    """What the overrides choose, made small, and typed."""
    plain = to_plain(composed(*overrides))
    model, sampler = plain["model"].get("family"), plain["sampler"]["name"]
    tiny = ("trainer.rays_per_batch=32", "trainer.samples_per_batch=4096")
    values = [f"{key}={value}" for key, value in changes.items()]
    return parse(changed(overrides, *TINY_MODELS[model], *TINY_SAMPLERS[sampler], *tiny, *values))


scene_of = functools.cache(ball_scene)


# conf/ and schemas


def test_there_is_something_to_test():
    groups = {group for group, _ in OPTIONS}
    assert {"data", "model", "lrm", "sampler", "loss", "trainer"} <= groups


def test_every_option_is_composed():
    chosen = {tuple(text.split("=")) for overrides in COMPOSITIONS for text in overrides}
    assert chosen == set(OPTIONS)


@pytest.mark.parametrize("overrides", COMPOSITIONS, ids=" ".join)
def test_every_option_composes_parses_and_builds(overrides):
    plain = to_plain(composed(*overrides))
    assert "???" not in str(plain)
    assert "hydra" not in plain
    typed = small(*overrides)
    for group in {text.split("=")[0] for text in overrides} & {group for group, _ in FILES_OF_KEYS}:
        assert getattr(typed, group) is not None
    scene = scene_of()
    frame = build_frame(typed, scene.splits["train"])
    if typed.trainer.accelerator == "gpu" and not torch.cuda.is_available():
        with pytest.raises(ConfigError, match="no GPU found"):
            build_module(typed, scene, frame)
        return
    module = build_module(typed, scene, frame)
    if typed.trainer.accelerator == "auto" and torch.cuda.is_available():
        module = module.cuda()
    batch = build_batches(typed, scene, frame, 0).draw(0)
    device = module.renderer.device
    rays = {name: value.to(device) for name, value in batch.items()}
    colour = module.sampling.render(module.field, rays, module.moment).colour
    assert colour.shape == (32, 3)
    assert colour.isfinite().all()


@pytest.mark.parametrize("moving", [True, False])
def test_a_still_scene_gets_no_time_planes(moving):
    scene = scene_of(moving=moving)
    for name in MODELS:
        typed = small(f"model={name}")
        module = build_module(typed, scene, build_frame(typed, scene.splits["train"]))
        assert module.field.moves == moving, name
        if hasattr(module, "grid"):
            assert module.grid.time_bins == (typed.sampler.time_bins if moving else 1), name


def test_equal_seeds_build_equal_fields_and_zero_is_a_seed():
    scene = scene_of()
    frame = scene_frame(scene.splits["train"])
    first, again, other = (
        build_module(small(seed=seed), scene, frame).state_dict() for seed in (0, 0, 1)
    )
    assert all(torch.equal(first[key], again[key]) for key in first)
    for key in ("field.space", "field.time", "field.decoder.layers.0.weight"):
        assert not torch.equal(first[key], other[key])


def leaves(schema, prefix=""):
    found = set()
    for entry in fields(schema):
        inner = entry.type
        if is_dataclass(inner) and isinstance(inner, type):
            found |= leaves(inner, f"{prefix}{entry.name}.")
        else:
            found.add(f"{prefix}{entry.name}")
    return found


def yaml_leaves(node, prefix=""):
    found = set()
    for key, value in node.items():
        if isinstance(value, dict):
            found |= yaml_leaves(value, f"{prefix}{key}.")
        else:
            found.add(f"{prefix}{key}")
    return found


@functools.cache
def keys_and_schema(group, name):
    """Keys that a file and its parents set, and the schema that they inherit."""
    content = yaml.safe_load((CONF / group / f"{name}.yaml").read_text())
    keys, schema = set(), None
    for parent in content.pop("defaults", []):
        if parent == "_self_" or not isinstance(parent, str):
            continue
        if (group, parent) in SCHEMAS:
            schema = SCHEMAS[group, parent]
        else:
            inherited, schema = keys_and_schema(group, parent)
            keys |= inherited
    return keys | yaml_leaves(content), schema


def test_yaml_files_set_every_field_of_their_schema_and_no_other():
    for group, name in FILES_OF_KEYS:
        keys, schema = keys_and_schema(group, name)
        assert schema is not None, f"conf/{group}/{name}.yaml inherits no schema"
        assert keys == leaves(schema), f"conf/{group}/{name}.yaml"


@pytest.mark.parametrize(
    "override",
    [
        *("model.resolution=big", "trainer.media=perhaps", "trainer.max_seconds=soon", "seed=null"),
        *("model.colour=3", "trainer.max_step=3", "sed=1"),
    ],
)
def test_values_of_another_type_and_unknown_keys_are_refused_by_the_schemas(override):
    with pytest.raises(HydraException):
        composed(override)


def all_keys():
    found = set()
    for (group, _), schema in SCHEMAS.items():
        if group is not None:
            found |= leaves(schema, f"{group}.")
        else:
            found |= {key for key in leaves(schema) if "." not in key}
    return found


CHECKED = {
    "positive": checks._POSITIVE,
    "not negative": checks._NOT_NEGATIVE,
    "share": checks._SHARE,
    "choice": list(checks._CHOICES),
}


def test_checked_keys_exist_and_are_listed_once():
    known = all_keys()
    for kind, keys in CHECKED.items():
        assert set(keys) <= known, kind
        assert len(set(keys)) == len(keys), kind
        others = [key for name, listed in CHECKED.items() if name != kind for key in listed]
        assert not set(keys) & set(others), kind


@functools.cache
def plains():
    """Configurations that hold all keys between them."""
    chosen = ("lrm=small", "model=kplanes", "model=tineuvox_s", "model=tensor4d")
    return [to_plain(composed(option)) for option in chosen]


NOT_FINITE = (float("nan"), float("inf"))

REFUSED = {
    "positive": [(key, value) for key in CHECKED["positive"] for value in (0, -1)],
    "not negative": [(key, -1) for key in CHECKED["not negative"]],
    "share": [(key, value) for key in CHECKED["share"] for value in (-0.1, 1.1, *NOT_FINITE)],
    "choice": [(key, "bogus") for key in CHECKED["choice"]],
    "other": [
        ("trainer.evaluate_at", [0.5, 1.5]),
        ("trainer.devices", 2),
        ("sampler.grid_resolution", 4096),
        ("preparation.elevation", 91),
    ],
}


def with_value(key, value):
    """The first of the configurations that has the key, with this value."""
    *groups, last = key.split(".")
    for candidate in plains():
        plain = node = copy.deepcopy(candidate)
        for group in groups:
            node = node.get(group, {}) if isinstance(node, dict) else {}
        if isinstance(node, dict) and last in node:
            node[last] = value
            return plain
    raise AssertionError(f"{key} is in no configuration")


def refusal(call, *arguments):
    """What is said against it; None if nothing is."""
    try:
        call(*arguments)
    except ConfigError as error:
        return str(error)
    return None


@pytest.mark.parametrize("kind", REFUSED)
def test_values_that_cannot_work_are_refused_by_name(kind):
    for key, value in REFUSED[kind]:
        said = refusal(parse, with_value(key, value))
        assert said is not None, f"{key}={value} is taken"
        assert key in said, f"{key}={value}: {said}"
        assert str(value) in said, f"{key}={value}: {said}"


def test_a_crop_and_padding_exclude_each_other():
    with pytest.raises(ConfigError, match=r"lrm\.crop=true with lrm\.matching=pad"):
        parse(changed(("lrm=large",), "lrm.matching=pad"))


def test_several_processes_need_a_cache_for_their_start():
    ddp = ("lrm=small", "trainer=ddp")
    parse(changed(ddp, "trainer.devices=2"))
    with pytest.raises(ConfigError, match=r"preparation\.cache=null .* trainer\.devices=2"):
        parse(changed(ddp, "trainer.devices=2", "preparation.cache=null"))


def test_the_composed_configuration_survives_its_file():
    for plain in plains():
        assert parse(yaml.safe_load(yaml.safe_dump(plain))) == parse(plain)


# The command line


@pytest.fixture(scope="module")
def known_keys():
    with composing_once():
        yield


def test_a_typing_error_names_what_was_meant(known_keys):
    cases = {
        "model.resolutoin=64": "model.resolution",
        "trainer.max_step=10": "trainer.max_steps",
        "modle=six_planes": "model",
        "sampler.sample=3": "sampler.samples",
        "max_steps=3": "trainer.max_steps",
        "model.decoder.widht=3": "model.decoder.width",
    }
    for typed, meant in cases.items():
        said = refusal(check_keys, [typed])
        assert said is not None, typed
        assert typed.split("=")[0] in said, typed
        assert meant in re.split(r"Did you mean | or |\?", said), (typed, said)
    said = refusal(check_keys, ["qqqqqqqq=1"])
    assert said is not None
    assert "there is no such setting" in said
    assert "Did you mean" not in said


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["seed=0", "model=nine_planes", "model.resolution=32"],
        ["-m", "model=six_planes,nine_planes", "model.resolution=32,64"],
        ["data=dnerf", "data.root=/tmp/a=b", "data.scene=lego"],
        ["data=demo", "data.train_views=3"],
        ["hydra.run.dir=/tmp/x", "hydra/launcher=joblib", "+extra=1", "++extra.more=2", "~resume"],
        ["model.decoder={width: 32}", "trainer.evaluate_at=[0,1]"],
    ],
    ids=" ".join,
)
def test_good_command_lines_pass_unchanged(known_keys, arguments):
    assert prepare(arguments) == arguments


def test_keys_of_a_group_that_is_not_chosen_are_refused(known_keys):
    with pytest.raises(ConfigError, match=r"data\.train_views"):
        check_keys(["data=dnerf", "data.train_views=3"])


def test_an_unknown_option_is_left_to_hydra_which_lists_those_there_are():
    check_keys(["model=seven_planes"])
    with pytest.raises(HydraException, match="seven_planes") as caught:
        composed("model=seven_planes")
    assert "six_planes" in str(caught.value)
    assert "nine_planes" in str(caught.value)


def test_an_occlusion_that_hides_everything_is_refused():
    with pytest.raises(ConfigError, match=r"sampler\.occlusion=1\.0.*below 1"):
        parse(changed((), "sampler.occlusion=1"))


# The layers of design


LAYERS = (
    ("backend", "files", "locks", "optional", "process", "schemas", "config", "checks", "metrics"),
    ("scenes",),
    ("fields",),
    ("lrm",),
    ("decomposition",),
    ("rendering",),
    ("training",),
    ("preparation",),
    ("evaluation",),
    ("pretraining",),
    ("pipeline", "launch"),
    ("cli",),
    ("__main__",),
)
"""Rooms of the house: imports only point up this list.

An LRM brings a decoder of the fields' kind, so fields stand above it.
"""

LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}

EDGES = {
    "launch": {"checks", "config", "files", "pipeline", "schemas"},
    "train": {"cli"},
}
"""What the ends of the command line may import, which must be quick to start."""


@functools.cache
def sources():
    """Path of every module."""
    paths = [*sorted((ROOT / "xplanes").rglob("*.py")), ROOT / "train.py"]
    return {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in paths}


@functools.cache
def tree_of(path):
    return ast.parse(path.read_text())


def nodes_of(tree, functions):
    """All nodes below one, with those in functions if wanted."""
    for node in ast.iter_child_nodes(tree):
        if functions or not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node
            yield from nodes_of(node, functions)


def imported(path, *, functions=True):
    """Dotted names under xplanes that a file imports; with those of functions, and by name."""
    found = set()
    for node in nodes_of(tree_of(path), functions):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif functions and isinstance(node, ast.Call):
            # importlib and its helpers take the name as a string.
            texts = [a.value for a in node.args if isinstance(a, ast.Constant)]
            found |= {
                t for t in texts if isinstance(t, str) and re.fullmatch(r"xplanes\.[\w.]+", t)
            }
    return {name for name in found if name.split(".")[0] == "xplanes"}


def room(module):
    """The package or module of design that a dotted name belongs to; None for the root."""
    parts = module.split(".")
    if parts[0] == "train":
        return "train"
    return parts[1] if len(parts) > 1 and parts[1] != "__init__" else None


def test_imports_only_point_up_the_list():
    for module, path in sources().items():
        own = room(module)
        targets = {room(name) for name in imported(path)} - {None, own}
        # `from xplanes import __version__` names no room.
        targets = {name for name in targets if not name.startswith("__version")}
        if own is None:
            assert not targets, "the package's root imports nothing"
        elif own in EDGES:
            assert targets <= EDGES[own], f"{module} imports {targets - EDGES[own]}"
        else:
            assert own in LEVEL, f"{own} has no place in the list"
            for target in targets:
                told = f"{module} imports {target}"
                assert target in LEVEL, f"{told}, which has no place in the list"
                assert LEVEL[target] <= LEVEL[own], f"{told}: that points down the list"


def test_no_module_needs_itself_to_be_imported():
    modules = {name.removesuffix(".__init__"): path for name, path in sources().items()}
    needs = {}
    for name, path in modules.items():
        found = imported(path, functions=False)
        needs[name] = {
            target if target in modules else target.rpartition(".")[0] for target in found
        } - {name}
    done, open_now = set(), []

    def visit(name):
        if name in done or name not in modules:
            return
        assert name not in open_now, " -> ".join([*open_now, name])
        open_now.append(name)
        for target in sorted(needs[name]):
            visit(target)
        open_now.pop()
        done.add(name)

    for name in modules:
        visit(name)
    assert len(done) == len(modules)


HEAVY = {"torch", "numpy", "lightning", "hydra", "numba", "torchmetrics", "PIL"}


@pytest.mark.parametrize(
    ("module", "banned"),
    [("xplanes.cli", HEAVY), ("xplanes.launch", {"torch", "lightning", "numba"})],
)
def test_what_must_load_at_once_loads_nothing_heavy(module, banned):
    script = f"import sys, {module}; print(*{{name.split('.')[0] for name in sys.modules}})"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT
    )
    loaded = set(done.stdout.split())
    assert "xplanes" in loaded
    assert not loaded & banned


def test_no_module_calls_anything_for_its_effect_when_imported():
    for module, path in sources().items():
        for node in tree_of(path).body:
            loose = isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
            assert not loose or module in ("train", "xplanes.__main__"), (
                f"{module}:{node.lineno} calls at import"
            )


def test_python_files_stay_readable():
    assert max(len(path.read_text().splitlines()) for path in sources().values()) <= 350
