"""Statistics of training steps: summed on the device, and read by the host at intervals."""

import math
from collections.abc import Mapping
from typing import Any

import torch
from lightning import Trainer
from torch import Tensor

from xplanes.rendering.base import Rendering
from xplanes.scenes.batches import Batch

EVERY = 32
"""Batches between two reads of the sums; fewer at the beginning."""


def due(batches: int) -> bool:
    """Whether sums are read after this number of batches: 1, 2, 4, 8, 16, then every `EVERY`."""
    return batches % EVERY == 0 or (batches & (batches - 1)) == 0


class Meters:
    """Sums of numbers on the device; adding does not make the host wait."""

    def __init__(self) -> None:
        self._sums: dict[tuple[str, ...], Tensor] = {}
        self._known: dict[str, float] = {}

    def add(self, values: Mapping[str, Tensor | float]) -> None:
        """Add the numbers of a batch: floats, or tensors without dimensions.

        All calls must use the same names and types.
        """
        by_type: dict[torch.dtype, dict[str, Tensor]] = {}
        for name, value in values.items():
            if isinstance(value, Tensor):
                by_type.setdefault(value.dtype, {})[name] = value.detach()
            else:
                self._known[name] = self._known.get(name, 0.0) + value
        for dtype, some in by_type.items():
            new, names = torch.stack(list(some.values())), tuple(some)
            if names in self._sums:
                self._sums[names].add_(new)
            else:
                self._sums[names] = new.double() if dtype.is_floating_point else new

    def read(self) -> dict[str, float]:
        """The sums since the last read; waits for the device."""
        found = self._known
        for names, total in self._sums.items():
            found = found | dict(zip(names, total.tolist(), strict=True))
        self._sums, self._known = {}, {}
        return found


COUNTS = ("rays", "candidates", "empty", "occluded", "samples", "no_room")
"""Counts of a run: rays, candidate samples in the bounding box, candidates skipped as empty or
occluded, remaining samples, and rays left out on a GPU because their samples did not fit."""


class Tally:
    """Counts of a run, and the loss and opacities of its last batches.

    Attributes:
        counts: Counts since the start of the run, by the names in `COUNTS`.
        last: Loss and PSNR of the last batches, mean opacities, and the last scores of views.
        done: Number of updates that were not skipped.
        skipped: Number of updates that were skipped.
        skipped_in_a_row: Number of skipped updates since the last one that was not.
        opacities: Mean opacities of a recent batch, on its device.
    """

    def __init__(self) -> None:
        self.counts: dict[str, int] = dict.fromkeys(COUNTS, 0)
        self.last: dict[str, float] = {}
        self.done = self.skipped = self.skipped_in_a_row = 0
        self.opacities: dict[str, Tensor] = {}
        self._batches, self._updates = Meters(), Meters()

    def add_batch(self, values: Mapping[str, Tensor | float]) -> None:
        """Add a batch: ``batches``, ``all_rays``, ``loss``, ``error`` and the counts."""
        self._batches.add(values)

    def add_update(self, broken: Tensor) -> None:
        """Add an update; ``broken`` is 1 if it was skipped. []"""
        self._updates.add({"updates": 1, "skipped": broken})
        if broken.device.type == "cpu":
            self._read_updates()

    def read(self, trainer: Trainer) -> tuple[int, int] | None:
        """Read the sums since the last read, over all processes.

        Args:
            trainer: The Trainer of these processes.

        Returns:
            Number of rays and of samples; None if there was no batch.
        """
        self._read_updates()
        if not (found := self._batches.read()):
            return None
        found = _of_all(found, trainer)
        batches, rays = int(found["batches"]), int(found["rays"])
        error = max(found["error"] / batches, 1e-10)
        self.last |= {"loss": found["loss"] / batches, "psnr": -10 * math.log10(error)}
        self.last |= {name: float(value) for name, value in self.opacities.items()}
        for name in COUNTS:
            if name in found:
                self.counts[name] += int(found[name])
        self.counts["no_room"] += int(found["all_rays"]) - rays
        return rays, int(found["samples"])

    def _read_updates(self) -> None:
        if found := self._updates.read():
            skipped = int(found["skipped"])
            self.skipped += skipped
            self.done += int(found["updates"]) - skipped
            all_of_them = skipped == int(found["updates"])
            self.skipped_in_a_row = self.skipped_in_a_row + skipped if all_of_them else 0

    def state_dict(self) -> dict[str, Any]:
        """Counts and last values."""
        return {
            "counts": dict(self.counts),
            "done": self.done,
            "skipped": self.skipped,
            "last": dict(self.last),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore counts and last values."""
        self.counts = dict.fromkeys(COUNTS, 0) | state["counts"]
        self.done, self.skipped = state["done"], state["skipped"]
        self.last = dict(state["last"])


def _of_all(values: dict[str, float], trainer: Trainer) -> dict[str, float]:
    """Sums over all processes, so that all of them continue with the same numbers."""
    if trainer.world_size == 1:
        return values
    device = trainer.strategy.root_device
    own = torch.tensor(list(values.values()), dtype=torch.float64, device=device)
    total = torch.as_tensor(trainer.strategy.reduce(own, reduce_op="sum"))
    return dict(zip(values, total.tolist(), strict=True))


def batch_values(rendering: Rendering, rays: Batch, loss: Tensor) -> dict[str, Tensor | float]:
    """Numbers of a batch for `Tally.add_batch`."""
    count, samples = len(rays["times"]), rendering.samples
    shown = rendering.shown
    values = {name: getattr(samples, name) for name in ("candidates", "empty", "occluded")}
    values |= {"samples": samples.count, "batches": 1, "all_rays": count, "loss": loss}
    values["rays"] = count if shown is None else shown.sum()
    error = (rendering.colour - rays["target"]).square().mean(dim=1)
    error = error * rays.get("weight", 1)
    values["error"] = masked_mean(error, shown)
    return values


def mean_opacities(rendering: Rendering, rays: Batch) -> dict[str, Tensor]:
    """Mean opacity of foreground rays and of background rays; NaN if there are none.

    Pixels of foreground rays are opaque and differ in colour from the background; those of
    background rays are transparent. Rays that were left out do not count.
    """
    opacity = rendering.opacity.detach()
    far = (rays["target"] - rays["background"]).abs().amax(dim=-1) > 0.2
    which = {"foreground": far & (rays["alpha"] > 0.5), "background": rays["alpha"] == 0}
    if opacity.device.type == "cpu":
        return {name: opacity[chosen].mean() for name, chosen in which.items()}
    shown = rendering.shown
    both = which if shown is None else {name: some & shown for name, some in which.items()}
    return {name: masked_mean(opacity, some) for name, some in both.items()}


def masked_mean(values: Tensor, mask: Tensor | None) -> Tensor:
    """Mean over a mask, without indexing; NaN if it is empty. [N], bool [N] -> []"""
    return values.mean() if mask is None else (values * mask).sum() / mask.sum()
