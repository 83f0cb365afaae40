"""With nothing but Lightning: its own Trainer, loggers, callbacks and checkpoints."""

import copy
import os
import re
import shutil
from pathlib import Path
from unittest import mock

import lightning
import pytest
import torch
from lightning.pytorch.callbacks import Callback, LearningRateMonitor, ModelCheckpoint
from lightning.pytorch.loggers import CSVLogger, Logger

from tests.training.runs import checkpoint, metrics, same_state, small_config
from tests.warm import ROOT
from xplanes import RadianceModule, SceneDataModule
from xplanes.errors import ConfigError, SceneError
from xplanes.experiment import Experiment
from xplanes.files import read_rows
from xplanes.run import run
from xplanes.training.building import loss_terms
from xplanes.training.evaluation import Evaluation
from xplanes.training.fit import Trainer

CALLBACKS = "lightning.pytorch.callbacks"


@pytest.fixture(scope="module")
def config(scenes: Path) -> dict:
    return small_config(scenes, "model.rays.per_batch=1024")


PLAIN = {"accelerator": "cpu", "enable_progress_bar": False, "enable_model_summary": False}


def trainer(folder: Path, **options) -> lightning.Trainer:
    given = {"max_steps": 45, "default_root_dir": folder, "log_every_n_steps": 5, **PLAIN}
    given["logger"] = CSVLogger(folder, name="", version="csv")
    return lightning.Trainer(**given | options)


def fit(
    config: dict, folder: Path, module: lightning.LightningModule | None = None, **options
) -> lightning.Trainer:
    """A trainer that has trained a module, by default a fresh one, without scores."""
    used = trainer(folder, **{"logger": False, "limit_val_batches": 0} | options)
    used.fit(module or RadianceModule(config), SceneDataModule(config["data"]))
    return used


def logged(folder: Path) -> dict[str, list[float]]:
    found: dict[str, list[float]] = {}
    for row in read_rows(folder / "csv" / "metrics.csv"):
        for name, value in row.items():
            if value:
                found.setdefault(name, []).append(float(value))
    return found


@pytest.fixture(scope="module")
def fitted(config: dict, tmp_path_factory: pytest.TempPathFactory) -> tuple:
    folder = tmp_path_factory.mktemp("plain")
    module, data = RadianceModule(config), SceneDataModule(config["data"])
    checkpoints = ModelCheckpoint(folder, filename="best", monitor="val/psnr", mode="max")
    used = trainer(folder, callbacks=[checkpoints, LearningRateMonitor()])
    used.fit(module, data)
    return folder, module, data, used


def test_fit_logs_every_term_of_the_loss_validates_and_keeps_the_best(fitted):
    folder, module, _, used = fitted
    values = logged(folder)
    terms = {"colour", "opacity", "floaters", "total_variation", "time_variation"}
    terms |= {"time_smoothness", "time_magnitude", "sparsity"}
    assert terms <= {name.removeprefix("train/") for name in values}
    total = sum(values[f"train/{name}"][-1] for name in terms)
    assert values["train/loss"][-1] == pytest.approx(total, rel=1e-5)
    assert values["train/loss"][0] > values["train/loss"][-1]
    # An epoch is as many rays as the views have pixels.
    assert len(values["val/psnr"]) == 45 // (10 * 32 * 32 // 1024)
    assert values["val/psnr"][-1] > values["val/psnr"][0] + 0.5
    assert used.callback_metrics["val/psnr"] == pytest.approx(values["val/psnr"][-1])
    assert (folder / "best.ckpt").is_file()
    assert module.global_step == 45
    assert any(name.startswith("lr-") or name.startswith("lr/") for name in values)


def test_validate_and_test_score_their_own_splits(fitted):
    _, module, data, used = fitted
    found = used.validate(module, data, verbose=False)[0]
    assert set(found) == {"val/psnr", "val/ssim", "val/floaters"}
    tested = used.test(module, data, verbose=False)[0]
    assert set(tested) == {"test/psnr", "test/ssim", "test/floaters"}
    assert found["val/psnr"] != tested["test/psnr"]
    images = used.predict(module, data)
    assert images is not None
    assert [image["colour"].shape for image in images] == [(32, 32, 3)] * 3


def test_pixels_without_rays_are_background_in_every_score(fitted):
    _, module, data, _ = fitted
    batch = next(iter(data.test_dataloader()))
    assert "shown" not in batch
    whole = module.predict_step(batch, 0)
    shown = torch.ones(32, 32, dtype=torch.bool)
    shown[:9, :9] = False
    part = module.predict_step({**batch, "shown": shown}, 0)
    assert torch.equal(part["colour"][shown], whole["colour"][shown])
    assert bool((part["colour"][~shown] == batch["background"]).all())
    assert not part["opacity"][~shown].any()


def test_no_number_of_steps_is_no_limit(tmp_path):
    options = {"accelerator": "cpu", "default_root_dir": tmp_path, "logger": False}
    options |= {"max_steps": -1, "max_seconds": 5.0}
    assert Trainer(**options).max_epochs == -1
    assert Trainer(**options, max_epochs=3).max_epochs == 3


def test_callbacks_that_watch_a_metric_see_every_evaluation(scenes, tmp_path):
    config = small_config(scenes, "trainer.max_steps=20", "callbacks.evaluation.at=[0,0.2,0.4,0.6]")
    watched = {"monitor": "val/psnr", "mode": "max"}
    stop = {"_target_": f"{CALLBACKS}.EarlyStopping", "patience": 1, "min_delta": 99}
    keep = {"_target_": f"{CALLBACKS}.ModelCheckpoint", "filename": "mine"}
    config["callbacks"] |= {
        "stop": watched | stop,
        "keep": watched | keep | {"dirpath": str(tmp_path)},
    }
    run(config, tmp_path / "run", [], resume=False)
    # The evaluation after two fifths of the steps is not 99 dB better than the one before.
    assert metrics(tmp_path / "run")["step"] == 8
    assert torch.load(tmp_path / "mine.ckpt", weights_only=True)["global_step"] == 8


class Lines(Logger):
    """A logger that takes no folder."""

    name, version = "lines", 0

    def log_metrics(self, metrics, step=None) -> None:
        pass

    def log_hyperparams(self, params, *rest) -> None:
        pass


@pytest.mark.parametrize("limits", [{"max_steps": 4}, {"max_epochs": 2, "limit_train_batches": 2}])
def test_evaluations_join_a_fit_that_builds_the_field(config, tmp_path, limits):
    callbacks = [Evaluation(at=[0, 0.5])]
    fit(config, tmp_path, logger=True, limit_val_batches=1.0, callbacks=callbacks, **limits)
    assert [row["step"] for row in read_rows(tmp_path / "curve.csv")] == ["0", "2", "4"]


def test_loggers_need_no_folder(tmp_path):
    config = small_config(tmp_path, "trainer.max_steps=2")
    config["logger"] = {"lines": {"_target_": "tests.test_lightning.Lines"}}
    config["plugins"] = ["tests.test_lightning"]
    trainer = Experiment.read(config, config["plugins"]).build_trainer(tmp_path)
    assert type(trainer.logger).__name__ == "Lines"


def test_gradients_are_clipped_and_accumulated(config, tmp_path):
    norms: list[float] = []

    class Watch(Callback):
        def on_before_zero_grad(self, trainer, module, optimizer) -> None:
            gradients = [p.grad.norm() for p in module.parameters() if p.grad is not None]
            if gradients:
                norms.append(torch.stack(gradients).norm().item())

    options = {"gradient_clip_val": 1e-3, "accumulate_grad_batches": 2, "callbacks": [Watch()]}
    # The third batch ends the epoch, and hence a step; every second step is logged.
    options |= {"limit_train_batches": 3, "log_every_n_steps": 2}
    options |= {"logger": CSVLogger(tmp_path, name="", version="csv")}
    module = RadianceModule(config)
    used = fit(config, tmp_path, module, max_steps=4, **options)
    assert (used.global_step, module.batches) == (4, 6)
    assert len(logged(tmp_path)["train/loss"]) == 2
    assert max(norms) < 1.001e-3
    assert module.tally.last["loss"] > 0


def test_a_fit_after_one_that_was_broken_off_begins_with_low_rates(config, tmp_path):
    rates: list[float] = []

    class BreaksOff(Callback):
        def on_before_optimizer_step(self, trainer, module, optimizer) -> None:
            rates.append(optimizer.param_groups[0]["lr"])
            if len(rates) == 1:
                raise RuntimeError("a fault of one's own")

    module, callbacks = RadianceModule(config), [BreaksOff()]
    with pytest.raises(RuntimeError, match="a fault of one's own"):
        fit(config, tmp_path, module, callbacks=callbacks)
    fit(config, tmp_path, module, callbacks=callbacks, max_steps=2)
    assert rates[0] == rates[1] < rates[2]


def test_two_halves_of_a_batch_make_the_same_step_as_the_whole(config):
    """Each is half of the rays; the loss is a mean."""
    config = copy.deepcopy(config)
    config["model"]["sampler"]["thinning"] = 0.0  # Whose draws would differ.
    data = SceneDataModule(config["data"])
    found = []
    for parts in (1, 2):
        module = RadianceModule(config)
        module.build(data.scene)
        batch = data.batches_for(module, 0).draw(0, 512)
        for part in range(parts):
            rays = {name: value[part::parts] for name, value in batch.items()}
            rendering = module.sampler.render(module.field, rays, module.state)
            terms = loss_terms(module.parts, module.method.losses, rendering, rays, module.state)
            (sum(terms.values()) / parts).backward()
        found.append(module.field.space.grad.clone())
    torch.testing.assert_close(found[0], found[1], rtol=1e-3, atol=1e-7)


def test_a_scene_without_a_test_split_is_tested_on_its_validation_views(config, tmp_path):
    made = SceneDataModule(config["data"])
    shutil.copytree(made.settings.folder, tmp_path / "scene")
    (tmp_path / "scene" / "transforms_test.json").unlink()
    options = ("data=dnerf", f"data.root={tmp_path}", "data.scene=scene", "data.resolution=32")
    data = SceneDataModule.compose(*options)
    used, module = trainer(tmp_path, max_steps=3, logger=False), RadianceModule(config)
    used.fit(module, data)
    validated = used.validate(module, data, verbose=False)[0]
    tested = used.test(module, data, verbose=False)[0]
    assert tested["test/psnr"] == validated["val/psnr"]
    # A damaged split is no missing one: nothing is held out in its place.
    (tmp_path / "scene" / "transforms_val.json").write_text("{")
    with pytest.raises(SceneError, match="transforms_val"):
        SceneDataModule.compose(*options).setup("validate")


def test_test_views_are_scored_in_training_only_where_the_settings_say_so(config):
    data = SceneDataModule(config["data"])
    assert (data.validation_split, data.test_split) == ("val", "test")
    for split in ("val", "test"):
        data = SceneDataModule(config["data"] | {"eval_split": split})
        data.setup("fit")
        assert (data.validation_split, data.test_split) == (split, split)
        assert list(data.scene.splits) == ["train", split]
    assert [batch["target"].shape for batch in data.val_dataloader()] == [(32, 32, 3)] * 3


def test_a_module_without_data_says_what_it_needs(config, tmp_path):
    loader = torch.utils.data.DataLoader([0])
    with pytest.raises(ConfigError, match="trains with a SceneDataModule"):
        trainer(tmp_path, logger=False).fit(RadianceModule(config), loader)


class Other(lightning.LightningModule):
    """Somebody else's module on our data."""

    def __init__(self) -> None:
        super().__init__()
        self.colour = torch.nn.Parameter(torch.zeros(3))

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.5)

    def training_step(self, batch: dict, index: int) -> torch.Tensor:
        return (self.colour - batch["target"]).square().mean()


def test_the_data_serve_other_modules(config, tmp_path):
    module = Other()
    fit(config, tmp_path, module)
    assert float(module.colour.min()) > 0.5  # Most of the images is white.


SMALL_MODEL = (
    *("model.resolution=24", "model.sampler.grid_resolution=24", "model.sampler.samples=64"),
    *("model.rays.per_batch=256", "model.rays.samples_per_batch=4096"),
)


def execute(page: str, pattern: str, config: dict, replaced: dict, **names) -> dict:
    """Run a script of the docs on the demo scene, and give its variables."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    (script,) = re.findall(rf"```python\n({pattern})```", text, re.DOTALL)
    folder = SceneDataModule(config["data"]).settings.folder
    small = ", ".join(f'"{text}"' for text in ("lrm=none", *SMALL_MODEL))
    here = {
        '"lrm=none")': f"{small})",
        '"data.root=data/dnerf"': f'"data.root={folder.parent.resolve()}"',
        '"data.scene=lego"': f'"data.scene={folder.name}", "data.resolution=null"',
    }
    for old, new in (here | replaced).items():
        script = script.replace(old, new)
    exec(compile(script, page, "exec"), names)
    return names


def test_the_script_of_the_docs_runs(config, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    execute("recipes.md", "import lightning.*?", config, {"max_steps=2000": "max_steps=20"})
    assert (tmp_path / "field.ckpt").is_file()
    assert (tmp_path / "view.png").is_file()


def test_the_page_on_your_own_trainer_runs(config, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    short = {
        "max_steps=2000": 'max_steps=12, accelerator="cpu"',
        "val_check_interval=500": "val_check_interval=6",
    }
    names = execute("own_trainer.md", ".*?", config, short)
    assert names["trainer"].global_step == 12
    kept = checkpoint(tmp_path, "best")
    averaged, last = kept["state_dict"], kept["current_model_state"]
    assert not torch.equal(averaged["field.space"], last["field.space"])
    assert torch.equal(averaged["grid.occupied"], last["grid.occupied"])
    again = names["again"]
    same_state(averaged, again.state_dict())
    scored = trainer(tmp_path, logger=False).validate(again, names["data"], verbose=False)[0]
    assert scored["val/psnr"] == pytest.approx(float(names["best"].best_model_score), abs=1e-3)


def test_a_checkpoint_of_another_version_is_refused_with_its_number(fitted, tmp_path):
    fitted[3].save_checkpoint(tmp_path / "old.ckpt")
    content = torch.load(tmp_path / "old.ckpt", weights_only=True)
    content["hyper_parameters"]["config"]["model"]["rays"]["accumulate"] = 1
    for version, words in (("0.1.7", r"xplanes 0\.1\.7"), (None, r"xplanes 0\.2 or older")):
        content.pop("xplanes", None)
        torch.save(content | ({"xplanes": version} if version else {}), tmp_path / "old.ckpt")
        with pytest.raises(ConfigError, match=rf"{words}, whose settings differ from"):
            RadianceModule.load_from_checkpoint(tmp_path / "old.ckpt")


def test_plugins_of_the_docs_are_composed_and_loaded_again(config, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ours = {
        "my_package.extras": "tests.plugins.opacity_loss",
        "my_package": "tests.plugins",
        "max_steps=2000": "max_steps=3",
    }
    given = {"lightning": lightning, "RadianceModule": RadianceModule}
    data = SceneDataModule(config["data"])
    names = execute("recipes.md", "module = .*?", config, ours, data=data, **given)
    assert names["again"].method.losses["op"].weight == 0.1
    words = r"name a module of your own with load_from_checkpoint\(path, plugins=\[MODULE\]\)$"
    with pytest.raises(ConfigError, match=rf"^losses\.op\._target_=tests\.plugins.*{words}"):
        RadianceModule.load_from_checkpoint("field.ckpt")


def test_a_list_of_settings_is_refused():
    for kind in (RadianceModule, SceneDataModule):
        with pytest.raises(ConfigError, match=r"^compose\(\['seed=1'\]\): pass each setting"):
            kind.compose(["seed=1"])  # type: ignore[arg-type]


def test_processes_do_not_send_each_other_the_grid_before_each_step(config, tmp_path):
    """In a group of one process, which torch treats like any other."""
    sent = []

    class Watch(Callback):
        def on_train_batch_end(self, trainer, *_):
            sent.append({buffer.data_ptr() for buffer in trainer.model.modules_buffers})

    module, options = RadianceModule(config), {"strategy": "ddp", "devices": 1}
    with mock.patch.dict(os.environ):  # Lightning notes ranks and ports there.
        try:
            fit(config, tmp_path, module, max_steps=2, callbacks=[Watch()], **options)
        finally:
            torch.distributed.destroy_process_group()
    assert len(sent) == 2
    grid = {buffer.data_ptr() for buffer in module.sampler.modules["grid"].buffers()}
    assert len(grid) > 3
    assert not grid & sent[-1]


def test_what_a_trainer_of_ours_settles_for_gpus(tmp_path):
    before = torch.get_float32_matmul_precision(), torch.backends.cudnn.allow_tf32
    try:
        for tf32, products in ((True, "high"), (False, "highest")):
            Trainer(accelerator="cpu", default_root_dir=tmp_path, logger=False, tf32=tf32)
            assert torch.get_float32_matmul_precision() == products
            assert torch.backends.cudnn.allow_tf32 is tf32
    finally:
        torch.set_float32_matmul_precision(before[0])
        torch.backends.cudnn.allow_tf32 = before[1]
