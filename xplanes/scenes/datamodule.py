"""The scene as a LightningDataModule."""

from collections.abc import Callable, Iterator
from typing import Any

from lightning import LightningDataModule
from torch.utils.data import DataLoader, IterableDataset

from xplanes.scenes.batches import Batch, RayBatches
from xplanes.scenes.frame import Frame
from xplanes.scenes.views import Scene


class _Endless(IterableDataset):
    """Batches from a step onwards, for ever."""

    def __init__(self, batches: RayBatches, first: int) -> None:
        self.batches, self.first = batches, first

    def __iter__(self) -> Iterator[Batch]:
        step = self.first
        while True:
            yield self.batches.draw(step)
            step += 1


class RayDataModule(LightningDataModule):
    """Serves the training rays of a scene.

    Lightning does not restore the place of an endless data set, so the batch counter is part of
    this module's state and a resumed run draws the very rays of an uninterrupted one.

    Args:
        scene: Images and cameras.
        frame: The field's frame.
        batches: From the rank of a process to its batches.
    """

    def __init__(self, scene: Scene, frame: Frame, batches: Callable[[int], RayBatches]) -> None:
        super().__init__()
        self.scene, self.frame = scene, frame
        self._build = batches
        self._built: dict[int, RayBatches] = {}
        self._first = 0

    def batches(self, rank: int) -> RayBatches:
        """The batches of a process."""
        if rank not in self._built:
            self._built[rank] = self._build(rank)
        return self._built[rank]

    def train_dataloader(self) -> DataLoader:
        rank = self.trainer.global_rank if self.trainer else 0
        return DataLoader(_Endless(self.batches(rank), self._first), batch_size=None)

    def state_dict(self) -> dict[str, Any]:
        assert self.trainer is not None
        return {"batches": self.trainer.lightning_module.batches}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._first = state_dict["batches"]
