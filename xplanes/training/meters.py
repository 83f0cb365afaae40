"""What training steps on a GPU show, added up there and read now and then."""

from collections.abc import Mapping

import torch
from torch import Tensor

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
