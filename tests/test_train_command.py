"""`python train.py` as a user types it."""

import errno
import itertools
import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from hydra_plugins.xplanes import file_name
from tests import inside
from tests.training.runs import (
    NO_CURVE,
    SMALL,
    after_each_batch,
    checkpoint,
    metrics,
    same_state,
    status,
)
from tests.warm import ROOT, python, wait_for
from xplanes import SceneDataModule, launch
from xplanes import run as whole_run
from xplanes.components import build
from xplanes.config import CONF, compose_plain, quoted, unquoted, with_names
from xplanes.errors import ConfigError
from xplanes.files import StorageError
from xplanes.launch import SettingsCheck, prepare
from xplanes.locks import alone_in, if_free, in_turn
from xplanes.process import resume_command
from xplanes.readers.colmap import ColmapSettings

SHORT = (*(text for text in SMALL if "max_steps" not in text), NO_CURVE)
"""Settings of a small run without its number of steps."""


def with_hydra(*overrides: str) -> DictConfig:
    """What the overrides compose to, Hydra's own settings included."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("train", list(overrides), return_hydra_config=True)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("model.rays.per_batch=0", "model.rays.per_batch=0: must "),
        ("trainer.max_seconds=-1", "trainer.max_seconds=-1: must be above 0"),
        ("trainer.accelerator=tpu", "=tpu: must be one of auto, cpu, gpu"),
        ("trainer.max_steps=1e3", "=1000.0: must be one of -1 or a whole number"),
        ("trainer.accumulate_grad_batches=0", "=0: must be above 0"),
        ("callbacks.evaluation.at=[2]", ""),
        ("data.scene=excavatr", "excavat"),
        ("+trainer.foo=1", "=1: Trainer has no such argument"),
        ("+logger.tensorboard.foo=1", "=1: TensorBoardLogger has no such argument"),
        ("logger.tensorboard._target_=os.system", "=os.system: "),
        ("model.name=${no.such}", ""),
    ],
)
def test_settings_are_checked_before_the_run_directory_is_made(
    override, words, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as caught:
        SettingsCheck().on_run_start(with_hydra(override))
    said = str(caught.value)
    assert said.startswith("error: ")
    assert override.removeprefix("+").split("=")[0] in said
    assert words in said
    assert "\n" not in said
    assert not list(tmp_path.iterdir())


def test_devices_in_a_sweep_are_refused(tmp_path):
    result = inside.train("-m", "trainer=ddp", "seed=0,1", f"hydra.sweep.dir={tmp_path}", code=1)
    assert "one device per job" in (result.stdout + result.stderr)


def test_sweeps_are_resumed_job_by_job():
    for sweep in (["-m", "sweep=fair"], ["-m"], ["--multirun"], ["hydra.mode=MULTIRUN"]):
        with pytest.raises(ConfigError, match="one run at a time"):
            prepare([*sweep, "resume=somewhere"])
    for single in (["experiment=published"], ["seed=1"], ["sweep=fair", "model=kplanes"]):
        with pytest.raises(ConfigError, match="not a run directory"):
            prepare([*single, "resume=somewhere"])


def unfinished(run: Path, *overrides: str) -> None:
    """A run with these overrides that was interrupted."""
    run.mkdir(parents=True, exist_ok=True)
    (run / "run.json").write_text('{"status": "interrupted"}')
    (run / "overrides.txt").write_text("".join(f"{line}\n" for line in overrides))


def test_auto_goes_on_with_the_newest_run_of_the_same_settings(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    own = ["model.resolution=8", "data.scene=a/b"]
    assert prepare([*own, "resume=auto"]) == [*own, "resume=null"]
    run = tmp_path / "outputs" / "today_demo-b_six_planes"
    for written in (["resume=null"], [f"resume={run}"], []):
        unfinished(run, *own, *written)
        found = prepare([*own, "resume=auto"])
        assert found[-1] == f"resume={run.relative_to(tmp_path)}", written
    assert prepare(["model.resolution=9", "resume=auto"])[-1] == "resume=null"
    (run / "run.json").write_text('{"status": "finished"}')
    assert prepare([*own, "resume=auto"])[-1] == "resume=null"


def test_runs_in_folders_of_any_name_are_resumed(tmp_path):
    run = tmp_path / "my scene (1), a=b & c"
    unfinished(run, "seed=3")
    for text in (f"resume={run}", f"resume='{run}'"):
        config = with_hydra(*prepare([text]))
        assert (config.resume, config.hydra.run.dir, config.seed) == (str(run), str(run), 3)
    assert shlex.split(resume_command(run))[-1] == f"resume={run}"


def test_auto_finds_runs_whatever_was_said_to_hydra(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    unfinished(tmp_path / "outputs" / "run", "hydra.searchpath=[file://groups]", "seed=1")
    own = ["seed=1", "hydra.searchpath=[file://groups]", "hydra.output_subdir=null"]
    assert prepare([*own, "resume=auto"])[-1].startswith("resume=outputs")
    assert prepare([own[0], own[2], "resume=auto"])[-1] == "resume=null"


def test_folders_of_groups_are_kept_and_found_again(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own groups").mkdir()
    place = f"hydra.searchpath=['file://{tmp_path}/own groups']"
    for given in (["--config-dir", "own groups"], ["-cd=own groups"], [place]):
        assert prepare([*given, "seed=1"]) == [place, "seed=1"]
    both = prepare(["--config-dir=own groups", "hydra.searchpath=[pkg://mine]"])
    assert both == [place.replace("]", ",pkg://mine]")]
    with pytest.raises(ConfigError, match="--config-dir nowhere: there is no such folder"):
        prepare(["--config-dir", "nowhere"])
    # Hydra looks for a configuration of the user's own before it reads the search path.
    named = ["--config-dir", "own groups", "-cn", "mine", "seed=1"]
    assert prepare(named) == named
    option = prepare(["-m", "--config-dir", "own groups", "seed=1"])
    assert option == [place, "seed=1", "-m"]
    unfinished(tmp_path / "outputs" / "run", place, "seed=1")
    found = prepare(["--run", "--config-dir", "own groups", "seed=1", "resume=auto"])
    assert found[-2:] == [f"resume={Path('outputs/run')}", "--run"]
    assert found.count(place) == 1


@pytest.mark.parametrize(
    ("typed", "given"),
    [
        ("lrm=none -m seed=0,1", "lrm=none seed=0,1 -m"),
        ("lrm=none seed=0,1 -m", "lrm=none seed=0,1 -m"),
        ("seed=1 --cfg job lrm=none --package=model", "seed=1 lrm=none --cfg job --package=model"),
        ("-m data.scene=001,lego,1_0", "-m data.scene='001',lego,'1_0'"),
        *(
            (same, same)
            for same in (
                "",
                "seed=0 model=nine_planes model.resolution=32",
                "-m model=six_planes,nine_planes model.resolution=32,64",
                "data=dnerf data.root=/tmp/a.b data.scene=lego",
                "data=demo data.train_views=3",
                "hydra.run.dir=/tmp/x hydra/launcher=joblib +extra=1 ++extra.more=2 ~resume",
                "callbacks.evaluation.at=[0,1]",
                "data.scene=lego data.scene='1' seed=1_0 data.scene=a,b data.scene=choice(a,b)",
                "data.masks=null data.root=${oc.env:HOME}",
            )
        ),
    ],
)
def test_good_command_lines_pass_but_for_the_order_of_options_and_names_of_digits(typed, given):
    assert prepare(typed.split()) == given.split()


def test_values_with_spaces_pass_unchanged():
    assert prepare(["model.decoder={width: 32}"]) == ["model.decoder={width: 32}"]


def test_a_group_that_a_run_left_out_can_be_set_again(tmp_path):
    unfinished(tmp_path, "~logger", "~callbacks.viewer", "seed=1")
    for new in (["logger=csv", "callbacks.viewer.port=1"], ["~callbacks.viewer", "~logger"]):
        assert prepare([f"resume={tmp_path}", *new])[:3] == ["seed=1", *new]
    assert prepare([f"resume={tmp_path}"])[:3] == ["~logger", "~callbacks.viewer", "seed=1"]


def test_a_resumed_run_may_change_or_leave_out_what_it_added(tmp_path):
    added = ("+losses.a._target_=tests.plugins.Dark", "+losses.a.weight=0.1", "++seed=3")
    unfinished(tmp_path, *added)
    new = ["losses.a.weight=0.2", "seed=4", "trainer.max_steps=9"]
    found = prepare([f"resume={tmp_path}", *new])
    assert found[:4] == [added[0], "+losses.a.weight=0.2", "++seed=4", "trainer.max_steps=9"]
    new = ["~losses.a", "--cfg", "job", "--package", "model"]
    found = prepare([f"resume={tmp_path}", *new])
    assert found[:4] == [*added, new[0]]
    assert found[-4:] == new[1:]


@pytest.mark.parametrize("option", [["--help"], ["--cfg", "job"], ["--cfg=job"], ["-i"]])
def test_options_that_only_show_something_need_no_folder_to_write(tmp_path, monkeypatch, option):
    refuse = Mock(side_effect=StorageError("cannot be written"))
    monkeypatch.setattr(launch, "require_writable", refuse)
    assert prepare(option) == option
    with pytest.raises(StorageError):
        prepare(["seed=1"])


def test_a_sweep_does_not_take_other_jobs_for_its_own(tmp_path):
    unfinished(tmp_path, "model.plane_lr=0.002", "trainer.max_steps=9")
    for same in (
        ["model.plane_lr=0.002", "resume=auto"],
        ["trainer.max_steps=99", "model.plane_lr=0.002", "+callbacks.x.y=1"],
    ):
        launch._require_same_job(tmp_path, same)
    for other in (["model.plane_lr=0.4"], ["model.plane_lr=0.002", "seed=1"], []):
        with pytest.raises(ConfigError, match=r"plane_lr=0\.002.*another hydra\.sweep\.dir"):
            launch._require_same_job(tmp_path, other)


def test_what_hydra_knows_may_stand_in_settings_and_piped_output_is_plain(scenes, tmp_path):
    (tmp_path / "link").symlink_to(scenes)
    run = tmp_path / "run"
    result = inside.train(
        *(*SHORT, "trainer.max_steps=5", "data.root=${hydra:runtime.cwd}/link"),
        "+callbacks.keep._target_=lightning.pytorch.callbacks.ModelCheckpoint",
        "+callbacks.keep.dirpath=${hydra:runtime.output_dir}/mine",
        f"hydra.run.dir={run}",
        cwd=tmp_path,
    )
    assert not re.search("[\x1b\r]", result.stdout)
    tail = result.stdout.split("step 5/5")[-1]
    for words in ("psnr", "ssim", str(run)):
        assert words in tail


def test_a_group_set_to_null_is_answered_with_its_choices():
    for group, choice in (("logger", "none"), ("lrm", "tiny"), ("callbacks", "default")):
        with pytest.raises(ConfigError, match=rf"{group}=null: must be one of .*{choice}"):
            prepare([f"{group}=null"])


def test_a_run_goes_on_from_another_directory(scenes, tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    (tmp_path / "a" / "scenes").symlink_to(scenes)
    run = tmp_path / "a" / "run"
    given = (*SHORT, "data.root=scenes", "trainer.max_steps=2", f"hydra.run.dir={run}")
    inside.train(*given, "callbacks.evaluation=null", cwd=tmp_path / "a")
    inside.train(f"resume={run}", "trainer.max_steps=4", cwd=tmp_path / "b")
    assert metrics(run)["step"] == 4
    assert not list((tmp_path / "b").iterdir())


def test_a_job_in_its_own_folder_finds_the_scene_of_the_command(scenes, tmp_path):
    (tmp_path / "scenes").symlink_to(scenes)
    run = tmp_path / "run"
    given = (*SHORT, "data.root=scenes", "trainer.max_steps=2", "callbacks.evaluation=null")
    place = ("hydra.job.chdir=true", f"hydra.run.dir={run}")
    said = inside.train(*given, *place, cwd=tmp_path).stdout
    assert not (run / "scenes").exists()
    assert "metrics.json  checkpoints/last.ckpt" in said
    record = (run / ".hydra" / "overrides.yaml").read_bytes()
    refused = inside.train(*given, *place, "seed=1", cwd=tmp_path, code=1)
    assert "already holds a run (finished)" in refused.stderr
    assert (run / ".hydra" / "overrides.yaml").read_bytes() == record


def test_a_stopped_sweep_says_how_the_whole_of_it_goes_on(tmp_path, monkeypatch, capsys):
    chosen = ["hydra.mode=MULTIRUN", f"hydra.sweep.dir={tmp_path}", "hydra.job.num=0"]
    config = with_hydra(*chosen, f"hydra.runtime.output_dir={tmp_path}", "hydra.job.id=0")

    monkeypatch.setattr(whole_run, "run", Mock(side_effect=KeyboardInterrupt))
    monkeypatch.setattr(HydraConfig.instance(), "cfg", OmegaConf.masked_copy(config, ["hydra"]))
    config = OmegaConf.masked_copy(config, [name for name in config if name != "hydra"])
    with pytest.raises(SystemExit, match="130"):
        launch._job(config)
    assert f"hydra.sweep.dir={tmp_path} resume=auto" in capsys.readouterr().out


def test_run_directories_have_names_that_need_no_quotes():
    scene, name = "/data/people/my scene (1)", "my-scene-1"
    names = {scene: name, **{same: same for same in ("lego", "..", "café", "null", ".5")}}
    assert {given: file_name(given) for given in names} == names
    config = with_hydra(f"data.scene={quoted(scene)}", "hydra.job.num=3")
    assert config.hydra.run.dir.endswith(f"demo-{name}_six_planes_auto_s0")
    assert config.hydra.sweep.subdir == f"3_{name}_six_planes_auto_s0"


def test_names_of_scenes_may_look_like_numbers():
    for name in ("2024_05_01", "1e3", "007"):
        config = with_hydra(*prepare([f"data.scene={name}", f"data.root={name}"]))
        assert (config.data.scene, config.data.root) == (name, name)


HARD = (
    *("/home/josé/x", "take (1)", "a=b", "it's", 'say "x"', "a,b", "50%", "[1] chair", "{x}"),
    *("'a' b", "a#b", "a\\\\b", "ends\\\\", "$x", "True"),
)
"""Names that a file system allows and a grammar may not."""


@pytest.mark.parametrize("name", HARD)
def test_any_path_can_be_given(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given = prepare([f"{key}={name}" for key in ("data.root", "data.cache", "hydra.run.dir")])
    given.append(with_names(f"resume={name}"))
    parse = OverridesParser.create().parse_override
    assert [parse(text).value() for text in given] == [name] * 4
    assert unquoted(quoted(name)) == name


def test_quotes_keep_any_text():
    for length in range(1, 4):
        for text in map("".join, itertools.product("\\\\'\"a ", repeat=length)):
            assert unquoted(quoted(text)) == text


def test_home_is_expanded(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    assert with_names("data.root=~/my captures") == f"data.root='{tmp_path}/my captures'"
    assert with_names("resume=~nobody-has-this-name") == "resume='~nobody-has-this-name'"
    assert with_names("resume=~/runs/a") == f"resume={tmp_path}/runs/a"
    assert with_names("data.scene=~/a,~/b", several=True) == f"data.scene={tmp_path}/a,{tmp_path}/b"
    quoted_already = '''data.scene='a, b',"c, d"'''
    assert with_names(f"{quoted_already},e f", several=True) == f"{quoted_already},'e f'"
    odd = [quoted(name) for name in ("o'b, c", "it's")]
    assert with_names(f"run={','.join(odd)}", several=True) == f"run={','.join(odd)}"
    assert with_names("run=a,it's,c", several=True) == f"run=a,{odd[1]},c"
    data = SceneDataModule.compose("data=blender", "data.root='~/a'", "data.scene=b")
    assert data.settings.folder == tmp_path / "a" / "b"
    plain = compose_plain("train", ["data=colmap"])["data"]
    plain |= {"root": "~", "scene": "~/a b", "masks": "~/m", "times": "~/t.csv"}
    settings = build(plain, ColmapSettings, "data")
    assert settings.folder == tmp_path / "a b"
    assert (settings.masks, settings.times) == (f"{tmp_path}/m", f"{tmp_path}/t.csv")


EACH_RANK = """
import sys
import torch
sys.path.insert(0, {root!r})
from lightning import Trainer
from xplanes.training.module import RadianceModule
def keep(module):
    torch.save(module.state_dict(), {folder!r} + f"/rank{{module.global_rank}}.pt")
RadianceModule.on_fit_end = keep
save = Trainer.save_checkpoint
def save_apart(trainer, path, *given):
    save(trainer, path, *given)
    if trainer.global_step == 13:
        save(trainer, {folder!r} + "/13.ckpt")
Trainer.save_checkpoint = save_apart
# The second process starts with sys.argv[0], so that must stay this file.
exec(compile(open({train!r}).read(), {train!r}, "exec"), globals())
"""


@pytest.mark.slow
def test_two_processes_share_the_rays_and_end_with_one_model(tmp_path):
    root = f"data.root={tmp_path / 'scenes'}"  # Of videos that are as long as usual.
    run, script = tmp_path / "run", tmp_path / "each_rank.py"
    places = {"root": str(ROOT), "train": str(ROOT / "train.py"), "folder": str(tmp_path)}
    script.write_text(EACH_RANK.format(**places))
    # Between updates each process's grid sees its own samples.
    settings = [root, *SMALL, "trainer=ddp", "trainer.max_steps=20", f"hydra.run.dir={run}"]
    settings += ["callbacks.checkpoints.every=13", "trainer.deterministic=true"]
    settings.append("data.val_views=1")  # Fewer than processes.
    python(str(script), *settings)
    state = checkpoint(run)
    assert state["global_step"] == 20
    first, second = (torch.load(tmp_path / f"rank{n}.pt", weights_only=True) for n in range(2))
    assert len(first) > 6
    assert "grid.occupied" in first
    same_state(first, second)
    same_state(first, state["state_dict"])
    found = metrics(run)
    rays = state["progress"]["counts"]["rays"]
    assert rays > 20 * 256  # Those of both.
    assert found["rays_per_second"] == pytest.approx(rays / found["seconds"]["train"])
    # From a step at which the grid is not updated, and before which it has met other samples.
    (tmp_path / "13.ckpt").replace(run / "checkpoints" / "last.ckpt")
    python(str(script), f"resume={run}")
    assert checkpoint(run)["global_step"] == 20
    same_state(first, checkpoint(run)["state_dict"])


@pytest.mark.slow
def test_two_processes_stop_together_and_resume(tmp_path):
    root = f"data.root={tmp_path / 'scenes'}"  # Of videos that are as long as usual.
    run, program = tmp_path / "run", str(ROOT / "train.py")
    last = run / "checkpoints" / "last.ckpt"
    command = [sys.executable, program, root, *SMALL, "trainer=ddp", f"hydra.run.dir={run}"]
    command += ["trainer.max_steps=100000", "callbacks.checkpoints.every=20"]
    silent: dict = dict.fromkeys(("stdout", "stderr"), subprocess.DEVNULL)
    environment = {**os.environ, "OMP_WAIT_POLICY": "PASSIVE"}
    process = subprocess.Popen(command, cwd=ROOT, env=environment, **silent)
    try:
        wait_for(last, process)
        before = last.stat().st_mtime_ns
        process.send_signal(signal.SIGINT)  # to the first alone
        process.wait(60)
    finally:
        process.kill()
    assert last.stat().st_mtime_ns > before
    step = checkpoint(run)["global_step"]
    assert status(run)["status"] == "interrupted"
    python(program, f"resume={run}", f"trainer.max_steps={step + 5}")
    assert checkpoint(run)["global_step"] == step + 5


def test_a_run_is_alone_in_its_folder_and_ctrl_c_saves_it(scenes, tmp_path, monkeypatch):
    run = tmp_path / "run"

    def look_and_stop(_, trainer, __) -> None:
        if trainer.global_step == 3:
            with pytest.raises(ConfigError, match=f"in use by process {os.getpid()}: wait"):
                alone_in(run).__enter__()
            signal.raise_signal(signal.SIGINT)

    after_each_batch(monkeypatch, look_and_stop)
    given = (f"data.root={scenes}", *SMALL, NO_CURVE, f"hydra.run.dir={run}")
    inside.train(*given, code=130)
    assert status(run)["status"] == "interrupted"
    assert checkpoint(run)["global_step"] == 3
    with alone_in(run):
        assert (run / ".lock").is_file()


def test_a_turn_holds_its_lock(tmp_path):
    path = tmp_path / "a.lock"
    with in_turn(path), if_free(path) as free:
        assert not free
    with in_turn(None), if_free(path) as free:
        assert free


def test_files_that_cannot_be_locked_stop_nothing(tmp_path, caplog, monkeypatch):
    refused = OSError(errno.ENOLCK, "No locks available")
    monkeypatch.setattr("filelock.FileLock.acquire", Mock(side_effect=refused))
    path = tmp_path / "a.lock"
    with in_turn(path), if_free(path) as free:
        assert not free
    assert "a.lock cannot be locked" in caplog.text


@pytest.mark.slow
def test_a_resumed_run_finds_groups_of_the_users_own_again(scenes, tmp_path):
    conf, run = tmp_path / "conf", tmp_path / "run"
    (conf / "model").mkdir(parents=True)
    (conf / "model" / "own.yaml").write_text("defaults: [six_planes]\nname: own\n")
    path = f"hydra.searchpath=[file://{conf}]"
    own = (path, "model=own", f"data.root={scenes}", f"hydra.run.dir={run}")
    inside.train(*own, *SHORT, "trainer.max_steps=2")
    again = prepare([f"resume={run}", "trainer.max_steps=3"])
    assert again[0] == path
    moved = "hydra.searchpath=[file:///elsewhere]"
    assert again[0] not in prepare([f"resume={run}", moved])
    inside.train(f"resume={run}", "trainer.max_steps=3")
    assert metrics(run)["step"] == 3
    assert path in (run / "overrides.txt").read_text().splitlines()


@pytest.mark.slow
def test_a_field_renders_the_scene_inside_a_job(scenes, tmp_path):
    # That field's own settings are composed while Hydra's job is under way.
    folder = tmp_path / "run"
    result = inside.train(
        *(f"data.root={scenes}", *(text for text in SHORT if text != "lrm=none"), "lrm=tiny"),
        *("preparation.cache=null", "preparation.fixed_view=train"),
        *("preparation.fixed_view_steps=2", "preparation.frames=3", "trainer.max_steps=2"),
        f"hydra.run.dir={folder}",
    )
    assert "training six_planes for" in result.stdout
    assert (folder / "metrics.json").is_file()
