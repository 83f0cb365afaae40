"""K-Planes: products of planes, decoded by MLPs (hybrid) or linearly (explicit)."""

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from xplanes.baselines.networks import PaddedMLP, spherical_harmonics, truncated_exponential
from xplanes.baselines.products import PlaneProducts
from xplanes.fields.background import RADIUS
from xplanes.fields.base import ViewDependentField

GEOMETRY = 15
"""Number of features that the density network passes to the colour network."""


def contract_cube(points: Tensor) -> Tensor:
    """Contract all of space to the cube [-2, 2]^3; the cube [-1, 1]^3 is unchanged.

    Like `xplanes.fields.background.contract`, with the maximum norm instead of the Euclidean one.

    Args:
        points: Positions in the field's frame, finite. [..., 3]

    Returns:
        [..., 3]

    Source: K-Planes, released code; Mip-NeRF 360, Eq. 10.
    """
    largest = points.abs().amax(dim=-1, keepdim=True).clamp_min(1)
    return (RADIUS - 1 / largest) * (points / largest)


class HybridDecoder(nn.Module):
    """Two MLPs: one for density, one for colour from its features and the direction's harmonics.

    Args:
        features: Columns of the input.
        width: Neurons of the hidden layers, one for density and two for colour.
        precision: Precision of the matrix products.

    Source: K-Planes, hybrid decoder.
    """

    def __init__(self, features: int, width: int = 64, *, precision: str = "32") -> None:
        super().__init__()
        self.density = PaddedMLP([features, width, GEOMETRY + 1], precision=precision)
        self.tint = PaddedMLP([16 + GEOMETRY, width, width, 3], precision=precision)

    def geometry(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Density logit, and features for the colour. [N, F] -> [N], [N, 15]"""
        out = self.density(features)
        return out[:, GEOMETRY], out[:, :GEOMETRY]

    def colour(self, geometry: Tensor, directions: Tensor) -> Tensor:
        """[N, 15], [N, 3] -> [N, 3]"""
        return self.tint(torch.cat([spherical_harmonics(directions), geometry], dim=1)).sigmoid()


class ExplicitDecoder(nn.Module):
    """Density is linear in the features, and so is colour, with a learned basis per direction.

    Args:
        features: Columns of the input.
        width: Neurons of the hidden layers of the network from direction to colour basis.
        precision: Precision of the matrix products.

    Source: K-Planes, explicit decoder.
    """

    HIDDEN = 4

    def __init__(self, features: int, width: int = 128, *, precision: str = "32") -> None:
        super().__init__()
        self.density = PaddedMLP([features, 1], precision=precision)
        self.basis = PaddedMLP([3, *[width] * self.HIDDEN, 3 * features], precision=precision)

    def geometry(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Density logit, and the features. [N, F] -> [N], [N, F]"""
        return self.density(features)[:, 0], features

    def colour(self, geometry: Tensor, directions: Tensor) -> Tensor:
        """[N, F], [N, 3] -> [N, 3]"""
        basis = self.basis(directions).view(len(directions), 3, -1)
        return (basis * geometry[:, None]).sum(dim=-1).sigmoid()


class KPlanes(ViewDependentField):
    """A dynamic radiance field of products of planes.

    Unlike X-Planes it is not empty outside its cube: planes are extrapolated from their borders.

    Args:
        products: The planes.
        decoder: Decoder from their features to density and colour.
        unit: World units per unit of the field's frame; the decoder's density is per world unit.
        contracted: Whether the planes cover all of space, contracted, instead of the cube.

    Source: K-Planes, Section 3.
    """

    def __init__(
        self,
        products: PlaneProducts,
        decoder: HybridDecoder | ExplicitDecoder,
        unit: float = 1.0,
        *,
        contracted: bool = False,
    ) -> None:
        super().__init__()
        self.products, self.decoder, self.unit = products, decoder, unit
        self.contracted = contracted

    @property
    def planes(self) -> Mapping[str, Tensor]:
        return self.products.finest

    @property
    def moves(self) -> bool:
        return "xt" in self.products.names

    @property
    def precision(self) -> str:
        return self.decoder.density.precision

    @property
    def outline(self) -> str:
        planes = self.products.planes()
        sizes = "/".join(str(plane.shape[3]) for name, plane in planes if name == "xy")
        space = " over contracted space" if self.contracted else ""
        names = " ".join(self.products.names)
        return f"({names}, {sizes}{space}) · {self.products.channels} channels"

    def geometry(self, points: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
        if self.contracted:
            points = contract_cube(points) / RADIUS
        logit, features = self.decoder.geometry(self.products(points, times))
        return truncated_exponential(logit - 1) * self.unit, features

    def colour(self, features: Tensor, directions: Tensor) -> Tensor:
        return self.decoder.colour(features, directions)


class DensityField(nn.Module):
    """A small density field that proposes samples for a larger field.

    Args:
        products: The planes.
        width: Neurons of the hidden layer.
        linear: Whether there is no activation between the layers.
        unit: World units per unit of the field's frame.
        precision: Precision of the matrix products.
        contracted: See `KPlanes`.

    Source: K-Planes, released code; Mip-NeRF 360, Section 3.
    """

    def __init__(
        self,
        products: PlaneProducts,
        width: int = 64,
        *,
        linear: bool = False,
        unit: float = 1.0,
        precision: str = "32",
        contracted: bool = False,
    ) -> None:
        super().__init__()
        self.products, self.unit, self.contracted = products, unit, contracted
        self.network = PaddedMLP(
            [products.features, width, 1], activation=not linear, precision=precision
        )

    def forward(self, points: Tensor, times: Tensor) -> Tensor:
        """Density per unit length of the field's frame. [N, 3], [N] -> [N]"""
        if self.contracted:
            points = contract_cube(points) / RADIUS
        logit = self.network(self.products(points, times))[:, 0]
        return truncated_exponential(logit - 1) * self.unit
