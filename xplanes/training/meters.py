"""What training steps show: opacities, and sums on a GPU that are read now and then."""

from collections.abc import Mapping

import torch
from torch import Tensor

from xplanes.rendering.base import Rendering
from xplanes.scenes.batches import Batch

EVERY = 32
"""Batches from one look at the sums to the next; at first the gaps are shorter."""


def due(batches: int) -> bool:
    """Whether the sums are read after so many batches: 1, 2, 4, 8, 16, then every `EVERY`."""
    return batches % EVERY == 0 or (batches & (batches - 1)) == 0


class Meters:
    """Sums of numbers that the host does not wait for."""

    def __init__(self) -> None:
        self._sums: dict[tuple[str, ...], Tensor] = {}
        self._known: dict[str, float] = {}

    def add(self, values: Mapping[str, Tensor | float]) -> None:
        """Add what a batch shows: numbers or tensors without axes.

        Each time the same names, and tensors of the same types.
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
        """The sums since they were read last; waits for the device."""
        found = self._known
        for names, total in self._sums.items():
            found = found | dict(zip(names, total.tolist(), strict=True))
        self._sums, self._known = {}, {}
        return found


def mean_opacities(rendering: Rendering, rays: Batch) -> dict[str, Tensor]:
    """Mean opacity of rays that must show something, and of those that must not; NaN for none.

    The former are opaque and of another colour than the background; the latter are transparent.
    Rays that were left out do not count.
    """
    opacity = rendering.opacity.detach()
    far = (rays["target"] - rays["background"]).abs().amax(dim=-1) > 0.2
    which = {"foreground": far & (rays["alpha"] > 0.5), "background": rays["alpha"] == 0}
    if opacity.device.type == "cpu":
        return {name: opacity[chosen].mean() for name, chosen in which.items()}
    shown: Tensor | None = getattr(rendering.samples, "shown", None)
    both = which if shown is None else {name: some & shown for name, some in which.items()}
    return {name: masked_mean(opacity, some) for name, some in both.items()}


def masked_mean(values: Tensor, mask: Tensor | None) -> Tensor:
    """Mean of some values, without a list of which; NaN for none. [N], bool [N] -> []"""
    return values.mean() if mask is None else (values * mask).sum() / mask.sum()
