"""What a run promises: it learns, repeats itself, and goes on where it stopped."""

import csv
import json
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from tests.training.runs import small_config
from xplanes import pipeline
from xplanes.config import ConfigError
from xplanes.pipeline import run
from xplanes.training import scorer, warming
from xplanes.training.clock import TrainingClock
from xplanes.training.module import RadianceModule, TrainingError
from xplanes.training.sampling.occupancy import OccupancySampling


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("scenes")


def metrics(folder: Path) -> dict:
    return json.loads((folder / "metrics.json").read_text())


def status(folder: Path) -> dict:
    return json.loads((folder / "run.json").read_text())


def curve(folder: Path) -> list[dict[str, str]]:
    with (folder / "curve.csv").open() as file:
        return list(csv.DictReader(file))


def exact(folder: Path) -> dict:
    """The numbers that must not depend on the clock."""
    content = metrics(folder)
    kept = ("test", "views", "step", "skipped", "samples_per_ray", "parameters")
    return {name: content[name] for name in kept}


@pytest.fixture(scope="module")
def trained(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "whole"
    run(small_config(scenes), folder, ["seed=0"], resume=False)
    return folder


def test_training_improves_the_scored_views(scenes: Path, tmp_path: Path) -> None:
    config = small_config(scenes, "trainer.max_steps=200", "sampler.sweep_at=[60]")
    run(config, tmp_path / "longer", [], resume=False)
    rows = curve(tmp_path / "longer")
    assert [int(row["step"]) for row in rows] == [0, 100, 200]
    assert float(rows[-1]["psnr"]) > float(rows[0]["psnr"]) + 4


def test_run_directory_holds_what_it_promises(trained: Path) -> None:
    for name in (
        "config.yaml overrides.txt run.json metrics.json curve.csv train.log "
        "checkpoints/last.ckpt checkpoints/best.ckpt media/planes.png"
    ).split():
        assert (trained / name).is_file(), name
    assert list((trained / "tb").glob("events.*"))
    content = metrics(trained)
    assert content["split"] == "test"
    assert len(content["views"]) == 3
    assert "warm_up" in content["seconds"]
    assert set(content["seconds"]["prepare"]) == {"fixed_view", "lrm", "decomposition", "convert"}
    assert set(content["skipped"]) >= {"empty", "occluded", "background"}
    assert all(0 <= share <= 1 for share in content["skipped"].values())
    assert float(curve(trained)[-1]["psnr"]) == pytest.approx(content["test"]["psnr"], abs=1e-4)
    record = status(trained)
    assert record["status"] == "finished"
    assert len(record["files"]["train"]) == 10


def test_score_is_the_mean_of_the_views_scores(trained: Path) -> None:
    content = metrics(trained)
    scores = [view["psnr"] for view in content["views"]]
    assert content["test"]["psnr"] == pytest.approx(sum(scores) / len(scores), abs=1e-9)


def test_same_seed_gives_the_same_numbers(trained: Path, scenes: Path, tmp_path: Path) -> None:
    run(small_config(scenes), tmp_path / "again", [], resume=False)
    assert exact(tmp_path / "again") == exact(trained)


def test_another_seed_gives_other_numbers(trained: Path, scenes: Path, tmp_path: Path) -> None:
    run(small_config(scenes, "seed=1"), tmp_path / "other", [], resume=False)
    assert exact(tmp_path / "other")["test"] != exact(trained)["test"]


@pytest.mark.parametrize("stop", [13, 20, 27])
def test_resumed_run_equals_an_uninterrupted_one(
    trained: Path, scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop: int
) -> None:
    original = TrainingClock.on_train_batch_end

    def break_down(self, trainer, module, *rest) -> None:
        original(self, trainer, module, *rest)
        if trainer.global_step == stop:
            raise OSError("power cut")

    folder = tmp_path / "broken"
    monkeypatch.setattr(TrainingClock, "on_train_batch_end", break_down)
    with pytest.raises(OSError, match="power cut"):
        run(small_config(scenes), folder, [], resume=False)
    assert status(folder)["status"] == "failed"
    monkeypatch.undo()
    run(small_config(scenes), folder, [], resume=True)
    assert status(folder)["status"] == "finished"
    assert exact(folder) == exact(trained)
    # Seconds are the clock's; all else of the curve must agree.
    assert [(r["step"], r["psnr"]) for r in curve(folder)] == [
        (r["step"], r["psnr"]) for r in curve(trained)
    ]


def interrupt_where(
    when: Callable[[RadianceModule], bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Press Ctrl-C at the end of a batch."""
    original = TrainingClock.on_train_batch_end

    def press_ctrl_c(self, trainer, module, *rest) -> None:
        original(self, trainer, module, *rest)
        if when(module):
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(TrainingClock, "on_train_batch_end", press_ctrl_c)


def test_interrupt_saves_the_step_it_stopped_at(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupt_where(lambda module: module.global_step == 17, monkeypatch)
    folder = tmp_path / "stopped"
    with pytest.raises(KeyboardInterrupt):
        run(small_config(scenes), folder, [], resume=False)
    assert status(folder)["status"] == "interrupted"
    state = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    assert state["global_step"] == 17


def test_a_second_interrupt_saves_no_half_of_a_step(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = RadianceModule.manual_backward

    def press_twice(self, loss, *rest, **options) -> None:
        original(self, loss, *rest, **options)
        if self.global_step == 17:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(RadianceModule, "manual_backward", press_twice)
    folder = tmp_path / "stopped"
    with pytest.raises(KeyboardInterrupt):
        run(small_config(scenes), folder, [], resume=False)
    state = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    assert (state["global_step"], state["progress"]["batches"]) == (10, 10)


def test_an_interrupt_waits_for_the_update_of_its_batches(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupt_where(lambda module: module.batches == 7, monkeypatch)
    folder = tmp_path / "stopped"
    with pytest.raises(KeyboardInterrupt):
        run(small_config(scenes, "trainer.accumulate=3"), folder, [], resume=False)
    state = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    assert (state["global_step"], state["progress"]["batches"]) == (3, 9)


def test_an_evaluation_that_was_stopped_is_done_again(
    trained: Path, scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The evaluation at step 20 finds that it was asked to stop.
    interrupt_where(lambda module: module.global_step == 20, monkeypatch)
    folder = tmp_path / "stopped"
    with pytest.raises(KeyboardInterrupt):
        run(small_config(scenes), folder, [], resume=False)
    assert [row["step"] for row in curve(folder)] == ["0"]
    monkeypatch.undo()
    run(small_config(scenes), folder, [], resume=True)
    assert [row["step"] for row in curve(folder)] == ["0", "21", "40"]
    assert exact(folder) == exact(trained)


def test_scoring_uses_the_device_that_trained(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    moves: list[str] = []
    away, back = RadianceModule.cpu, RadianceModule.to
    monkeypatch.setattr(
        RadianceModule, "cpu", lambda self: moves.append("away to the CPU") or away(self)
    )
    monkeypatch.setattr(
        RadianceModule, "to", lambda self, place: moves.append(f"to {place}") or back(self, place)
    )
    finish = scorer.Scorer.finish
    monkeypatch.setattr(
        scorer.Scorer, "finish", lambda self, *rest: moves.append("scored") or finish(self, *rest)
    )
    run(small_config(scenes, "trainer.max_steps=2"), tmp_path / "run", [], resume=False)
    assert moves[-3:] == ["away to the CPU", "to cpu", "scored"]


def test_only_the_pictures_that_are_shown_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import weakref

    made: list[weakref.ref] = []
    original = scorer.score_view

    def watched(*parts):
        score, images = original(*parts)
        made.append(weakref.ref(images.colour))
        return score, images

    monkeypatch.setattr(scorer, "score_view", watched)
    config = small_config(tmp_path / "scenes", "trainer.max_steps=2", "data.test_views=7")
    run(config, tmp_path / "run", [], resume=False)
    assert len(made) == 3 * 7
    assert not any(colour() is not None for colour in made)
    assert len(list((tmp_path / "run" / "media" / "step000002").glob("*.png"))) == scorer.SHOWN


def test_digits_cannot_be_kept_on_a_gpu(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipeline, "training_device", lambda _: torch.device("cuda"))
    with pytest.raises(ConfigError, match=r"trainer\.deterministic=true.*trainer=cpu"):
        run(small_config(scenes, "trainer.deterministic=true"), tmp_path / "run", [], resume=False)


def test_more_gpus_than_there_are_are_refused_at_once(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipeline, "training_device", lambda _: torch.device("cuda"))
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    with pytest.raises(ConfigError, match=r"trainer\.devices=2: 1 GPUs found"):
        run(small_config(scenes, "trainer=ddp"), tmp_path / "run", [], resume=False)


def test_folder_with_a_run_is_refused_without_resume(trained: Path, scenes: Path) -> None:
    before = (trained / "metrics.json").read_bytes()
    with pytest.raises(ConfigError, match="holds a run already"):
        run(small_config(scenes), trained, [], resume=False)
    assert (trained / "metrics.json").read_bytes() == before


def test_checkpoint_holds_only_tensors_and_builtins(trained: Path) -> None:
    state = torch.load(trained / "checkpoints" / "last.ckpt", weights_only=True)
    assert state["progress"]["batches"] == 40


def test_few_shot_run_names_its_views(scenes: Path, tmp_path: Path) -> None:
    config = small_config(scenes, "data.views=3", "trainer.max_steps=2", "trainer.evaluate_at=[]")
    run(config, tmp_path / "few", [], resume=False)
    files = status(tmp_path / "few")["files"]["train"]
    assert len(files) == 3
    assert files[0].endswith("r_000.png")
    assert files[-1].endswith("r_009.png")


def test_accumulated_batches_make_one_step(scenes: Path, tmp_path: Path) -> None:
    config = small_config(
        scenes, "trainer.accumulate=2", "trainer.max_steps=4", "trainer.evaluate_at=[]"
    )
    run(config, tmp_path / "accumulated", [], resume=False)
    state = torch.load(tmp_path / "accumulated" / "checkpoints" / "last.ckpt", weights_only=True)
    assert (state["global_step"], state["progress"]["batches"]) == (4, 8)


def test_non_finite_loss_is_skipped_then_diagnosed(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = RadianceModule.on_train_batch_start

    def spoil(self, batch, batch_idx) -> None:
        original(self, batch, batch_idx)
        if self.global_step == 5:
            with torch.no_grad():
                self.field.space.fill_(float("nan"))

    monkeypatch.setattr(RadianceModule, "on_train_batch_start", spoil)
    folder = tmp_path / "spoiled"
    with pytest.raises(TrainingError, match=r"not finite: field\.space;.*trainer\.plane_lr"):
        run(small_config(scenes), folder, [], resume=False)
    assert status(folder)["status"] == "failed"
    assert "field" not in status(folder)["reason"].split(":")[0]


def test_one_bad_batch_costs_one_step(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from xplanes.scenes.batches import RayBatches

    original = RayBatches.draw

    def spoil(self, step: int):
        batch = original(self, step)
        if step == 3:
            batch["target"][0] = float("nan")
        return batch

    monkeypatch.setattr(RayBatches, "draw", spoil)
    config = small_config(scenes, "trainer.max_steps=6", "trainer.evaluate_at=[]")
    run(config, tmp_path / "one", [], resume=False)
    content = metrics(tmp_path / "one")
    assert (content["steps_skipped"], content["step"]) == (1, 6)


def test_a_bad_batch_takes_those_of_its_update_along(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from xplanes.scenes.batches import RayBatches

    original = RayBatches.draw

    def spoil(self, step: int):
        batch = original(self, step)
        if step == 3:
            batch["target"][0] = float("nan")
        return batch

    left: list[bool] = []
    refuse = RadianceModule._refuse

    def watched(self, *rest) -> None:
        left.append(any(p.grad is not None and bool(p.grad.any()) for p in self.parameters()))
        refuse(self, *rest)

    monkeypatch.setattr(RayBatches, "draw", spoil)
    monkeypatch.setattr(RadianceModule, "_refuse", watched)
    config = small_config(
        scenes, "trainer.accumulate=2", "trainer.max_steps=3", "trainer.evaluate_at=[]"
    )
    run(config, tmp_path / "run", [], resume=False)
    assert left == [False]


def test_scene_of_one_moment_trains_without_planes_of_time(tmp_path: Path) -> None:
    config = small_config(tmp_path / "scenes", "trainer.max_steps=2", "trainer.evaluate_at=[]")
    run(config, tmp_path / "moving", [], resume=False)
    (folder,) = [p for p in (tmp_path / "scenes").iterdir() if p.is_dir()]
    for path in folder.glob("transforms_*.json"):
        content = json.loads(path.read_text())
        for frame in content["frames"]:
            del frame["time"]
        path.write_text(json.dumps(content))
    still = dict(config, data={**config["data"], "name": "dnerf"})
    for name in ("seed", "train_views", "test_views", "val_views"):
        del still["data"][name]
    still["data"].update(scene=folder.name)
    run(still, tmp_path / "still", [], resume=False)
    state = torch.load(tmp_path / "still" / "checkpoints" / "last.ckpt", weights_only=True)
    assert "field.time" not in state["state_dict"]


@pytest.mark.parametrize(
    ("overrides", "moves"),
    [
        (["data.scene=still"], False),
        (["data.scene=still", "data.still=false"], True),
        (["data.scene=balls"], True),
        (["data.scene=balls", "data.still=true"], False),
    ],
)
def test_a_scene_without_motion_has_no_planes_of_time(
    overrides, moves, scenes: Path, tmp_path: Path
) -> None:
    config = small_config(scenes, "trainer.max_steps=2", "trainer.evaluate_at=[]", *overrides)
    run(config, tmp_path / "run", [], resume=False)
    state = torch.load(tmp_path / "run" / "checkpoints" / "last.ckpt", weights_only=True)
    assert ("field.time" in state["state_dict"]) == moves
    assert metrics(tmp_path / "run")["skipped"]["static"] == (0.0 if moves else 1.0)
    text = (tmp_path / "run" / "train.log").read_text()
    if not moves:
        reason = "data.still=true" if "balls" in overrides[0] else "frames are equal"
        assert reason in text
    assert ("trains as a still one" in text) == (not moves)


def test_a_slow_warm_up_says_what_it_does(
    scenes: Path, tmp_path: Path, monkeypatch, capsys
) -> None:
    render = OccupancySampling.render

    def slow(*args):
        time.sleep(0.3)
        return render(*args)

    monkeypatch.setattr(warming, "PATIENCE", 0.05)
    warming.say_why.cache_clear()
    monkeypatch.setattr(OccupancySampling, "render", slow)
    run(small_config(scenes, "trainer.max_steps=1"), tmp_path / "run", [], resume=False)
    assert capsys.readouterr().out.count("compiling the inner loops") == 1
