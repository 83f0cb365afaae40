"""Models, samplers, data formats and losses from outside the package, chosen by configuration."""

import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
import yaml

from tests.refusals import assert_refused
from tests.training.runs import SMALL, metrics, small_config
from tests.warm import ROOT
from xplanes import RadianceModule, SceneDataModule, __version__
from xplanes.components import build, plugins
from xplanes.config import compose_plain
from xplanes.errors import ConfigError
from xplanes.experiment import Experiment
from xplanes.fields.base import RadianceField
from xplanes.files import read_rows
from xplanes.run import run
from xplanes.scenes.source import SceneSettings
from xplanes.tools.runs import load_run

BLOB = {
    "_target_": "tests.plugins.blob.BlobSettings",
    "name": "blob",
    "width": 0.4,
    "learning_rate": 0.1,
    "precision": "auto",
}
SAMPLER = {
    "_target_": "tests.plugins.random_sampler.RandomSamplerSettings",
    "name": "random",
    "samples": 12,
}
DATA = {
    "_target_": "tests.plugins.disc_format.DiscSettings",
    "name": "disc",
    "scene": "disc",
    "count": 6,
    "resolution": 16,
}
LOSS = {"_target_": "tests.plugins.opacity_loss.OpacityLoss", "weight": 0.5}


@pytest.fixture
def config(tmp_path: Path) -> dict:
    found = small_config(tmp_path, "trainer.log_every_n_steps=5", "logger=csv")
    rays = found["model"]["rays"]
    found["model"] = {**BLOB, "sampler": SAMPLER, "rays": rays}
    dropped = ("seed", "train_views", "test_views", "val_views", "_target_")
    kept = {name: value for name, value in found["data"].items() if name not in dropped}
    found["data"] = kept | DATA
    return found | {"losses": {"opacity": LOSS}, "plugins": ["tests.plugins"]}


def psnr_at_the_ends(folder: Path) -> tuple[float, float]:
    """PSNR before the first step, and at the end."""
    curve = read_rows(folder / "curve.csv")
    return float(curve[0]["psnr"]), float(curve[-1]["psnr"])


def test_all_four_train_log_and_load_again(config, tmp_path):
    folder = tmp_path / "run"
    run(config, folder, [], resume=False)
    first, last = psnr_at_the_ends(folder)
    assert last > first + 1
    logged = read_rows(folder / "csv" / "metrics.csv")
    opacity = [float(row["train/opacity"]) for row in logged if row.get("train/opacity")]
    assert opacity[0] > opacity[-1] > 0
    trained = load_run(folder, plugins=["tests.plugins"])
    assert trained.module.field.outline == "one blob"
    path = folder / "checkpoints" / "last.ckpt"
    again = RadianceModule.load_from_checkpoint(path, plugins=["tests.plugins"])
    assert again.field.width == BLOB["width"]
    views = SceneDataModule.from_run(folder, plugins=["tests.plugins"]).scene.splits["train"]
    assert len(views) == DATA["count"]
    assert metrics(folder)["step"] == 40


def test_a_recipe_reaches_a_model_of_ones_own_or_names_itself(tmp_path):
    group = tmp_path / "model"
    group.mkdir()
    rays = compose_plain("train", [])["model"]["rays"]
    defaults = [{"sampler": "proposal"}, {"/lrm@_global_.lrm": "none"}, "_self_"]
    (group / "blob.yaml").write_text(yaml.safe_dump({"defaults": defaults, **BLOB, "rays": rays}))
    own = [f"hydra.searchpath=[file://{tmp_path}]", "plugins=[tests.plugins]", "model=blob"]
    model = Experiment.read(compose_plain("train", [*own, "recipe=fair"])).method.model
    ours = Experiment.read(compose_plain("train", ["recipe=fair"])).method.model
    assert (model.rays, model.sampler) == (ours.rays, ours.sampler)
    words = r"model\.\w+: there is no such setting.*\(recipe=paper changes"
    with pytest.raises(ConfigError, match=words):
        Experiment.read(compose_plain("train", [*own, "recipe=paper"]))


def test_data_of_ones_own_is_composed_in_python():
    own = ["data._target_=tests.plugins.disc_format.DiscSettings", "+data.count=6"]
    own += [f"~data.{name}" for name in ("seed", "train_views", "test_views", "val_views")]
    data = SceneDataModule.compose("plugins=[tests.plugins]", *own, "data.scene=disc")
    assert len(data.scene.splits["train"]) == 6
    with pytest.raises(ConfigError, match="plugins"):
        SceneDataModule.compose(*own)


def test_a_run_of_somebody_else_names_no_classes_by_itself(config, tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    path = tmp_path / "theirs.ckpt"
    content = {"hyper_parameters": {"config": config}, "state_dict": {}}
    versions = {"pytorch-lightning_version": "2.6.4", "xplanes": __version__}
    torch.save(content | versions, path)
    for load, given, part in (
        (load_run, folder, "model"),
        (SceneDataModule.from_run, folder, "data"),
        (RadianceModule.load_from_checkpoint, path, "model"),
    ):
        with pytest.raises(ConfigError, match=rf"{part}\._target_=tests.*plugins=\[MODULE\]"):
            load(given)


DERIVED = r": must be a class derived from xplanes\.models\.base\.ModelSettings"


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("_target_", "os.system", "=os.system: .*only classes of xplanes, .*, tests.plugins"),
        ("_target_", "tests.plugins.opacity_loss.OpacityLoss", f"=.*OpacityLoss{DERIVED}"),
        ("_target_", "tests.plugins.opacity_loss.Nothing", "=.*Nothing: there is no such class"),
        ("_target_", "xplanes.models.base.torch", f"=xplanes.models.base.torch{DERIVED}"),
        ("_target_", "tests.plugins.blob.RadianceField", f"=.*RadianceField{DERIVED}"),
        ("width", -1.0, r"=-1\.0: must be above 0"),
        ("widht", 2, ": there is no such .* mean width"),
    ],
)
def test_classes_and_settings_of_plugins_are_checked_alike(config, tmp_path, key, value, words):
    config["model"][key] = value
    with pytest.raises(ConfigError, match=rf"model\.{key}{words}"):
        run(config, tmp_path / "run", [], resume=False)
    assert not (tmp_path / "run" / "run.json").exists()


def test_a_module_that_is_not_there_is_said(config, tmp_path):
    with pytest.raises(ConfigError, match=r"plugins: not_here cannot be imported.*PYTHONPATH"):
        run(config | {"plugins": ["not_here"]}, tmp_path / "run", [], resume=False)


PAGE = ROOT / "docs" / "CONTRIBUTING.md"


def section(name: str) -> str:
    """A section of the page."""
    return PAGE.read_text(encoding="utf-8").split(f"### {name}\n")[1].split("\n### ")[0]


@pytest.fixture
def example(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., dict]]:
    """Writes an example of the docs to files as they say, and gives its configuration."""
    project = tmp_path / "my_project"

    def write(title: str, group: str, name: str, *changes: str) -> dict:
        text = section(title)
        (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
        (settings,) = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
        package, folder = project / "my_package", project / "conf" / group
        package.mkdir(parents=True)
        folder.mkdir(parents=True)
        (package / "__init__.py").write_text("")
        (package / f"{name}.py").write_text(code)
        (folder / f"{name}.yaml").write_text(settings)
        monkeypatch.syspath_prepend(project)
        few = ("data.", "trainer.", "media", "model.rays.per_batch", "model.sampler.grid_res")
        own = [f"hydra.searchpath=[file://{project}/conf]", "plugins=[my_package]"]
        own += [f"{group}={name}", f"data.root={scenes}", "callbacks.evaluation.at=[0]"]
        short = [text for text in SMALL if text.startswith(few) and "max_steps" not in text]
        return compose_plain("train", [*own, *short, *changes])

    yield write
    for name in [name for name in sys.modules if name.split(".")[0] == "my_package"]:
        del sys.modules[name]


def test_the_lrm_of_the_docs_initialises_a_field(example, tmp_path):
    changes = ("preparation.cache=null", "preparation.frames=4", "trainer.max_steps=2")
    own = example("A Large Reconstruction Model", "lrm", "cardboard", *changes)
    run(own, tmp_path / "own", [], resume=False)
    content = metrics(tmp_path / "own")
    assert content["lrm"]["frames"] == 4
    assert content["decomposition"]["xz"]["converged"]
    assert (tmp_path / "own" / "media" / "fixed_view.png").is_file()
    random = compose_plain("train", ["lrm=none"])["lrm"]
    run(own | {"lrm": random}, tmp_path / "random", [], resume=False)
    own_psnr, random_psnr = (psnr_at_the_ends(tmp_path / name)[0] for name in ("own", "random"))
    assert own_psnr > random_psnr + 1


def test_the_model_of_the_docs_trains(example, tmp_path):
    own = example("A model", "model", "mlp", "trainer.max_steps=60")
    assert own["lrm"]["name"] == "none"
    run(own, tmp_path / "run", [], resume=False)
    first, last = psnr_at_the_ends(tmp_path / "run")
    assert last > first + 1
    field = load_run(tmp_path / "run", plugins=["my_package"]).module.field
    assert (dict(field.planes), field.moves) == ({}, True)
    assert (field.precision, field.outline) == ("32", "MLPField")


def test_the_variant_and_the_loss_of_the_docs_train(example, tmp_path):
    loss = ["plugins=[my_package,tests.plugins]", "lrm=none", "trainer.max_steps=3"]
    (command,) = re.findall(r"^    python train.py .*losses.*", PAGE.read_text(), re.MULTILINE)
    loss += [word for word in command.split() if word.startswith("+losses")]
    own = example("A variant of X-Planes", "model", "scaled", *loss)
    run(own, tmp_path / "run", [], resume=False)
    module = load_run(tmp_path / "run", plugins=["my_package", "tests.plugins"]).module
    assert float(module.field.scale.detach()) != 1
    assert "alpha" in module.method.losses


def test_the_settings_of_the_docs_data_format_are_complete(scenes):
    (block,) = re.findall(r"```yaml\n(.*?)```", section("A data format"), re.DOTALL)
    with plugins(["tests.plugins"]):
        scene = build(yaml.safe_load(block), SceneSettings, "data").load(("train",))
    assert len(scene.splits["train"]) == 6


GROUP = {"params": [], "lr": 0.1, "name": "mlp"}

GROUPS = (
    ([{"params": [], "lr": 0.1}], 'MLPModel.groups: a group lacks name; write {"params": '),
    ([{"name": "mlp"}], "a group lacks params and lr; write"),
    ([GROUP] * 2, "two groups have the name mlp"),
    (
        [GROUP | {"learning_rate": 1}],
        "the group mlp has 'learning_rate', which Adam does not accept; it accepts lr, betas",
    ),
    ([GROUP], "no group has layers.0.weight of MLPField, which would never be trained; add it"),
)


def test_models_that_cannot_be_trained_are_refused_when_they_are_built(example, monkeypatch):
    own = example("A model", "model", "mlp")
    scene = SceneDataModule(own["data"]).scene

    def build_one() -> None:
        RadianceModule(own, plugins=["my_package"]).build(scene)

    build_one()
    model = sys.modules["my_package.mlp"].MLPModel
    for groups, words in GROUPS:
        monkeypatch.setattr(model, "groups", lambda self, found=groups: [dict(g) for g in found])
        assert_refused(ConfigError, re.escape(words), build_one, groups)
    monkeypatch.setattr(model, "field", torch.nn.Linear(4, 4), raising=False)
    words = "MLPModel.field: Linear must be derived from xplanes.fields.base.RadianceField"
    assert_refused(ConfigError, re.escape(words), build_one, "a linear layer")


def test_a_part_of_a_field_may_not_hide_behind_a_property():
    field = RadianceField()
    with pytest.raises(AttributeError, match=r"RadianceField\.planes is a property; rename"):
        field.planes = torch.nn.ParameterDict()
