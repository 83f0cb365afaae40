"""The command line is Hydra's own: every option of its manual, and its own errors."""

import json
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from lightning.pytorch.loggers import TensorBoardLogger

from tests.training.runs import small_config
from xplanes.config import compose_plain
from xplanes.errors import ConfigError
from xplanes.launch import prepare
from xplanes.run import run
from xplanes.training.logs import forget_later

ROOT = Path(__file__).resolve().parents[1]

QUICK = """
import sys
from xplanes.cli import main
code = 0
try:
    main(["train", *sys.argv[1:]])
except SystemExit as end:
    code = end.code
heavy = {"torch", "lightning", "numba", "numpy"} & set(sys.modules)
sys.exit(f"loaded {heavy}" if heavy else code)
"""


def train(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """The command line up to where a job would begin, which must load nothing heavy."""
    return subprocess.run(
        [sys.executable, "-c", QUICK, *arguments],
        cwd=cwd,
        env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--help",), "Configuration groups"),
        (("--cfg=job",), "plane_set: six"),
        (("--cfg", "job", "--package", "model"), "plane_set: six"),
        (("--config-name=pretrain_lrm", "--cfg", "job"), "muon_lr"),
        (("--info", "defaults"), "callbacks/default"),
        (("-sc", "install=bash"), "hydra_bash_completion"),
        (("model=nine_planes", "lrm=xlarge", "--cfg", "job"), "openlrm-large-1.1"),
    ],
    ids=str,
)
def test_options_of_hydra_work(arguments, words, tmp_path: Path) -> None:
    done = train(*arguments, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert words in done.stdout + done.stderr


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
def test_unknown_keys_get_hydras_error_and_near_names(override, near, tmp_path: Path) -> None:
    done = train(override, cwd=tmp_path)
    assert done.returncode == 1
    key = override.partition("=")[0]
    assert f"Could not override '{key}'" in done.stderr
    assert f"Did you mean {near}" in done.stderr or f" or {near}" in done.stderr
    with pytest.raises(ConfigError, match=f"Could not override(.|\n)*{near}"):
        compose_plain("train", [override])


@pytest.mark.parametrize(
    ("override", "near"),
    [
        ("model=six_plane", "model=six_planes"),
        ("lrm=tinny", "lrm=tiny"),
        ("data=demos", "data=demo"),
        ("model/sampler=ocupancy", "model/sampler=occupancy"),
        ("experiment=tabel1", "experiment=table1"),
    ],
)
def test_unknown_options_are_listed_by_hydra_and_the_nearest_is_named(
    override, near, tmp_path: Path
) -> None:
    done = train(override, cwd=tmp_path)
    assert done.returncode == 1
    assert f"Could not find '{override.replace('=', '/')}'" in done.stderr
    assert f"\t{near.rpartition('=')[2]}\n" in done.stderr
    assert done.stderr.endswith(f"Did you mean {near}?\n")
    with pytest.raises(ConfigError, match=f"Did you mean {near}\\?$"):
        compose_plain("train", [override])


def test_the_command_line_suggests_no_keys_of_other_commands(tmp_path: Path) -> None:
    done = train("max_seconds=3", cwd=tmp_path)
    assert done.stderr.endswith("Did you mean trainer.max_seconds?\n")


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


@pytest.mark.parametrize(
    "extra",
    [
        ("+trainer.fast_dev_run=true",),
        ("trainer.profiler=simple", "trainer.max_steps=3"),
        ("trainer.enable_progress_bar=false", "logger=none", "trainer.max_steps=3"),
        (
            "+callbacks.rate._target_=lightning.pytorch.callbacks.LearningRateMonitor",
            "callbacks.progress=null",
            "trainer.max_steps=3",
        ),
    ],
    ids=str,
)
def test_arguments_of_lightnings_trainer_and_its_callbacks_work(
    extra, scenes: Path, tmp_path: Path
) -> None:
    base = small_config(scenes)
    kept = [f"data.root={base['data']['root']}"]
    from tests.training.runs import SMALL

    config = compose_plain("train", [*SMALL, *kept, "callbacks.evaluation.at=[1]", *extra])
    run(config, tmp_path / "run", [], resume=False)
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["step"] == (1 if "fast" in extra[0] else 3)


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


def test_the_last_lines_name_tensorboard_only_where_it_has_something_to_show(
    scenes: Path, tmp_path: Path, capsys
) -> None:
    for logger, shown in (("none", False), ("tensorboard", True)):
        config = small_config(scenes, f"logger={logger}", "trainer.max_steps=2")
        run(config, tmp_path / logger, [], resume=False)
        lines = capsys.readouterr().out.splitlines()
        (line,) = [line for line in lines if line.startswith("next ")]
        assert ("tensorboard --logdir" in line) == shown
        assert f"xplanes render {tmp_path / logger}" in "\n".join(lines)


def test_without_checkpoints_the_last_lines_offer_none(
    scenes: Path, tmp_path: Path, capsys
) -> None:
    config = small_config(scenes, "trainer.max_steps=2")
    config["callbacks"]["checkpoints"] = None
    run(config, tmp_path / "run", [], resume=False)
    shown = capsys.readouterr().out
    assert "last.ckpt" not in shown
    assert "resume=" not in shown
    assert "xplanes render" not in shown
    assert "next     tensorboard" in shown or "next" not in shown


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


def test_the_header_estimates_time_and_the_end_says_what_memory_it_took(
    scenes: Path, tmp_path: Path, capsys
) -> None:
    config = small_config(scenes, "trainer.max_steps=3")
    run(config, tmp_path / "run", [], resume=False)
    printed = capsys.readouterr().out
    line = next(line for line in printed.splitlines() if line.startswith("estimate"))
    assert "at most" in line
    assert "GB" not in line  # Fragments of the heap, which nothing foretells, are half of it.
    peak = json.loads((tmp_path / "run" / "metrics.json").read_text())["peak_memory_bytes"]
    assert f"memory   {peak / 2**30:.1f} GB" in printed.split("step 3/3")[1]
    assert printed.index("estimate") < printed.index("step 3/3")


@pytest.mark.parametrize("split", ["test", "val"])
def test_tensorboard_has_each_point_once(scenes: Path, tmp_path: Path, split: str) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    changes = ("logger=tensorboard", "trainer.max_steps=6", "trainer.log_every_n_steps=2")
    run(small_config(scenes, *changes, f"data.eval_split={split}"), tmp_path, [], resume=False)
    events = EventAccumulator(str(tmp_path / "tb"))
    events.Reload()
    scalars = {
        tag: [point.step for point in events.Scalars(tag)] for tag in events.Tags()["scalars"]
    }
    assert {f"{split}/psnr", "time/train_s", "train/loss"} <= set(scalars)
    for tag, steps in scalars.items():
        assert len(set(steps)) == len(steps), tag
    parts = events.summary_metadata
    assert {"_hparams_/experiment", "_hparams_/session_start_info"} <= set(parts)


def test_tensorboard_drops_what_a_run_that_was_cut_off_has_left(tmp_path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

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
