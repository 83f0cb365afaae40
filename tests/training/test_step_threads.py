"""The number of threads that a step is done with."""

from collections.abc import Callable
from types import SimpleNamespace

import pytest
import torch

from tests.training.runs import small_config
from xplanes.files import read_json
from xplanes.pipeline import run
from xplanes.training.step_threads import StepThreads, ThreadChoice


def drive(choice: ThreadChoice, cost: Callable[[int, float], float], until: float) -> list[int]:
    """The numbers that steps were done with, each taking ``cost(number, seconds so far)``."""
    clock, used = 0.0, []
    while clock < until:
        used.append(choice.next())
        seconds = cost(used[-1], clock)
        choice.took(seconds)
        clock += seconds
    return used


def test_it_tries_all_threads_and_halves_of_them():
    for most, numbers in ((2, [1, 2]), (6, [1, 3, 6]), (16, [1, 2, 4, 8, 16])):
        choice = ThreadChoice(most)
        assert choice.numbers == numbers
        assert set(drive(choice, lambda n, _: 0.02, until=3)) == set(numbers), most


def test_it_stays_with_the_fastest_and_spends_little_on_the_others():
    for best in (1, 2, 4, 8):
        choice = ThreadChoice(8)
        cost = {n: 0.02 if n == best else 0.03 for n in choice.numbers}
        used = drive(choice, lambda n, _, cost=cost: cost[n], until=60)
        assert choice.count == best
        assert used.count(best) > 0.95 * len(used), best


def test_it_follows_a_load_that_comes_and_goes():
    choice = ThreadChoice(2)

    def cost(number: int, seconds: float) -> float:
        busy = 20 < seconds < 70
        return {1: 0.03, 2: 0.1 if busy else 0.02}[number]

    assert drive(choice, cost, until=20)[-1] == 2
    assert drive(choice, lambda n, s: cost(n, s + 20), until=40)[-1] == 1
    assert drive(choice, lambda n, s: cost(n, s + 70), until=40)[-1] == 2


def test_what_is_not_clearly_faster_changes_nothing():
    choice = ThreadChoice(4)
    drive(choice, lambda n, _: 0.02 if n == 4 else 0.0195, until=30)
    assert choice.count == 4


def test_long_steps_are_tried_once():
    choice = ThreadChoice(4)
    used = drive(choice, lambda n, _: 3.0 / n, until=50)
    assert (used.count(1), used.count(2)) == (1, 1)


def test_what_is_far_slower_costs_little_time():
    choice, cost = ThreadChoice(2), {1: 0.03, 2: 0.09}
    used = drive(choice, lambda n, _: cost[n], until=60)
    assert choice.count == 1
    assert sum(cost[n] for n in used if n == 2) < 0.04 * 60


def test_a_few_slow_steps_do_not_change_the_choice():
    choice = ThreadChoice(2)
    calls = iter(range(10**6))
    drive(choice, lambda n, _: (0.5 if next(calls) % 9 == 0 else 0) + 0.02 * n, until=20)
    assert choice.count == 1


def choice_on(device: str = "cpu", processes: int = 1) -> ThreadChoice | None:
    callback = StepThreads()
    callback.on_train_start(
        SimpleNamespace(world_size=processes),  # type: ignore[arg-type]
        SimpleNamespace(device=torch.device(device)),  # type: ignore[arg-type]
    )
    return callback.choice


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_gpus_and_other_processes_leave_no_choice(two_threads):
    assert choice_on() is not None
    assert choice_on(device="cuda") is None
    assert choice_on(processes=2) is None


def test_one_thread_leaves_no_choice(two_threads):
    torch.set_num_threads(1)
    assert choice_on() is None


def test_a_run_chooses_only_where_that_is_asked_for(tmp_path):
    """Its sums would come out differently each time."""
    assert "threads" not in small_config(tmp_path)["callbacks"]
    assert "threads" in small_config(tmp_path, "callbacks=threads")["callbacks"]


def test_a_run_reports_its_number_and_leaves_torchs_alone(scenes, tmp_path, two_threads):
    config = small_config(
        scenes, "callbacks=threads", "trainer.max_seconds=1.5", "trainer.max_steps=100000"
    )
    run(config, tmp_path / "run", [], resume=False)
    assert torch.get_num_threads() == 2
    metrics, log = read_json(tmp_path / "run" / "metrics.json"), (tmp_path / "run" / "train.log")
    assert metrics["threads"] in (1, 2)
    if metrics["threads"] == 1:  # It began with two.
        assert "threads: 1 from here on" in log.read_text()


def test_a_run_that_fails_leaves_torchs_number_alone(scenes, tmp_path, two_threads, monkeypatch):
    def fail(self: ThreadChoice, seconds: float) -> bool:
        torch.set_num_threads(1)
        raise RuntimeError("no luck")

    monkeypatch.setattr(ThreadChoice, "took", fail)
    config = small_config(scenes, "callbacks=threads", "trainer.max_seconds=5")
    with pytest.raises(RuntimeError, match="no luck"):
        run(config, tmp_path / "run", [], resume=False)
    assert torch.get_num_threads() == 2
