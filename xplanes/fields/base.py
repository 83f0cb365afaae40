"""Base classes of fields: what renderers and training require of them."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from xplanes.scenes.frame import Frame

Writer = Callable[[Path, float, Frame], Path]
"""Writes a field at one time to a file: takes a path without suffix, the time from 0 to 1 and the
field's frame, and returns the path of the file."""


class Representation(nn.Module, ABC):
    """Base class of trainable representations of a dynamic scene, such as radiance fields.

    A representation covers the cube [-1, 1]^3 of its frame. Subclasses override the properties
    below if the defaults do not apply. Parameters and submodules must not use these names.

    Raises:
        AttributeError: If a submodule is assigned to the name of a property.
    """

    @property
    def planes(self) -> Mapping[str, Tensor]:
        """Feature planes, or slices of a feature grid, for display. [C, rows, columns] each"""
        return {}

    @property
    def moves(self) -> bool:
        """Whether the field depends on time."""
        return True

    @property
    def precision(self) -> str:
        """Precision of its matrix products: "32" (float32) or "bf16" (bfloat16)."""
        return "32"

    @property
    def outline(self) -> str:
        """Short description for reports, such as the number of channels."""
        return type(self).__name__

    @property
    def exports(self) -> Mapping[str, Writer]:
        """Additional file formats by name, for `xplanes export --what NAME`."""
        return {}

    def cloud(self, time: float) -> tuple[Tensor, Tensor] | None:
        """Points that represent a field without a density, the most visible first.

        Args:
            time: From 0 to 1.

        Returns:
            Points in the field's frame [N, 3] and their colours from 0 to 1 [N, 3], or None.
        """
        return None

    def masked(self, keep: Callable[[Tensor], Tensor]) -> Any:
        """The field with some regions emptied, for its renderer.

        Args:
            keep: Maps points [N, 3] in the field's frame to whether they are kept. bool [N]
        """
        return Masked(self, keep)

    def __setattr__(self, name: str, value: Any) -> None:
        # torch would accept the submodule, but the property would hide it.
        if isinstance(value, nn.Module) and isinstance(getattr(type(self), name, None), property):
            raise AttributeError(f"{type(self).__name__}.{name} is a property; rename the part")
        super().__setattr__(name, value)


class RadianceField(Representation):
    """Maps points and times, and optionally viewing directions, to colour and density.

    Subclasses define ``forward(points, times)``, or ``forward(points, times, directions)`` if
    view-dependent. It takes positions in the field's frame [N, 3], times from 0 to 1 [N] and unit
    directions [N, 3]. It returns colour [N, 3] and density per unit length of the frame [N].

    Attributes:
        view_dependent: Whether ``forward`` takes directions as its third argument.
    """

    view_dependent = False

    def snapshot(self, time: float) -> "RadianceField":
        """The field at one time, for rendering; the field itself if that would not be faster.

        Args:
            time: From 0 to 1.

        Returns:
            A field that takes the same arguments and ignores the times, without gradients.
        """
        return self


class ViewDependentField(RadianceField):
    """A field in two stages, so that samples can be dropped before their colour is computed."""

    view_dependent = True

    @abstractmethod
    def geometry(self, points: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
        """Density and the features that colour depends on. [N, 3], [N] -> [N], [N, F]"""

    @abstractmethod
    def colour(self, features: Tensor, directions: Tensor) -> Tensor:
        """Colour seen along unit directions. [N, F], [N, 3] -> [N, 3]"""

    def forward(
        self, points: Tensor, times: Tensor, directions: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Colour and density of points at times.

        Args:
            points: Positions in the field's frame. [N, 3]
            times: Times from 0 to 1. [N]
            directions: Unit viewing directions in the field's frame; the negative third axis when
                None, for callers that need only the density. [N, 3]

        Returns:
            Colour from 0 to 1 and density per unit length of the field's frame. [N, 3], [N]
        """
        density, features = self.geometry(points, times)
        if directions is None:
            directions = points.new_tensor([0.0, 0.0, -1.0]).expand_as(points)
        return self.colour(features, directions), density


class SurfaceField(RadianceField):
    """A field with a signed distance, zero on the surface, in place of a density."""

    @abstractmethod
    def signed_distance(self, points: Tensor, times: Tensor) -> Tensor:
        """Distance to the surface, negative inside. [N, 3], [N] -> [N]"""

    @abstractmethod
    def surface_colour(self, points: Tensor, times: Tensor, directions: Tensor) -> Tensor:
        """Colour on the surface seen along unit directions. [N, 3], [N], [N, 3] -> [N, 3]"""


class Masked:
    """A field with some regions emptied; everything else is delegated to the field.

    Args:
        field: Any field that a renderer accepts.
        keep: Maps points [N, 3] to whether they are kept. bool [N]
    """

    def __init__(self, field: Any, keep: Callable[[Tensor], Tensor]) -> None:
        self._field, self._keep = field, keep

    def __getattr__(self, name: str) -> Any:
        if name == "_field":  # A copy or a pickle asks before it has one.
            raise AttributeError(name)
        return getattr(self._field, name)

    def __call__(self, points: Tensor, times: Tensor, *directions: Tensor) -> tuple[Tensor, Tensor]:
        """As `RadianceField.forward`."""
        colour, density = self._field(points, times, *directions)
        return colour, density * self._keep(points)

    def geometry(self, points: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
        """As `ViewDependentField.geometry`."""
        density, features = self._field.geometry(points, times)
        return density * self._keep(points), features

    def snapshot(self, time: float) -> Any:
        """As `RadianceField.snapshot`."""
        return self._field.snapshot(time).masked(self._keep)

    def masked(self, keep: Callable[[Tensor], Tensor]) -> Any:
        """As `Representation.masked`."""
        return type(self)(self, keep)
