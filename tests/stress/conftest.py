"""Counting of cases, for the tables that benchmarks/ writes."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

from xplanes.backend import threads
from xplanes.errors import ConfigError, SceneError
from xplanes.lrm import LRMError
from xplanes.training.diagnosis import TrainingError


class Tally:
    """What became of the cases of one test; the test's docstring names the kind of stress."""

    def __init__(self, kind: str) -> None:
        counts = {"cases": 0, "finite": 0, "diagnosed": 0, "error": None}
        self.content: dict[str, Any] = {"kind": kind.strip().rstrip("."), **counts}

    def finite(self, *tensors: Tensor | float | None) -> None:
        """Count a case, all of whose tensors must be finite."""
        self.content["cases"] += 1
        for tensor in tensors:
            if tensor is not None:
                assert torch.as_tensor(tensor).isfinite().all(), tensor
        self.content["finite"] += 1

    def diagnosed(self, message: str, name: str) -> None:
        """Count a case that was refused; the message must hold the name of the culprit."""
        self.content["cases"] += 1
        assert name in message
        self.content["diagnosed"] += 1

    def error(self, value: float, most: float) -> None:
        """Note an error, which must be ``most`` at most."""
        assert value <= most, f"error {value:.2g}, allowed {most:.2g}"
        self.content["error"] = max(self.content["error"] or 0.0, value)

    def trained(self, train: Callable[[], dict[str, Tensor]]) -> dict[str, Tensor] | None:
        """Count a training: finite to the end, or stopped by words that name a way out.

        Args:
            train: Gives all parameters and buffers.

        Returns:
            What it gave; None where training was stopped.
        """
        try:
            state = train()
        except LRMError as problem:
            words, what, ways_out = str(problem), "empty", ("lrm.crop=false",)
        except (TrainingError, ConfigError, SceneError) as problem:
            words, what = str(problem), "finite"
            ways_out = ("resume=", "must be", "set lrm=none")
        else:
            self.finite(*(value for value in state.values() if value.is_floating_point()))
            return state
        self.content["cases"] += 1
        assert what in words
        assert any(way_out in words for way_out in ways_out)
        self.content["diagnosed"] += 1
        return None


@pytest.fixture
def tally(request: pytest.FixtureRequest) -> Tally:
    """The counts of the requesting test."""
    counts = Tally(request.function.__doc__)
    request.node.user_properties.append(("tally", counts.content))
    return counts


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """One thread, so that the suite takes one core; tests of threads set their own."""
    with threads(1):
        yield
