"""A data format of one's own: images made on the fly of a disc that every camera sees."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from xplanes.scenes.cameras import camera_around
from xplanes.scenes.source import SceneSettings
from xplanes.scenes.views import Scene, Views
from xplanes.settings import Count

FOCAL = 1.4


@dataclass(frozen=True, kw_only=True)
class DiscSettings(SceneSettings):
    """A red disc before cameras on a circle."""

    count: Count

    @classmethod
    def recognises(cls, folder: Path) -> bool:
        return (folder / "discs.txt").is_file()

    def load(self, splits: Sequence[str]) -> Scene:
        return Scene("disc", {name: self._views(index) for index, name in enumerate(splits)})

    def _views(self, offset: int) -> Views:
        side = self.resolution or 16
        axis = (torch.arange(side) + 0.5) / side - 0.5
        inside = axis[:, None].square() + axis.square() < 0.05
        image = torch.zeros(side, side, 4, dtype=torch.uint8)
        image[inside] = torch.tensor([200, 30, 30, 255], dtype=torch.uint8)
        angles = [360 * (i + 0.3 * offset) / self.count for i in range(self.count)]
        poses = [camera_around(angle, 10.0, 4.0).float() for angle in angles]
        return Views(
            image.expand(self.count, side, side, 4).contiguous(),
            torch.stack(poses),
            torch.linspace(0, 1, self.count),
            FOCAL * side,
            tuple(f"disc_{offset}_{i}.png" for i in range(self.count)),
        )
