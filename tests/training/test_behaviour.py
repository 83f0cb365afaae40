"""Runs: outputs, determinism, interruption and resuming."""

import signal
import weakref
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from tests.training.runs import (
    UNSCORED,
    after_each_batch,
    also,
    broken_off,
    checkpoint,
    metrics,
    outcome,
    small_config,
    status,
)
from xplanes.errors import ConfigError
from xplanes.files import read_rows
from xplanes.models.initialisation import STAGES
from xplanes.run import run
from xplanes.scenes import store
from xplanes.scenes.batches import RayBatches
from xplanes.training import evaluation, fit
from xplanes.training.checkpoints import AtomicCheckpointIO
from xplanes.training.diagnosis import not_finite
from xplanes.training.evaluation import Evaluation
from xplanes.training.module import RadianceModule


def curve(folder: Path) -> list[dict[str, str]]:
    return read_rows(folder / "curve.csv")


def steps(folder: Path) -> list[str]:
    """The steps of a run's evaluations."""
    return [row["step"] for row in curve(folder)]


@pytest.fixture(scope="module")
def watched(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """A run on images from disk whose pictures and checkpoints were noted; ten steps an epoch."""
    folder = tmp_path_factory.mktemp("runs") / "watched"
    cache = folder.with_name("cache")
    sizes = ("model.rays.per_batch=1024", "callbacks.checkpoints.every=6", "trainer.max_steps=20")
    config = small_config(scenes, f"data.cache={cache}", *sizes, "callbacks.evaluation.at=[0,0.6]")
    notes = SimpleNamespace(folder=folder, cache=cache, config=config, pictures=[], saved=[])
    score = RadianceModule.validation_step

    def note_picture(self, batch: dict, batch_idx: int) -> dict:
        image = score(self, batch, batch_idx)
        notes.pictures.append(weakref.ref(image["colour"]))
        return image

    def note_checkpoint(_, checkpoint: dict, path: str, **__) -> None:
        notes.saved.append((checkpoint["global_step"], Path(path).name))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store, "IN_MEMORY", 0)
        patch.setattr(RadianceModule, "validation_step", note_picture)
        patch.setattr(evaluation, "SHOWN", 2)
        also(patch, AtomicCheckpointIO, "save_checkpoint", note_checkpoint)
        run(config, folder, [], resume=False)
    return notes


def test_run_directory_holds_what_it_promises(trained_run):
    for name in (
        "config.yaml overrides.txt run.json metrics.json curve.csv train.log "
        "checkpoints/last.ckpt checkpoints/best.ckpt media/planes.png"
    ).split():
        assert (trained_run / name).is_file(), name
    events = EventAccumulator(str(trained_run / "tb"))
    events.Reload()
    scored = [(str(e.step), f"{e.value:.4f}") for e in events.Scalars("val/psnr")]
    assert scored == [(row["step"], row["psnr"]) for row in curve(trained_run)]
    content = metrics(trained_run)
    assert content["split"] == "test"
    scores = [view["psnr"] for view in content["views"]]
    assert len(scores) == 3
    assert content["test"]["psnr"] == pytest.approx(sum(scores) / len(scores), abs=1e-9)
    assert "warm_up" in content["seconds"]
    assert set(content["seconds"]["prepare"]) == set(STAGES)
    assert content["seconds"]["prepare"]["fill"] == 0  # Random initialisation fills nothing.
    assert set(content["skipped"]) >= {"empty", "occluded", "background"}
    assert all(0 <= share <= 1 for share in content["skipped"].values())
    # Validation views on the way, test views at the end.
    assert {row["split"] for row in curve(trained_run)} == {"val"}
    assert [view["file"].split("/")[-2] for view in content["views"]] == ["test"] * 3
    record = status(trained_run)
    assert record["status"] == "finished"
    assert len(record["files"]["train"]) == 10


def test_a_run_resumed_after_failures_equals_an_uninterrupted_one(watched, tmp_path, monkeypatch):
    """It fails in a later epoch, at a checkpoint with an evaluation, and between checkpoints.

    The decoded images are gone and are decoded again.
    """
    monkeypatch.setattr(store, "IN_MEMORY", 0)
    folder, files = tmp_path / "broken", sorted(watched.cache.glob("*.pixels"))
    assert [path.stat().st_size for path in files]
    broken_off((12, 14), watched.config, folder)
    for path in files:
        path.unlink()
    run(watched.config, folder, [], resume=True)
    assert sorted(watched.cache.glob("*.pixels")) == files
    assert outcome(folder) == outcome(watched.folder)


def interrupt_where(
    when: Callable[[RadianceModule], bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Press Ctrl-C at the end of a batch."""

    def press_ctrl_c(_, __, module) -> None:
        if when(module):
            signal.raise_signal(signal.SIGINT)

    after_each_batch(monkeypatch, press_ctrl_c)


def stopped_at(folder: Path) -> tuple[int, int]:
    """Steps and batches that the last checkpoint of a run has done."""
    state = checkpoint(folder)
    return state["global_step"], state["progress"]["batches"]


def test_a_second_interrupt_saves_no_half_of_a_step(train, tmp_path, monkeypatch):
    def press_twice(module) -> None:
        if module.global_step == 5:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)

    also(monkeypatch, RadianceModule, "on_after_backward", press_twice)
    with pytest.raises(KeyboardInterrupt):
        train(*UNSCORED, "callbacks.checkpoints.every=3")
    assert stopped_at(tmp_path / "run") == (3, 3)


def test_an_interrupt_waits_for_the_update_of_its_batches(train, tmp_path, monkeypatch):
    interrupt_where(lambda module: module.batches == 7, monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        train(*UNSCORED, "trainer.accumulate_grad_batches=3")
    assert stopped_at(tmp_path / "run") == (3, 9)


def handlers() -> list:
    return [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]


def test_interrupts_save_the_step_they_stop_at_and_evaluations_are_made_up_for(
    trained_run, train, tmp_path, monkeypatch
):
    """One that is due at step 20, and the final one, though not a step is left to train then."""
    seldom, folder, before = "callbacks.checkpoints.every=1000", tmp_path / "run", handlers()
    with monkeypatch.context() as patch:
        interrupt_where(lambda module: module.global_step == 20, patch)
        with pytest.raises(KeyboardInterrupt):
            train(seldom)
    assert handlers() == before
    assert status(folder)["status"] == "interrupted"
    assert stopped_at(folder)[0] == 20
    assert steps(folder) == ["0"]

    def press(_, trainer, __) -> None:
        if trainer.global_step == 40:
            signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        also(patch, Evaluation, "on_validation_start", press, first=True)
        with pytest.raises(KeyboardInterrupt):
            train(seldom, resume=True)
    assert steps(folder) == ["0", "21"]
    train(seldom, resume=True)
    assert steps(folder) == ["0", "21", "40"]
    assert handlers() == before
    ours, theirs = outcome(folder), outcome(trained_run)
    assert ours.pop("curve")[-1] == theirs.pop("curve")[-1]
    assert ours == theirs


def test_an_evaluation_waits_for_the_update_of_its_batches(train, monkeypatch):
    """It may stop where it is, and the best checkpoint holds no gradients."""
    batches = []

    def go_on(clock, _, module) -> None:
        clock.seconds = 600.0 if module.batches >= 7 else 0.0

    after_each_batch(monkeypatch, go_on)
    note = lambda *given: batches.append(given[-1].batches)  # noqa: E731
    also(monkeypatch, Evaluation, "on_validation_start", note)
    limits = ("trainer.max_seconds=1000", "trainer.max_steps=4")
    train("trainer.accumulate_grad_batches=3", *limits, "callbacks.evaluation.at=[0,0.55]")
    assert batches == [0, 9, 12]


def test_steps_after_the_budget_are_evaluated_at_their_end_alone(scenes, train, monkeypatch):
    def use_up(clock, trainer, _) -> None:
        clock.seconds = 2000.0
        trainer.should_stop = True

    after_each_batch(monkeypatch, use_up)
    limits = ("trainer.max_seconds=1000", "callbacks.evaluation.at=[]")
    least = small_config(scenes, *limits)["trainer"] | {"min_steps": 4, "min_epochs": 0}
    assert steps(train(*limits, trainer=least)) == ["4"]


def test_only_displayed_images_are_kept_in_memory(watched):
    assert len(watched.pictures) == 3 * 2
    assert not any(colour() is not None for colour in watched.pictures)
    written = sorted((watched.folder / "media" / "step000020").glob("*.png"))
    # Named after the images, which lie in a folder of the split's name.
    assert [path.name for path in written] == ["val_r_000.png", "val_r_001.png"]


def test_best_and_last_are_written_at_the_steps_that_say_so(watched):
    assert [step for step, name in watched.saved if name == "best.ckpt"] == [12, 20]
    assert [step for step, name in watched.saved if name == "last.ckpt"] == [6, 12, 18, 20]


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("trainer.deterministic=true", r"trainer\.deterministic=true.*trainer\.accelerator=cpu"),
        ("trainer=ddp", r"trainer\.devices=2: 1 GPUs found"),
    ],
)
def test_what_a_gpu_cannot_is_refused_at_once(train, monkeypatch, override, words):
    monkeypatch.setattr(fit, "find_device", lambda _: torch.device("cuda"))
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    with pytest.raises(ConfigError, match=words):
        train(override)


@pytest.mark.parametrize(
    ("overrides", "reason"),
    [
        (["still_life", "data.static=false"], None),
        (["excavator", "data.static=true"], "data.static=true"),
    ],
)
def test_a_scene_without_motion_has_no_time_planes(train, overrides, reason):
    scene, *rest = overrides
    folder = train("trainer.max_steps=2", *UNSCORED, f"data.scene={scene}", *rest)
    assert ("field.time" in checkpoint(folder)["state_dict"]) == (reason is None)
    assert metrics(folder)["skipped"]["static"] == (0.0 if reason is None else 1.0)
    text = (folder / "train.log").read_text()
    assert ("static, without time planes" in text) == (reason is not None)
    assert reason is None or reason in text


def test_accumulated_batches_of_few_views_make_one_step_and_a_bad_one_takes_all_along(
    train, monkeypatch
):
    original = RayBatches.draw

    def spoil(self, step: int, *rest):
        batch = original(self, step, *rest)
        if step == 3:
            batch["target"][0] = float("nan")
        return batch

    monkeypatch.setattr(RayBatches, "draw", spoil)
    few = ("data.views=3", "trainer.accumulate_grad_batches=2", "trainer.max_steps=3")
    folder = train(*few, *UNSCORED)
    files = status(folder)["files"]["train"]
    assert len(files) == 3
    assert files[0].endswith("r_000.png")
    assert files[-1].endswith("r_009.png")
    content = metrics(folder)
    assert (content["steps_skipped"], content["step"]) == (1, 3)
    assert stopped_at(folder) == (3, 6)
    (optimizer,) = checkpoint(folder)["optimizer_states"]
    assert {float(each["step"]) for each in optimizer["state"].values()} == {2}
    assert not_finite(checkpoint(folder)["state_dict"].items()) == []
