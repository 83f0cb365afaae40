"""Contracts between conf/ and the settings classes, and between the packages."""

import ast
import copy
import functools
import importlib.util
import inspect
import math
import pkgutil
import re
import tomllib
from dataclasses import fields
from graphlib import TopologicalSorter
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import lightning
import pytest
import torch
import yaml
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import Logger

from tests.balls import ball_scene
from tests.baselines.runs import under
from tests.refusals import assert_refused
from tests.training.runs import changed, composed
from tests.warm import ROOT, forked, python
from xplanes.cli import build_parser
from xplanes.components import MOVED, build
from xplanes.config import CONF, NAMES, compose_plain, to_plain
from xplanes.errors import ConfigError
from xplanes.experiment import Experiment
from xplanes.models.base import ModelSettings
from xplanes.models.initialisation import (
    DecompositionSettings,
    Initialisation,
    InitialiserSettings,
    Method,
    PreparationSettings,
)
from xplanes.rendering.sampler import SamplerSettings
from xplanes.scenes.source import SceneSettings
from xplanes.settings import HOME, Range, Settings
from xplanes.synthetic.pretraining.settings import PretrainingSettings
from xplanes.training.fit import Trainer
from xplanes.training.module import RadianceModule

OPTIONS = sorted(
    (path.parent.relative_to(CONF).as_posix(), path.stem)
    for path in CONF.rglob("*.yaml")
    if path.parent != CONF and not {"pretrain", "hydra"} & {*path.relative_to(CONF).parts}
)
"""Every option of every group that train.py knows."""

KINDS = {
    "data": SceneSettings,
    "model": ModelSettings,
    "model/sampler": SamplerSettings,
    "lrm": InitialiserSettings,
    "preparation": PreparationSettings,
    "decomposition": DecompositionSettings,
}
"""Groups of settings, and what their options are derived from."""

COMPOSITIONS = [
    # The groups that go with all others, as many options of them at once as there are.
    ["data=demo", "lrm=none", "decomposition=default", "trainer=default", "preparation=default"],
    ["data=dnerf", "lrm=tiny", "decomposition=paper", "trainer=cpu", "sweep=figure6"],
    ["lrm=mini", "model/sampler=occupancy", "logger=none", "model=six_planes", "sweep=rank"],
    ["lrm=small"],
    ["data=suite", "lrm=base", "trainer=ddp", "model=nine_planes"],
    ["lrm=large", "trainer=gpu", "logger=tensorboard", "callbacks=default", "sweep=table4"],
    # A model brings its sampler along; here some are named.
    ["data=blender", "model=kplanes", "model/sampler=kplanes", "logger=wandb"],
    ["data=nerfstudio", "model=tineuvox_s", "model/sampler=fixed_step"],
    ["data=multicamera", "model=tensor4d", "model/sampler=neus", "logger=csv"],
    ["data=colmap", "model=tensor4d_density", "model/sampler=proposal", "sweep=ablation"],
    ["data=nerfies", "model=kplanes_explicit", "sweep=few_shot"],
    ["recipe=paper", "preparation=paper", "lrm=auto", "sweep=tables2_3", "data=llff"],
    ["recipe=paper_small", "experiment=demo", "lrm=xlarge"],
    ["recipe=fair", "sweep=fair", "lrm=file"],
    ["model=kplanes_reduced", "model/sampler=kplanes_reduced", "experiment=published"],
    ["model=tineuvox_b"],
    ["model=tineuvox_reduced", "sweep=suite"],
    ["model=tensor4d_reduced", "sweep=suite_test"],
    ["model=gaussians_hexplane", "model/sampler=rasteriser"],
    ["model=gaussians_hexplane_published", "sweep=table1"],
    ["model=gaussians_deform", "sweep=lego_models"],
    ["model=gaussians_deform_published"],
    ["model=gaussians_spacetime", "lrm=field"],
    ["model=gaussians_spacetime_published"],
]
"""Overrides in which every option occurs."""

MODELS_OF_A_KIND = (
    *("kplanes", "tineuvox_s", "tensor4d", "tensor4d_density", "gaussians_hexplane"),
    *("gaussians_deform", "gaussians_spacetime"),
)
"""One of each class of settings but X-Planes'."""

TENSOR4D = under("model", resolution=6, fine_resolution=8, channels=2, width=8)
SAMPLER = functools.partial(under, "model.sampler")
TINY = {
    "XPlanesSettings": (*under("model", resolution=6, channels=8), "model.decoder.width=8"),
    "KPlanesSettings": under("model", resolution=4, scales=[1, 2], channels=2, width=16),
    "TiNeuVoxSettings": under("model", resolution=12, channels=2, width=8),
    "Tensor4DSettings": TENSOR4D,
    "Tensor4DDensitySettings": TENSOR4D,
    "HexPlaneGaussiansSettings": under("model", count=40, resolution=4, channels=2, width=8),
    "DeformedGaussiansSettings": under("model", count=40, depth=2, width=8),
    "SpacetimeGaussiansSettings": under("model", count=40),
    "OccupancySettings": SAMPLER(grid_resolution=6, samples=16),
    "ProposalSettings": (
        *SAMPLER(samples=6, proposal_samples=[12, 8], resolutions=[4, 6], time_resolution=3),
    ),
    "FixedStepSettings": (),
    "NeusSettings": SAMPLER(samples=8, more_samples=5),
    "RasteriserSettings": (),
}
"""What makes models and samplers small, by the class of their settings."""


def class_of(node):
    return pkgutil.resolve_name(node["_target_"])


def small(*overrides, **changes):
    """What the overrides choose, made small."""
    plain = to_plain(composed(*overrides))
    tiny = [*TINY[class_of(plain["model"]).__name__]]
    tiny += TINY[class_of(plain["model"]["sampler"]).__name__]
    if "per_batch" in plain["model"]["rays"]:
        tiny += ["model.rays.per_batch=32", "model.rays.samples_per_batch=4096"]
    return changed(overrides, *tiny, *(f"{key}={value}" for key, value in changes.items()))


scene_of = functools.cache(ball_scene)


def built(plain, scene):
    """The field of a configuration, random whatever its LRM, and its batches."""
    module = RadianceModule(plain)
    model, views = module.method.model, scene.splits["train"]
    frame = model.frame(views)
    module.build(scene, frame, initialisation=Initialisation(model, frame))
    settings, seed = module.ray_settings, module.method.seed
    return module, settings.batches(views, module.frame, seed=seed, rank=0)


# conf/ and settings


def test_every_option_is_composed():
    chosen = {tuple(text.split("=")) for overrides in COMPOSITIONS for text in overrides}
    assert chosen == set(OPTIONS)


@pytest.mark.parametrize("overrides", COMPOSITIONS, ids=" ".join)
def test_every_option_composes_and_reads(overrides, tmp_path):
    plain = to_plain(composed(*overrides))
    assert "???" not in str(plain)
    assert "hydra" not in plain
    experiment = Experiment.read(small(*overrides))
    for group, kind in KINDS.items():
        part = experiment.data if group == "data" else experiment.method
        for name in [] if group == "data" else group.split("/"):
            part = getattr(part, name)
        assert isinstance(part, kind), group
    if experiment.trainer["accelerator"] == "gpu" and not torch.cuda.is_available():
        with pytest.raises(ConfigError, match=r"trainer\.accelerator=gpu: no GPU found"):
            _ = experiment.device
        return
    if "logger=wandb" in overrides and importlib.util.find_spec("wandb") is None:
        with pytest.raises(ConfigError, match=r"logger\.wandb.*wandb"):
            experiment.build_trainer(tmp_path)
        return
    trainer = experiment.build_trainer(tmp_path)
    assert isinstance(trainer, Trainer)
    assert len(trainer.loggers) == len(experiment.logger)
    kinds = {type(callback) for callback in trainer.callbacks}
    assert {class_of(node) for node in experiment.callbacks.values()} <= kinds


def test_a_static_scene_gets_no_time_planes():
    for moving in (True, False):
        scene = scene_of(moving=moving)
        for name in ("six_planes", "nine_planes", *MODELS_OF_A_KIND):
            module, _ = built(small(f"model={name}"), scene)
            assert module.field.moves == moving, name
            if hasattr(module, "grid"):
                assert module.grid.time_bins == (8 if moving else 1), name


def test_equal_seeds_build_equal_fields_and_zero_is_a_seed():
    first, again, other = (
        built(small(seed=seed), scene_of())[0].state_dict() for seed in (0, 0, 1)
    )
    assert all(torch.equal(first[key], again[key]) for key in first)
    for key in ("field.space", "field.time", "field.decoder.layers.0.weight"):
        assert not torch.equal(first[key], other[key])


@functools.cache
def classes():
    """Group and class of every option of settings."""
    return {
        (group, class_of(functools.reduce(dict.__getitem__, group.split("/"), plain)))
        for plain in (to_plain(composed(*overrides)) for overrides in COMPOSITIONS)
        for group in KINDS
    }


def nested(hint):
    """The settings class among a type hint and its alternatives; None for a plain value."""
    kinds = [kind for kind in (hint, *get_args(hint)) if isinstance(kind, type)]
    return next((kind for kind in kinds if issubclass(kind, Settings)), None)


def yaml_names(node, prefix=""):
    found = set()
    for key, value in node.items():
        name = f"{prefix}{key}"
        found |= yaml_names(value, f"{name}.") if isinstance(value, dict) else {name}
    return found


def locations(cls, prefix):
    """Dotted names of the settings of a class that are files or folders."""
    for name, hint in get_type_hints(cls, include_extras=True).items():
        if (inner := nested(hint)) is not None:
            yield from locations(inner, f"{prefix}{name}.")
        elif HOME in repr(hint):
            yield f"{prefix}{name}"


def test_the_command_line_knows_all_settings_that_are_files_or_folders():
    known = {*classes(), ("", PretrainingSettings)}
    found = {key for group, cls in known for key in locations(cls, f"{group}.".lstrip("."))}
    assert found == {name for name in NAMES if name != "resume" and "hydra." not in name}


def test_settings_have_no_defaults_beside_those_of_the_yaml_files():
    assert len(classes()) > 15
    for _, cls in classes():
        hints = get_type_hints(cls)
        plain = [entry.name for entry in fields(cls) if nested(hints[entry.name]) is None]
        assert not [name for name in plain if hasattr(cls, name)], cls


def test_other_groups_set_what_their_classes_take():
    nodes = []
    for plain in (to_plain(composed(*overrides)) for overrides in COMPOSITIONS):
        nodes.append((Trainer, plain["trainer"]))
        for group, kind in (("callbacks", Callback), ("logger", Logger)):
            nodes += [(kind, node) for node in plain[group].values() if node]
    for kind, node in nodes:
        cls = class_of(node)
        assert issubclass(cls, kind), node
        taken = set(inspect.signature(cls).parameters)
        if kind is Trainer:
            taken |= set(inspect.signature(lightning.Trainer).parameters)
        assert set(node) - {"_target_"} <= taken, node


@functools.cache
def plains():
    """Configurations that hold all keys between them."""
    choices = [
        ["lrm=small", "data=demo"],
        ["lrm=tiny", "data=dnerf"],
        ["lrm=file"],
        ["model=gaussians_spacetime", "lrm=field"],
        *(["model=" + name] for name in MODELS_OF_A_KIND),
    ]
    return [to_plain(composed(*chosen)) for chosen in choices]


def node_of(plain, key):
    """A copy of a configuration, and its node that holds a key."""
    plain = copy.deepcopy(plain)
    *groups, last = key.split(".")
    node = functools.reduce(dict.__getitem__, groups, plain)
    assert last in node, key
    return plain, node


def changed_value(plain, key, value):
    """A configuration with another value of a key."""
    plain, node = node_of(plain, key)
    node[key.rpartition(".")[2]] = value
    return plain


def refused(key, value, call, *arguments):
    """A call is refused by the full key and its value."""
    case = f"{key}={value}"
    said = assert_refused(ConfigError, "", functools.partial(call, *arguments), case)
    shown = value[0] if isinstance(value, list) and case not in said else value
    assert said.startswith(f"{key}={shown}"), f"{case}: {said}"


def parts(hint) -> tuple[list[Any], list[Range]]:
    """Types that a hint allows, and ranges of its numbers."""
    if get_origin(hint) is Annotated:
        inner, *extras = get_args(hint)
        kinds, ranges = parts(inner)
        return kinds, ranges + [extra for extra in extras if isinstance(extra, Range)]
    if get_origin(hint) is Union or isinstance(hint, type(int | str)):
        found = [parts(inner) for inner in get_args(hint)]
        return [k for kinds, _ in found for k in kinds], [r for _, ranges in found for r in ranges]
    return [hint], []


def outside(allowed: Range):
    """Numbers just outside a range."""
    for bound, step in ((allowed.low, -1), (allowed.high, 1)):
        if math.isfinite(bound):
            yield bound + step
            if allowed.open:
                yield int(bound)


def wrong_values(hint):
    """Values that a type hint does not allow, of other types and out of range."""
    kinds, ranges = parts(hint)
    for allowed in ranges:
        yield from outside(allowed)
    if type(None) not in kinds:
        yield None
    literal = any(get_origin(kind) is Literal for kind in kinds)
    if literal or (str not in kinds):
        yield "bogus"
    if float in kinds:
        yield from (float("nan"), float("inf"), True)
    elif int in kinds:
        yield from (1.5, True)
    elif bool in kinds:
        yield 3
    elif str in kinds:
        yield ["bogus"]
    for kind in kinds:
        if get_origin(kind) is list:
            yield from ([value] for value in wrong_values(get_args(kind)[0]))


def hints_of(settings, prefix):
    """Dotted names and type hints of all settings that an object holds."""
    hints = get_type_hints(type(settings), include_extras=True)
    for entry in fields(settings):
        value, key = getattr(settings, entry.name), f"{prefix}{entry.name}"
        if isinstance(value, Settings):
            yield from hints_of(value, f"{key}.")
        else:
            yield key, hints[entry.name]


GROUPS = ("data", "model", "lrm", "preparation", "decomposition")


@functools.cache
def cases():
    """Keys with a value that they cannot have, and a configuration to put it in."""
    found = {}
    for plain in plains():
        experiment = Experiment.read(plain)
        for group in GROUPS:
            settings = experiment.data if group == "data" else getattr(experiment.method, group)
            for key, hint in hints_of(settings, f"{group}."):
                for value in wrong_values(hint):
                    found.setdefault((key, repr(hint), repr(value)), (plain, key, value))
    return list(found.values())


def test_every_setting_has_values_that_it_cannot_have():
    keys = {key for _, key, _ in cases()}
    settings = {
        name
        for plain in plains()
        for group in GROUPS
        for name in yaml_names(plain[group], f"{group}.")
        if not name.endswith("._target_")
    }
    assert keys == settings
    assert len(keys) > 150


@pytest.mark.parametrize("group", GROUPS)
def test_values_that_cannot_work_are_refused_by_their_full_key(group):
    for plain, key, value in cases():
        if not key.startswith(f"{group}."):
            continue
        node = changed_value(plain, key, value)[group]
        refused(key, value, build, node, KINDS[group], group)  # As Experiment.read does.


@pytest.mark.parametrize("name", ["kplanes", "six_planes"])
def test_nodes_of_omegaconf_are_as_good_as_plain_ones(name):
    config = composed(f"model={name}")
    plain = to_plain(config)["model"]
    assert build(config.model, ModelSettings, "model") == build(plain, ModelSettings, "model")


OTHERS = {
    "seed": (-1, 2**32, None, "some"),
    "media": ("perhaps",),
    "model.sampler.grid_resolution": (4096,),
    "model.sampler.occlusion": (1,),
    "preparation.fixed_view_model": ("nerf",),
    "preparation.elevation": (91,),
}
TRAINING = {
    "trainer.max_seconds": (0, -1, "soon", float("nan")),
    "trainer.max_steps": (0, -3, "many"),
    "trainer.devices": (0, -2, "some", 2),
    "trainer.accelerator": ("bogus", None),
    "trainer.log_every_n_steps": (-1, "often"),
    "callbacks.evaluation.at": ([0.5, 1.5], "often"),
    "callbacks.checkpoints.every": (0, -1, "often"),
    "callbacks.evaluation": ("yes",),
}
"""Values with which nothing trains: a trainer is built to see them."""


@pytest.mark.parametrize("key", [*OTHERS, *TRAINING])
def test_other_values_that_cannot_work_are_refused_by_their_full_key(key, tmp_path):
    for value in OTHERS.get(key, ()):
        refused(key, value, Experiment.read, changed_value(plains()[0], key, value))
    for value in TRAINING.get(key, ()):
        plain = changed_value(plains()[1], key, value)
        refused(key, value, lambda plain=plain: Experiment.read(plain).build_trainer(tmp_path))


def test_what_lightning_refuses_is_said_in_its_words(tmp_path):
    plain = changed_value(plains()[1], "trainer.strategy", "bogus")
    with pytest.raises(ConfigError, match=r"^trainer.*strategy='bogus'"):
        Experiment.read(plain).build_trainer(tmp_path)


def test_classes_that_may_not_stand_in_a_place_are_refused():
    for key in (f"{group}._target_" for group in GROUPS):
        for target in (Path.__module__ + ".Path", "xplanes.no.Such", "os.system", 3):
            refused(key, target, Experiment.read, changed_value(plains()[0], key, target))


@pytest.mark.parametrize(
    "key", ["model.resolution", "model.decoder.width", "model.sampler.samples", "data.scene"]
)
def test_missing_and_unknown_keys_of_a_file_are_refused_by_their_full_key(key):
    plain, node = node_of(plains()[0], key)
    last = key.rpartition(".")[2]
    value = node.pop(last)
    with pytest.raises(ConfigError, match=f"^{key}: it is not set$"):
        Experiment.read(plain)
    node |= {last: value, f"{last}s_": value}
    words = f"^{key}s_: there is no such setting(.|\n)*Did you mean {last}"
    with pytest.raises(ConfigError, match=words):
        Experiment.read(plain)


@pytest.mark.parametrize("group", GROUPS)
def test_a_missing_group_is_named(group):
    plain = {name: node for name, node in plains()[0].items() if name != group}
    with pytest.raises(ConfigError, match=group):
        Experiment.read(plain)


def test_a_crop_and_padding_exclude_each_other():
    plain = changed(("lrm=large",), "lrm.matching=pad")
    with pytest.raises(ConfigError, match=r"^lrm\.crop=true with lrm\.matching=pad"):
        Experiment.read(plain)


def test_numbers_of_the_command_line_are_text_where_text_is_wanted():
    chosen = ["model.precision=32", "data=dnerf", "data.scene=7"]
    experiment = Experiment.read(compose_plain("train", chosen))
    assert experiment.method.model.precision == "32"
    assert experiment.data.scene == "7"


def test_the_composed_configuration_survives_its_file():
    for plain in plains():
        experiment = Experiment.read(plain)
        again = Experiment.read(yaml.safe_load(yaml.safe_dump(plain)))
        assert again == experiment
        assert Method.read(experiment.method.plain()) == experiment.method
        names = {name for name, _ in hints_of(experiment.method.model, "model.")}
        assert names == {n for n in yaml_names(plain["model"], "model.") if "_target_" not in n}


# The layers of design


LAYERS = (
    (
        *("errors", "backend", "files", "process", "optional", "settings", "components", "config"),
        *("streams", "locks", "metrics"),
    ),
    ("scenes",),
    ("fields",),
    ("lrm",),
    ("decomposition",),
    ("rendering",),
    ("models",),
    ("training",),
    ("experiment", "sweeps"),
    ("preparation",),
    ("evaluation",),
    ("run", "launch"),
    ("cli",),
    ("readers",),
    ("baselines", "synthetic", "tools"),
    ("__main__",),
)
"""Layers: imports only point up this list.

An LRM brings a decoder of the fields' kind, so fields stand above it.
"""

WINGS = ("readers", "baselines", "synthetic", "tools")
"""Packages that the core does not know: YAML files and entry points name them.

A wing imports no other, except that demo scenes and tools read files as any capture's are read.
"""

LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}

EDGES = {
    "launch": {"config", "errors", "experiment", "files", "process", "run", "sweeps"},
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


def nodes_at_import(tree):
    """All nodes below one but those in functions, or for type checkers alone."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            continue
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node
            yield from nodes_at_import(node)


@functools.cache
def imported(path, *, functions=True):
    """Dotted names under xplanes that a file imports; with those of functions, and by name."""
    found = set()
    tree = tree_of(path)
    for node in ast.walk(tree) if functions else nodes_at_import(tree):
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
            assert targets <= {"scenes", "training"}, "the root hands on two classes"
            assert not imported(path, functions=False), "the package's root imports nothing"
        elif own in EDGES:
            assert targets <= EDGES[own], f"{module} imports {targets - EDGES[own]}"
        else:
            assert own in LEVEL, f"{own} has no place in the list"
            for target in targets:
                told = f"{module} imports {target}"
                assert target in LEVEL, f"{told}, which has no place in the list"
                assert LEVEL[target] <= LEVEL[own], f"{told}: that points down the list"
                reads = target == "readers" and own in ("synthetic", "tools")
                assert target not in WINGS or reads, f"{told}: that is a wing"


@pytest.mark.slow
def test_the_core_runs_without_its_wings():
    core = {name.removesuffix(".__init__") for name in sources() if room(name) not in WINGS}
    core -= {"train", "xplanes.__main__"}
    if importlib.util.find_spec("triton") is None:
        core -= {name for name in core if "_triton" in name}
    script = (
        f"import importlib, sys\nfor name in {sorted(core)}: importlib.import_module(name)\n"
        "print(*sys.modules)"
    )
    loaded = set(python("-c", script).stdout.split())
    assert core <= loaded
    assert not {name for name in loaded if room(name) in WINGS and name.startswith("xplanes.")}


def test_commands_of_a_wing_come_from_an_entry_point():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
    given = settings["xplanes.commands"].items()
    entries = [EntryPoint(name, value, "xplanes.commands").load() for name, value in given]
    bare, whole = build_parser().format_help(), build_parser(entries).format_help()
    for command in ("pretrain-lrm", "inspect", "view", "export", "table"):
        assert not re.search(rf"\n    {command}\s", bare)
        assert re.search(rf"\n    {command}\s", whole)


def test_modules_that_have_moved_are_found():
    assert MOVED
    for old, new in MOVED.items():
        assert importlib.util.find_spec(new) is not None, new
        assert old not in sources(), old
    method = Method.read(plains()[-1])
    text = yaml.safe_dump(method.plain())  # As in a checkpoint.
    for name in ("gaussians_spacetime", "gaussians", "densification"):
        old = f"xplanes.models.{name}"
        assert f"{MOVED[old]}." in text, name
        text = text.replace(f"{MOVED[old]}.", f"{old}.")
    assert Method.read(yaml.safe_load(text)) == method


def test_no_module_needs_itself_to_be_imported():
    modules = {name.removesuffix(".__init__"): path for name, path in sources().items()}
    order = TopologicalSorter()
    for name, path in modules.items():
        found = imported(path, functions=False)
        order.add(name, *({t if t in modules else t.rpartition(".")[0] for t in found} - {name}))
    assert set(modules) <= set(order.static_order())  # Which raises if there is a circle.


HEAVY = ("torch", "numpy", "lightning", "hydra", "numba", "torchmetrics", "PIL")
QUICK = {
    "import xplanes.settings": HEAVY,
    "import xplanes.config": HEAVY,
    "import xplanes.launch": ("torch", "lightning", "numba"),
    "from xplanes.cli import build_parser, further_commands as more; "
    "print(build_parser(more()).format_help())": HEAVY,
    "from xplanes.cli import main; main(['inspect', 'nowhere'])": ("lightning", "xplanes.run"),
    **{
        f"from contextlib import suppress; from xplanes.launch import train\n"
        f"with suppress(SystemExit): train({wrong})": ("lightning", "numba")
        for wrong in (["data.resolution=abc"], ["data=dnerf", "data.scene=nowhere"])
    },
}
"""What must answer at once, and what it must not load."""

SAY = "print('heavy', {{*{}}} & {{*sys.modules}})"


def test_what_must_answer_at_once_loads_nothing_heavy(tmp_path):
    for before in ("", "import torch"):  # With what may load torch it is there from the start.
        chosen = {code: no for code, no in QUICK.items() if ("torch" in no) == (not before)}
        codes = [f"{code}\n{SAY.format(no)}" for code, no in chosen.items()]
        found = forked(before, codes, tmp_path)
        for (code, printed), told in zip(found, chosen, strict=True):
            assert code == 0, (told, printed)
            assert printed.endswith("heavy set()\n"), (told, printed)


def test_errors_that_users_see_have_one_base():
    caught = {"UnavailableError", "FetchError"}  # By the callers of those who raise them.
    errors = {
        node.name: {base.id for base in node.bases if isinstance(base, ast.Name)}
        for path in sources().values()
        for node in tree_of(path).body
        if isinstance(node, ast.ClassDef) and node.name.endswith("Error")
    }
    seen = {name for name in errors if not name.startswith("_")} - {"XPlanesError"} - caught
    assert {"ConfigError", "SceneError", "StorageError", "TrainingError"} <= seen
    for name in seen:
        bases = errors[name]
        assert "XPlanesError" in bases or bases & seen, name


def test_no_module_calls_anything_for_its_effect_when_imported():
    for module, path in sources().items():
        for node in tree_of(path).body:
            loose = isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
            assert not loose or module in ("train", "xplanes.__main__"), (
                f"{module}:{node.lineno} calls at import"
            )
