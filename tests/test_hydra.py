"""The command line is Hydra's own: every option of its manual, and its own errors."""

import json
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from lightning.pytorch.loggers import TensorBoardLogger
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from tests.training.runs import SMALL, small_config
from tests.warm import forked
from xplanes.config import compose_plain
from xplanes.errors import ConfigError
from xplanes.launch import prepare
from xplanes.run import run
from xplanes.training.logs import forget_later


@pytest.mark.parametrize(
    ("overrides", "near"),
    [
        (["trainer.max_second=3"], "trainer.max_seconds or trainer.max_steps"),
        (["max_seconds=3"], "trainer.max_seconds"),
        (["schedule.max_seconds=3"], "trainer.max_seconds"),  # It belongs to pretrain_lrm.
        (["model=kplanes", "model.learning_rat=3"], "model.learning_rate"),
        (["data=colmap", "data.test_camera=3"], "data.test_cameras"),
        (["callback=threads"], "callbacks"),
    ],
    ids=str,
)
def test_keys_that_this_run_does_not_have_are_not_suggested(overrides, near) -> None:
    with pytest.raises(ConfigError, match=rf"\nDid you mean {near}\?$"):
        compose_plain("train", overrides)


def test_other_configurations_have_suggestions_of_their_own() -> None:
    with pytest.raises(ConfigError, match=r"\nDid you mean schedule\.max_seconds or .*schedule"):
        compose_plain("pretrain_lrm", ["schedule.max_second=3"])


COMMANDS = {
    ("--help",): "Configuration groups",
    ("--cfg=job",): "plane_set: six",
    ("--cfg", "job", "--package", "model"): "plane_set: six",
    ("--config-name=pretrain_lrm", "--cfg", "job"): "muon_lr",
    ("--info", "defaults"): "callbacks/default",
    ("-sc", "install=bash"): "hydra_bash_completion",
    ("model=nine_planes", "lrm=xlarge", "--cfg", "job"): "openlrm-large-1.1",
    # Refused, as the last line of Hydra's error.
    ("data.resolutoin=3",): "Did you mean data.resolution?\n",
    ("max_seconds=3",): "Did you mean trainer.max_seconds?\n",
    ("lrm=tinny",): "Did you mean lrm=tiny?\n",
}
"""Command lines that end before a job begins, and what they print."""

QUICK = """
from xplanes.cli import main
try:
    main(["train", *{}])
finally:
    if {{"torch", "lightning", "numba", "numpy"}} & set(sys.modules):
        sys.exit(9)
"""


def test_command_lines_without_a_job_are_hydras_and_load_nothing_heavy(tmp_path: Path) -> None:
    found = forked("import hydra", [QUICK.format(list(given)) for given in COMMANDS], tmp_path)
    for (code, printed), (arguments, words) in zip(found, COMMANDS.items(), strict=True):
        refused = words.startswith("Did you mean")
        assert printed.endswith(words) if refused else words in printed, (arguments, printed)
        assert code == int(refused), (arguments, printed)


@pytest.mark.parametrize(
    ("override", "near"),
    [
        ("data.resolutoin=3", "data.resolution"),
        ("sampler.samples=3", "model.sampler.samples"),
        ("trainer.plane_lr=3", "model.plane_lr"),
        ("model.sampler.sampels=3", "model.sampler.samples"),
        ("recpe=paper", "recipe"),
    ],
)
def test_unknown_keys_get_hydras_error_and_near_names(override, near) -> None:
    with pytest.raises(ConfigError, match=f"Could not override(.|\n)*{near}"):
        compose_plain("train", [override])


@pytest.mark.parametrize(
    ("override", "near"),
    [
        ("model=six_plane", "model=six_planes"),
        ("data=demos", "data=demo"),
        ("model/sampler=ocupancy", "model/sampler=occupancy"),
    ],
)
def test_unknown_options_are_listed_by_hydra_and_the_nearest_is_named(override, near) -> None:
    with pytest.raises(ConfigError, match=f"Did you mean {near}\\?$") as caught:
        compose_plain("train", [override])
    assert f"Could not find '{override.replace('=', '/')}'" in str(caught.value)


def test_misfits_of_the_trainer_are_said_with_a_message(scenes: Path, tmp_path: Path) -> None:
    cases = [
        ({"max_secnds": 3}, "trainer.max_secnds=3: Trainer has no such argument"),
        ({"accelerator": "tpu"}, "trainer.accelerator=tpu: must be one of auto, cpu, gpu"),
        ({"max_seconds": -1}, "trainer.max_seconds=-1: must be above 0"),
    ]
    for more, words in cases:
        config = small_config(scenes)
        config["trainer"] |= more
        with pytest.raises(ConfigError) as caught:
            run(config, tmp_path / f"run_{words[:12]}", [], resume=False)
        assert words in str(caught.value), words
        assert not (tmp_path / f"run_{words[:12]}").exists()


def test_an_unknown_argument_of_a_logger_is_refused_before_anything_is_written(
    scenes: Path,
    tmp_path: Path,
) -> None:
    config = small_config(scenes, "logger=tensorboard")
    config["logger"]["tensorboard"]["foo"] = 1
    with pytest.raises(ConfigError, match=r"logger\.tensorboard\.foo=1: .* no such argument"):
        run(config, tmp_path / "run", [], resume=False)
    assert not (tmp_path / "run").exists()


def test_a_run_of_an_earlier_version_is_refused_with_its_version(tmp_path: Path) -> None:
    (tmp_path / "overrides.txt").write_text("loss.every=4\n")
    (tmp_path / "run.json").write_text(json.dumps({"xplanes": "0.1.0", "status": "interrupted"}))
    with pytest.raises(ConfigError, match=r"made by xplanes 0\.1\.0.*start a new run"):
        prepare([f"resume={tmp_path}"])


def test_a_run_that_failed_before_its_first_checkpoint_blocks_nothing(
    scenes: Path, tmp_path: Path
) -> None:
    config = small_config(scenes, "trainer.max_steps=3")
    broken = small_config(scenes, "data.scene=excavator", "data.views=999")
    with pytest.raises(Exception, match=r"data\.views=999"):
        run(broken, tmp_path / "run", [], resume=False)
    assert json.loads((tmp_path / "run" / "run.json").read_text())["status"] == "failed"
    run(config, tmp_path / "run", [], resume=False)
    with pytest.raises(ConfigError, match="holds a run already"):
        run(config, tmp_path / "run", [], resume=False)


def test_tensorboard_drops_what_a_run_that_was_cut_off_has_left(tmp_path) -> None:
    def trainer():
        log = TensorBoardLogger(str(tmp_path), name="", version="tb")
        return SimpleNamespace(loggers=[log]), log

    _, first = trainer()
    for step in (10, 20, 30):
        first.log_metrics({"loss": float(step)}, step)
    first.experiment.close()
    time.sleep(1.1)  # Event files are read in the order of the seconds in their names.
    goes_on, second = trainer()
    forget_later(goes_on, 20)
    for step in (30, 40):
        second.log_metrics({"loss": 100.0 + step}, step)
    second.experiment.close()
    events = EventAccumulator(str(tmp_path / "tb"))
    events.Reload()
    found = [(event.step, event.value) for event in events.Scalars("loss")]
    assert found == [(10, 10.0), (20, 20.0), (30, 130.0), (40, 140.0)]


@pytest.mark.parametrize(
    "extra",
    [
        ("+trainer.fast_dev_run=true",),
        (
            *("trainer.profiler=simple", "trainer.enable_progress_bar=false", "logger=none"),
            "callbacks.progress=null",
            "+callbacks.mine._target_=lightning.pytorch.callbacks.Timer",
        ),
    ],
    ids=str,
)
def test_arguments_of_lightnings_trainer_and_its_callbacks_work(
    extra, scenes: Path, tmp_path: Path
) -> None:
    short = (f"data.root={scenes}", "callbacks.evaluation.at=[1]", "trainer.max_steps=3")
    run(compose_plain("train", [*SMALL, *short, *extra]), tmp_path / "run", [], resume=False)
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["step"] == (1 if "fast" in extra[0] else 3)


def test_a_run_says_at_its_ends_what_it_takes_and_what_comes_next(
    scenes: Path, tmp_path: Path, capsys
) -> None:
    changes = ("logger=tensorboard", "trainer.max_steps=6", "trainer.log_every_n_steps=2")
    run(small_config(scenes, *changes, "data.eval_split=val"), tmp_path, [], resume=False)
    printed = capsys.readouterr().out
    line = next(line for line in printed.splitlines() if line.startswith("estimate"))
    assert "at most" in line
    assert "GB" not in line  # Fragments of the heap, which nothing foretells, are half of it.
    assert printed.index("estimate") < printed.index("step 6/6")
    last = printed.split("step 6/6")[1]
    peak = json.loads((tmp_path / "metrics.json").read_text())["peak_memory_bytes"]
    assert f"memory   {peak / 2**30:.1f} GB" in last
    assert "tensorboard --logdir" in last
    assert f"xplanes render {tmp_path}" in last
    events = EventAccumulator(str(tmp_path / "tb"))
    events.Reload()
    scalars = {
        tag: [point.step for point in events.Scalars(tag)] for tag in events.Tags()["scalars"]
    }
    assert {"val/psnr", "time/train_s", "train/loss"} <= set(scalars)
    for tag, steps in scalars.items():
        assert len(set(steps)) == len(steps), tag
    parts = events.summary_metadata
    assert {"_hparams_/experiment", "_hparams_/session_start_info"} <= set(parts)


def test_nothing_is_offered_that_a_run_does_not_leave(scenes: Path, tmp_path: Path, capsys) -> None:
    config = small_config(scenes, "trainer.max_steps=2", "logger=none")
    config["callbacks"]["checkpoints"] = None
    run(config, tmp_path / "run", [], resume=False)
    shown = capsys.readouterr().out
    for words in ("last.ckpt", "resume=", "xplanes render", "tensorboard"):
        assert words not in shown
