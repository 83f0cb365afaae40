"""Callbacks, loggers and arguments of Lightning's that do not go with training as it is here."""

import warnings
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from lightning.pytorch import callbacks
from lightning.pytorch.loggers import CSVLogger

from tests.baselines.runs import TINEUVOX, baseline_config
from tests.test_lightning import PLAIN, fit
from tests.training.runs import NO_CURVE, checkpoint, metrics, small_config
from xplanes import RadianceModule
from xplanes.errors import ConfigError
from xplanes.files import read_rows
from xplanes.run import run
from xplanes.tools.evaluate import evaluate
from xplanes.tools.runs import load_run
from xplanes.training.csv_logger import CSVLogger as OwnCSVLogger
from xplanes.training.evaluation import Evaluation
from xplanes.training.fit import Trainer


class Numbers(callbacks.Callback):
    """A callback whose state is what numpy makes of a mean."""

    def __init__(self, kind: str = "numpy") -> None:
        self.kind = kind

    def state_dict(self) -> dict[str, Any]:
        return {"mean": np.mean([1.0, 2.0]) if self.kind == "numpy" else 1.5}


def rows(folder: Path) -> list[dict[str, str]]:
    return read_rows(folder / "csv" / "metrics.csv")


WRONG_EVERYWHERE = (
    ({"precision": "64-true"}, r"precision=64-true.*model\.precision"),
    ({"overfit_batches": 1}, r"overfit_batches=1.*data\.views"),
)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        *WRONG_EVERYWHERE,
        ({"precision": "bf16-true"}, r"precision=bf16-true.*model\.precision"),
        ({"precision": "16-mixed"}, r"precision=16-mixed.*model\.precision"),
        *(
            ({name: 5, "callbacks": [Evaluation()]}, rf"{name}=5: .*callbacks\.evaluation\.at")
            for name in ("val_check_interval", "check_val_every_n_epoch", "num_sanity_val_steps")
        ),
        (
            {"callbacks": [callbacks.StochasticWeightAveraging(0.1)]},
            r"StochasticWeightAveraging.*EMAWeightAveraging",
        ),
    ],
)
def test_what_would_train_wrongly_is_refused(options, words):
    with pytest.raises(ConfigError, match=words):
        Trainer(max_steps=2, **PLAIN, **options)


@pytest.mark.parametrize(("options", "words"), WRONG_EVERYWHERE)
def test_a_plain_trainer_that_would_train_wrongly_is_refused(options, words, scenes, tmp_path):
    with pytest.raises(ConfigError, match=words):
        fit(small_config(scenes), tmp_path, **options)


@pytest.mark.parametrize(
    "model",
    [
        ("model=tineuvox_reduced", *TINEUVOX),
        ("model=gaussians_hexplane", "model.count=20", "model.resolution=8", "model.width=16"),
    ],
)
def test_averages_of_weights_that_change_their_shapes_are_refused(model, scenes, tmp_path):
    config = baseline_config(scenes, *model)
    average = callbacks.EMAWeightAveraging(use_buffers=False)
    step = Mock()
    watch = callbacks.LambdaCallback(on_train_batch_end=step)
    with pytest.raises(ConfigError, match=r"callbacks: EMAWeightAveraging: .*Model .*leave it out"):
        fit(config, tmp_path, callbacks=[average, watch], max_steps=2)
    step.assert_not_called()


def test_whole_floats_are_accepted():
    for precision in (None, 32, "32", "32-true"):
        assert Trainer(max_steps=2, precision=precision, **PLAIN).precision == "32-true"


def test_a_state_that_could_not_be_read_again_is_refused_at_once(scenes, tmp_path):
    config = small_config(scenes, "trainer.max_steps=2", NO_CURVE)
    config["plugins"] = ["tests.test_foreign_parts"]
    config["callbacks"]["mine"] = {"_target_": "tests.test_foreign_parts.Numbers"}
    with pytest.raises(ConfigError, match=r"callback Numbers.*numpy.*state_dict"):
        run(config, tmp_path / "numpy", [], resume=False)
    assert not list((tmp_path / "numpy").rglob("*.ckpt"))
    config["callbacks"]["mine"]["kind"] = "float"
    run(config, tmp_path / "float", [], resume=False)
    kept = checkpoint(tmp_path / "float")
    assert {"mean": 1.5} in kept["callbacks"].values()


def test_a_resumed_run_goes_on_with_its_csv(scenes, tmp_path):
    options = ("logger=csv", "trainer.log_every_n_steps=2", "callbacks.checkpoints.every=4")

    def train(steps: int, *, resume: bool) -> None:
        config = small_config(scenes, *options, f"trainer.max_steps={steps}")
        with warnings.catch_warnings():
            warnings.filterwarnings("error", ".*will be deleted.*")
            run(config, tmp_path, [], resume=resume)

    train(8, resume=False)
    before = rows(tmp_path)
    # As if it had been killed later than its last checkpoint: these steps are done again.
    with (tmp_path / "csv" / "metrics.csv").open("a") as file:
        file.write(",".join("9" for _ in before[0]) + "\n")
    train(14, resume=True)
    found = [int(row["step"]) for row in rows(tmp_path) if row["train/loss"]]
    assert found == [1, 3, 5, 7, 9, 11, 13]
    kept = rows(tmp_path)[: len(before)]
    assert [{k: row[k] for k in before[0]} for row in kept][:4] == before[:4]


@pytest.mark.parametrize("rest", ["0.5,9", "0.5,5,0", "0.5,,", "0.5,\0\0", "0.5,9,0.5,9"])
def test_a_row_that_was_cut_off_does_not_end_the_csv(tmp_path, rest):
    def log(step: int) -> None:
        log = OwnCSVLogger(tmp_path, name="", version="csv")
        log.log_metrics({"loss": 0.5, "train/loss": 0.5}, step)
        log.save()

    log(3)
    with (tmp_path / "csv" / "metrics.csv").open("a") as file:
        file.write(rest)
    log(9)
    assert [row["step"] for row in rows(tmp_path)] == ["3", "9"]
    (tmp_path / "csv" / "metrics.csv").write_text("step,train/loss,val/psnr\n3,")
    log(9)
    assert [row["step"] for row in rows(tmp_path)] == ["9"]


def test_scores_are_of_the_averaged_weights_that_checkpoints_hold(scenes, tmp_path, trained_run):
    config = small_config(scenes, NO_CURVE, "data.eval_split=val")
    name = "lightning.pytorch.callbacks.EMAWeightAveraging"
    config["callbacks"]["average"] = {"_target_": name, "decay": 0.98}
    run(config, tmp_path / "run", [], resume=False)
    found = metrics(tmp_path / "run")
    again = evaluate(load_run(tmp_path / "run"), "none")
    assert found["test"]["psnr"] == pytest.approx(again["test"]["psnr"], abs=1e-6)
    raw = read_rows(trained_run / "curve.csv")[-1]
    assert raw["split"] == "val"
    assert abs(float(raw["psnr"]) - found["test"]["psnr"]) > 0.1


def test_epochs_end_the_schedules_too(scenes, tmp_path):
    config = small_config(scenes, "model.rays.per_batch=1024")

    def rates(**options: Any) -> tuple[int, list[float]]:
        used = fit(config, tmp_path, **options)
        return used.global_step, [group["lr"] for group in used.optimizers[0].param_groups]

    steps, both = rates(max_epochs=1, max_steps=30_000)
    assert steps < 30_000
    assert rates(max_steps=steps) == (steps, both)


def test_a_module_that_was_loaded_logs_as_a_fresh_one(scenes, tmp_path):
    config = small_config(scenes)

    module = RadianceModule(config)
    for steps, logged in ((6, ["3"]), (9, ["3", "7"])):
        log = CSVLogger(tmp_path / f"{steps}", name="", version="csv")
        used = fit(config, tmp_path, module, max_steps=steps, log_every_n_steps=4, logger=log)
        assert [row["step"] for row in rows(tmp_path / f"{steps}") if row["train/loss"]] == logged
        used.save_checkpoint(tmp_path / "field.ckpt")
        module = RadianceModule.load_from_checkpoint(tmp_path / "field.ckpt")


CALLBACKS = "lightning.pytorch.callbacks"
THEME = {"_target_": f"{CALLBACKS}.progress.rich_progress.X"}
BAR = {"_target_": f"{CALLBACKS}.RichProgressBar", "theme": THEME}
STOP = {"_target_": f"{CALLBACKS}.EarlyStopping", "monitor": "val/pnsr"}


@pytest.mark.parametrize(
    ("key", "name", "value", "words"),
    [
        ("trainer", "logger", False, r"trainer\.logger=False: set logger=none"),
        ("trainer", "default_root_dir", "x", r"trainer\.default_root_dir=x: set hydra\.run\.dir"),
        (
            "callbacks",
            "bar",
            BAR,
            r"callbacks\.bar\.theme\._target_=.*plain values.*class of your own",
        ),
        ("callbacks", "stop", STOP, r"callbacks: EarlyStopping.*val/pnsr"),
    ],
)
def test_settings_that_were_ignored_are_refused(scenes, tmp_path, key, name, value, words):
    config = small_config(scenes, "trainer.max_steps=4")
    config[key][name] = value
    with pytest.raises(ConfigError, match=words):
        run(config, tmp_path / "run", [], resume=False)


def test_a_logger_may_have_a_folder_of_its_own(scenes, tmp_path):
    config = small_config(scenes, "logger=csv", "trainer.max_steps=1", NO_CURVE)
    config["logger"]["csv"]["save_dir"] = str(tmp_path / "elsewhere")
    run(config, tmp_path / "run", [], resume=False)
    assert rows(tmp_path / "elsewhere")
    assert not (tmp_path / "run" / "csv").exists()
