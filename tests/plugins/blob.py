"""A model of one's own: a moving ball of colour."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from xplanes.fields.base import RadianceField
from xplanes.models.base import InitialValues, Model, ModelSettings
from xplanes.rendering.sampler import Group, Site
from xplanes.settings import Positive


class BlobField(RadianceField):
    """Density falls with the distance from a centre that moves along a line."""

    precision, outline = "32", "one blob"

    def __init__(self, width: float, moves: bool) -> None:
        super().__init__()
        self.centre, self.velocity = nn.Parameter(torch.zeros(3)), nn.Parameter(torch.zeros(3))
        self.tint, self.width, self._moves = nn.Parameter(torch.zeros(3)), width, moves

    @property
    def planes(self) -> Mapping[str, Tensor]:
        return {"tint": self.tint.detach()[:, None, None].expand(3, 2, 2)}

    @property
    def moves(self) -> bool:
        return self._moves

    def forward(self, points: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
        centre = self.centre + (times[:, None] - 0.5) * self.velocity
        distance = (points - centre).square().sum(dim=1) / self.width**2
        return self.tint.sigmoid().expand_as(points), 20 * torch.exp(-distance)


@dataclass(frozen=True, kw_only=True)
class BlobSettings(ModelSettings):
    """A ball of colour that moves along a line."""

    width: Positive
    learning_rate: Positive

    def build(self, site: Site, initial: InitialValues | None = None) -> "BlobModel":
        return BlobModel(self, BlobField(self.width, site.moves))


class BlobModel(Model):
    """The colour's error alone."""

    def __init__(self, settings: BlobSettings, field: BlobField) -> None:
        self._field, self.settings = field, settings
        self.advice = f"Lower model.learning_rate={settings.learning_rate}"

    @property
    def field(self) -> BlobField:
        return self._field

    def groups(self) -> list[Group]:
        rate = self.settings.learning_rate
        return [{"params": list(self._field.parameters()), "lr": rate, "name": "blob"}]

    def rate_factor(self, step: int, progress: float) -> float:
        return 1 - progress
