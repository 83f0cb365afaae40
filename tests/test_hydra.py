"""The command line is Hydra's own: every option of its manual, and its own errors."""

import json
import os
import re
import shlex
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from lightning.pytorch.loggers import TensorBoardLogger
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from hydra_plugins.xplanes import ALIASES
from tests import inside
from tests.training.runs import NO_CURVE, SMALL, metrics, small_config, status
from tests.warm import forked
from xplanes import config as config_module
from xplanes.cli import main
from xplanes.config import CONF, compose_plain, near_names
from xplanes.errors import ConfigError, SceneError
from xplanes.evaluation import report
from xplanes.evaluation.estimate import Estimate, estimated
from xplanes.evaluation.render import FRAMES
from xplanes.experiment import Experiment
from xplanes.launch import prepare
from xplanes.run import prepare as prepare_run
from xplanes.run import run
from xplanes.scenes.datamodule import SceneDataModule
from xplanes.training import bar
from xplanes.training.evaluation import forget_later
from xplanes.training.module import RadianceModule


def test_the_help_is_a_page_of_examples_that_compose_and_of_options(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["xplanes", "train", "--help"])
    with pytest.raises(SystemExit, match="0"):
        main()
    shown = capsys.readouterr().out
    assert len(shown.splitlines()) < 30
    examples = re.findall(r"^  xplanes train(.*?)(?:   .*)?$", shown, re.MULTILINE)
    assert len(examples) == 6
    for words in map(shlex.split, examples):
        chosen = [word.split(",")[0] for word in words if "=" in word and "resume" not in word]
        assert compose_plain("train", chosen)["model"]["name"], words
    for group in ("data", "model", "lrm", "recipe", "sweep", "trainer", "logger"):
        row = re.search(rf"^{group} +((?:.|\n {{11}})+)$", shown, re.MULTILINE)
        assert row is not None
        known = {path.stem for path in (CONF / group).glob("*.yaml")}
        names = dict(re.findall(r"(\w+)(?: \((\w+)\))?", row[1]))
        assert set(names) == known, group
        aliases = {alias: name for name, alias in names.items() if alias}
        assert aliases == (ALIASES if group == "lrm" else {})
    assert re.search(r"https://\S+/configuration/$", shown, re.MULTILINE)


NEAR = {
    "trainer.max_second=3": "trainer.max_seconds or trainer.max_steps",
    "max_seconds=3": "trainer.max_seconds",
    "schedule.max_seconds=3": "trainer.max_seconds",  # It belongs to pretrain_lrm.
    "model=kplanes model.learning_rat=3": "model.learning_rate",
    "model.sampler.sampels=3": "model.sampler.samples or model.sampler.name or "
    "model.sampler.render_samples",
    "sampler.samples=3": "model.sampler.samples or model.background.samples",
    "recpe=paper": "recipe",
    "model=six_plane": "model=six_planes",
    "model/sampler=ocupancy": "model/sampler=occupancy",
    "lrm=tripo": "lrm=triposr",
    "lrm=TripoSR": "lrm=large (TripoSR)",
    "lrm=openlrm": "lrm=openlrm_base",
    "experiment=tabel1": "-m sweep=table1",
    "trainer.gpus=2": "trainer=ddp trainer.devices=2",
    "model.lr=0.1": "model.plane_lr=0.1",
    "--max-steps 9": "trainer.max_steps",
}
"""What is typed, and the whole suggestion; nothing that the run does not have is suggested."""

ANSWERS = (
    *((f"train {typed}", f"Did you mean {near}?") for typed, near in NEAR.items()),
    ("train recpe=paper", "Could not override 'recpe'"),
    ("train model=seven_planes", "Could not find 'model/seven_planes'"),
    ("train model=seven_planes", "nine_planes"),
    ("train data=dnerf data.train_views=3", "data.train_views belongs to data=demo"),
    ("pretrain-lrm schedule.max_second=3", "Did you mean schedule.max_seconds or "),
    ("train --model nine_planes", "write model=nine_planes"),
    ("train --model=nine_planes lrm=none", "write model=nine_planes"),
    ("train data.scene excavator", "write data.scene=excavator"),
    ("train data.root=my captures lrm=none", 'write "data.root=my captures"'),
    ("train data.root=my old captures", 'write "data.root=my old captures"'),
    ("train data.root=$my captures", "write 'data.root=$my captures'"),
    ("train callbacks.evaluation.at=[0, 0.5, 1]", 'write "callbacks.evaluation.at=[0, 0.5, 1]"'),
    ("train model.name=a(b", "write \"model.name='a(b'\""),
    ("train excavator", "write key=value"),
    ("train +experiment=demo", "write experiment=demo"),
    (
        "train model.loss.world_variation=1",
        "Did you mean model.loss.total_variation_with_background",
    ),
    ("train -m seed=0,1 --cfg job", "-m with --cfg: Hydra shows one run"),
    ("train -m seed=0,1 --info", "-m with --info: Hydra shows one run"),
    ("trian", "did you mean `xplanes train`?"),
    ("model=x seed=1", "did you mean `xplanes train model=x seed=1`?"),
    ("dance", "see `xplanes --help`"),
    ("train resume=WRONG", "The newest runs: outputs/new, outputs/old"),
)
"""What is typed after ``xplanes``, and a part of the answer."""


def test_nothing_is_suggested_where_nothing_is_near():
    with pytest.raises(ConfigError, match="qqqqqqqq") as caught:
        compose_plain("train", ["qqqqqqqq=1"])
    assert "Did you mean" not in str(caught.value)


@pytest.mark.parametrize(("typed", "answer"), ANSWERS)
def test_what_is_mistyped_is_answered_with_what_was_meant(
    typed, answer, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["xplanes", *typed.split(" ")])
    for age, name in enumerate(("new", "old")):
        record = tmp_path / "outputs" / name / "overrides.txt"
        record.parent.mkdir(parents=True)
        record.touch()
        os.utime(record, (9 - age, 9 - age))
    try:
        code = main()
    except SystemExit as end:
        code = end.code
    error = capsys.readouterr().err + str(code)
    assert code
    assert answer in error
    assert "usage:" not in error
    assert len(list(tmp_path.iterdir())) == 1


def test_no_command_is_answered_with_the_commands(capsys):
    assert main([]) == 0
    assert "usage: xplanes" in capsys.readouterr().out


COMMANDS = {
    ("--help",): "Hydra's own options",
    ("hydra/help=default", "--help"): "Configuration groups",
    ("--hydra-help",): "--experimental-rerun",
    ("--cfg", "job", "--package", "model"): "plane_set: six",
    ("--config-name=pretrain_lrm", "--cfg", "job"): "muon_lr",
    ("--info", "defaults"): "callbacks/default",
    ("-sc", "install=bash"): "hydra_bash_completion",
    ("model=nine_planes", "lrm=xlarge", "--cfg=job"): "openlrm-large-1.1",
    # Refused, as the last line of Hydra's error.
    ("data.resolutoin=3",): "Did you mean data.resolution?\n",
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


def test_command_lines_without_a_job_are_hydras_and_load_nothing_heavy(tmp_path):
    before = "import xplanes.config, xplanes.launch; xplanes.config.compose_plain('train', [])"
    found = forked(before, [QUICK.format(list(given)) for given in COMMANDS], tmp_path)
    for (code, printed), (arguments, words) in zip(found, COMMANDS.items(), strict=True):
        refused = words.startswith("Did you mean")
        assert printed.endswith(words) if refused else words in printed, (arguments, printed)
        assert code == int(refused), (arguments, printed)


def test_a_run_of_an_earlier_version_is_refused_with_its_version(tmp_path):
    (tmp_path / "overrides.txt").write_text("loss.every=4\n")
    (tmp_path / "run.json").write_text(json.dumps({"xplanes": "0.1.0", "status": "interrupted"}))
    with pytest.raises(ConfigError, match=r"made by xplanes 0\.1\.0.*start a new run"):
        prepare([f"resume={tmp_path}"])


def test_a_run_that_failed_before_its_first_checkpoint_blocks_nothing(
    scenes, tmp_path, monkeypatch
):
    config = small_config(scenes, "trainer.max_steps=1", NO_CURVE)
    monkeypatch.setattr(RadianceModule, "training_step", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run(config, tmp_path / "run", [], resume=False)
    assert status(tmp_path / "run")["status"] == "failed"
    monkeypatch.undo()
    run(config, tmp_path / "run", [], resume=False)
    assert status(tmp_path / "run")["status"] == "finished"


REFUSED = (
    (("data=dnerf", "data.scene=nothing"), "nothing.*data=demo"),
    (("data.views=999",), r"data\.views=999(?!.*delete)"),  # The scene itself is in order.
    (("lrm=large", "lrm.weights=nowhere.ckpt"), r"lrm\.weights=nowhere\.ckpt"),
    (("lrm=file", "lrm.triplanes=nowhere.pt"), r"nowhere\.pt"),
    (("lrm=small",), ""),
)
"""Settings that are refused when the data or the weights are looked for, and words of that."""


@pytest.mark.parametrize(("changes", "words"), REFUSED, ids=str)
def test_a_refused_run_leaves_no_directory(changes, words, scenes, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(scenes))
    place, own = f"hydra.run.dir={tmp_path}/outputs/run", [f"data.root={scenes}", *SMALL]
    own = [text for text in own if not {text.split("=")[0]} & {c.split("=")[0] for c in changes}]
    if changes[0].startswith("data="):
        own = [text for text in own if not text.startswith("data.") or "root" in text]
    done = inside.train(*own, *changes, place, cwd=tmp_path, code=1)
    assert re.match(f"error: .*{words}", done.stderr, re.DOTALL), done.stderr
    assert not list(tmp_path.iterdir())


def test_a_refused_run_changes_no_folder(scenes, tmp_path):
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(SceneError, match=r"data\.views=999"):
        run(small_config(scenes, "data.views=999"), tmp_path, [], resume=False)
    assert (tmp_path / "mine.txt").read_text() == "keep"
    with pytest.raises(ConfigError, match="max_seconds=-1"):
        run(small_config(scenes, "trainer.max_seconds=-1"), tmp_path / "new", [], resume=False)
    assert not (tmp_path / "new").exists()


def events_of(run: Path) -> EventAccumulator:
    """What a run has written for TensorBoard."""
    events = EventAccumulator(str(run / "tb"))
    events.Reload()
    return events


def test_tensorboard_drops_what_a_run_that_was_cut_off_has_left(tmp_path, monkeypatch):
    for added, steps in ((0.0, (10, 20, 30)), (100.0, (30, 40))):
        log = TensorBoardLogger(str(tmp_path), name="", version="tb")
        if added:
            forget_later(SimpleNamespace(loggers=[log]), 20)
        for step in steps:
            log.log_metrics({"loss": added + step}, step)
        log.experiment.close()
        # Event files are read in the order of the seconds in their names.
        monkeypatch.setattr(time, "time", lambda now=time.time: now() + 2)
    found = [(event.step, event.value) for event in events_of(tmp_path).Scalars("loss")]
    assert found == [(10, 10.0), (20, 20.0), (30, 130.0), (40, 140.0)]


@pytest.mark.parametrize(
    ("extra", "step"),
    [
        (["+trainer.fast_dev_run=true"], 1),
        (
            [
                *("trainer.profiler=simple", "trainer.enable_progress_bar=false", "logger=none"),
                "callbacks.progress=null",
                "+callbacks.mine._target_=lightning.pytorch.callbacks.Timer",
            ],
            3,
        ),
    ],
)
def test_arguments_of_lightnings_trainer_and_its_callbacks_work(extra, step, scenes, tmp_path):
    short = (f"data.root={scenes}", "callbacks.evaluation.at=[1]", "trainer.max_steps=3")
    run(compose_plain("train", [*SMALL, *short, *extra]), tmp_path / "run", [], resume=False)
    assert metrics(tmp_path / "run")["step"] == step


def test_the_estimate_counts_every_image_as_the_field_is_when_it_is_drawn(scenes, tmp_path):
    changes = ("media=true", "trainer.max_steps=170", "callbacks.evaluation.at=[0,0.5]")
    experiment = Experiment.read(small_config(scenes, *changes))
    assert prepare_run(experiment, tmp_path).experiment is experiment
    data = SceneDataModule(experiment.data, seed=0)
    data.setup("fit")
    module = RadianceModule(experiment.method)
    module.build(data.scene)
    expected = Estimate(0.5, first_ray=5.0, later_ray=1.0, pruned_at=1000, early=0.25, passing=0.0)
    assert [expected.ray(step) for step in (0, 85, 170, 999, 1000)] == [5, 3, 2, 2, 1]
    assert expected._replace(passing=0.5).ray(1000) == 3
    validated, tested, video = 2 * 32**2, 3 * 32**2, FRAMES * 64**2
    images = validated * (5 + 3 + 2) + 2 * (tested + video)
    said = estimated(experiment, data, module, expected, 7.0)
    parts = f"7 s so far, 85 s of training, {images} s of scores and images"
    total, advice = said.split("\n")
    assert total == f"{7 + 85 + images} s in all: {parts}"
    assert "media=false" in advice
    # Without a limit on steps and seconds, the field before the first step is still known.
    endless = replace(experiment, trainer={**experiment.trainer, "max_steps": -1})
    images = validated * (5 + 1 + 1) + tested + video
    found = estimated(endless, data, module, expected, 7.0)
    assert found == f"7 s so far, no end of training, {images} s of scores and images"
    images = validated * (5 + 3 + 2) + 2 * (tested + video)
    # Random values are not scored before the first step if there are surroundings.
    begun = SimpleNamespace(frame=module.frame, site=replace(module.site, surrounded=True))
    later = estimated(experiment, data, begun, expected, 7.0)  # pyright: ignore
    assert later.startswith(f"{7 + 85 + images - 5 * validated} s in all")
    # After a resume, neither steps nor evaluations are counted again.
    images -= validated * (5 + 3)
    rest = f"{7 + 35 + images} s in all: 7 s so far, 35 s of training, {images} s of scores and"
    assert estimated(experiment, data, module, expected, 7.0, 100, 50.0).startswith(rest)


def test_a_run_says_at_its_ends_what_it_takes_and_what_comes_next(scenes, tmp_path, capsys):
    changes = ("logger=tensorboard", "trainer.max_steps=6", "trainer.log_every_n_steps=2")
    run(small_config(scenes, *changes, "data.eval_split=val"), tmp_path, [], resume=False)
    printed = capsys.readouterr().out
    line = next(line for line in printed.splitlines() if line.startswith("estimate"))
    assert re.fullmatch(
        r"estimate +\d+ s in all: \d+ s so far, \d+ s of training, \d+ s of scores and images", line
    )
    assert "GB" not in line  # Fragments of the heap, which nothing foretells, are half of it.
    assert printed.index("estimate") < printed.index("step 6/6")
    last = printed.split("step 6/6")[1]
    content = metrics(tmp_path)
    peak, spent = content["peak_memory_bytes"], content["seconds"]
    assert 0 < content["cpu_share"] < os.cpu_count() + 1
    assert f"{spent['total']:.1f} s in all" in last
    named = {"load": "reading the scene", "evaluate": "scoring", "other": "start, checkpoints and"}
    for name, words in named.items():
        assert (words in last.split("time  ")[1]) == (spent[name] >= 1), name
    assert f"memory   {peak / 2**30:.1f} GB" in last
    assert "tensorboard --logdir" in last
    assert f"xplanes render {tmp_path}" in last
    events = events_of(tmp_path)
    scalars = {
        tag: [point.step for point in events.Scalars(tag)] for tag in events.Tags()["scalars"]
    }
    assert {"val/psnr", "time/train_s", "train/loss"} <= set(scalars)
    for tag, steps in scalars.items():
        assert len(set(steps)) == len(steps), tag
    parts = events.summary_metadata
    assert {"_hparams_/experiment", "_hparams_/session_start_info"} <= set(parts)


def test_a_run_that_keeps_nothing_tells_of_a_busy_machine_and_offers_nothing(
    scenes, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(bar, "PIPED_SECONDS", 0.0)
    monkeypatch.setattr(report, "training_share", lambda trainer: 0.31)
    config = small_config(scenes, "trainer.max_steps=2", "logger=none")
    config["callbacks"]["checkpoints"] = None
    run(config, tmp_path / "run", [], resume=False)
    shown = capsys.readouterr().out
    assert "scoring: 1 of 2 views" in shown
    assert "scoring: 3 of 3 views" in shown
    assert "warning  training got 0.3 s of CPU time per second: other programs" in shown
    for words in ("last.ckpt", "resume=", "xplanes render", "tensorboard"):
        assert words not in shown


def test_a_launcher_that_is_not_installed_names_its_extra(monkeypatch):
    monkeypatch.setattr(config_module, "LAUNCHERS", ("absent",))
    assert "[sweep]" in near_names(["hydra/launcher=absent"])
    assert "[sweep]" not in near_names(["hydra/launcher=basci"])
