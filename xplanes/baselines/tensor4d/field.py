"""Tensor4D: a surface in canonical space with a flow that maps points there, or a density."""

import math
from collections.abc import Callable, Mapping

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils.parametrizations import weight_norm

from xplanes.baselines.networks import octaves
from xplanes.baselines.tensor4d.hierarchy import Compression, HierarchicalPlanes
from xplanes.fields.base import Masked, SurfaceField, ViewDependentField

HIDDEN = 3
"""Hidden layers of all networks."""

OUTSIDE = 1.0
"""Signed distance of masked points: far outside of the surface."""

DENSITY_SCALE, DENSITY_START = 25.0, -3.0
"""Scale and offset of the density of `Tensor4DDensity`, a softplus of the logit as in X-Planes."""


class SkipNetwork(nn.Module):
    """MLP in which features and the input are concatenated after the first hidden layer.

    Args:
        inputs: Columns of the input; the first three are a position.
        features: Columns of the features.
        width: Neurons of the hidden layers.
        outputs: Columns of the output.
        radius: The first output is initialised to the distance from a sphere of this radius
            around the origin; None for a random initialisation.

    Source: Tensor4D, released code; NeuS; IGR (initialisation).
    """

    def __init__(
        self, inputs: int, features: int, width: int, outputs: int, radius: float | None = None
    ) -> None:
        super().__init__()
        self.inputs = inputs
        columns = [inputs, width + features + inputs, width, width]
        rows = [width] * HIDDEN + [outputs]
        layers = [nn.Linear(c, r) for c, r in zip(columns, rows, strict=True)]
        if radius is not None:
            _start_as_sphere(layers, inputs, radius)
        self.layers = nn.ModuleList(weight_norm(layer) for layer in layers)

    def forward(self, values: Tensor, features: Tensor) -> Tensor:
        """[N, inputs], [N, features] -> [N, outputs]"""
        hidden = F.softplus(self.layers[0](values), beta=100)
        hidden = torch.cat([hidden, features, values], dim=1) / math.sqrt(2)
        for layer in self.layers[1:-1]:
            hidden = F.softplus(layer(hidden), beta=100)
        return self.layers[-1](hidden)


@torch.no_grad()
def _start_as_sphere(layers: list[nn.Linear], inputs: int, radius: float) -> None:
    for layer in layers[:-1]:
        nn.init.normal_(layer.weight, 0, math.sqrt(2 / layer.out_features))
        nn.init.zeros_(layer.bias)
    # Encodings would distort the sphere.
    layers[0].weight[:, 3:] = 0
    layers[1].weight[:, layers[1].in_features - (inputs - 3) :] = 0
    last = layers[-1]
    nn.init.normal_(last.weight, math.sqrt(math.pi / last.in_features), 1e-4)
    nn.init.constant_(last.bias, -radius)


def _colour_network(inputs: int, width: int) -> nn.Sequential:
    sizes = [inputs, *[width] * HIDDEN]
    found: list[nn.Module] = []
    for columns, rows in zip(sizes, sizes[1:], strict=False):
        found += [weight_norm(nn.Linear(columns, rows)), nn.ReLU()]
    return nn.Sequential(*found, weight_norm(nn.Linear(width, 3)), nn.Sigmoid())


class Tensor4D(SurfaceField):
    """Signed distance and colour in canonical space, and the flow from each time to it.

    Args:
        planes: Planes of the canonical space.
        flow_planes: Planes of the flow; None for a static scene.
        width: Neurons of the hidden layers.
        octaves: Frequencies of the encodings of positions, times and directions.
        radius: Radius of the initial sphere.
        sharpness: Sets the initial width of the surface, exp(-10 * sharpness).

    Source: Tensor4D, released code.
    """

    COMPRESSED = 32
    """Columns of each group of the flow's planes after compression."""

    def __init__(
        self,
        planes: HierarchicalPlanes,
        flow_planes: HierarchicalPlanes | None,
        width: int = 256,
        *,
        octaves: tuple[int, int, int] = (8, 6, 3),
        radius: float = 0.5,
        sharpness: float = 0.3,
    ) -> None:
        super().__init__()
        self.octaves = octaves
        points, times, directions = 3 + 6 * octaves[0], 1 + 2 * octaves[1], 3 + 6 * octaves[2]
        self.canonical_planes, self.flow_planes = planes, flow_planes
        features = len(planes.groups) * planes.width
        self.surface = SkipNetwork(points, features, width, 1 + width, radius)
        self.compression = self.flow = None
        if flow_planes is not None:
            groups = len(flow_planes.groups)
            self.compression = Compression(groups, flow_planes.width, self.COMPRESSED)
            self.flow = SkipNetwork(points + times, groups * self.COMPRESSED, width, 3)
        self.tint = _colour_network(3 + directions + 3 + width, width)
        self.steepness = nn.Parameter(torch.tensor(sharpness))

    @property
    def planes(self) -> Mapping[str, Tensor]:
        return self.canonical_planes.pictures()

    @property
    def moves(self) -> bool:
        return self.flow is not None

    @property
    def outline(self) -> str:
        sizes = "/".join(str(level.resolution) for level in self.canonical_planes.levels)
        return f"(surface and flow, planes of {sizes})"

    @property
    def sharpness(self) -> Tensor:
        """Steepness of the opacity across the surface, per unit of distance. []"""
        return (10 * self.steepness).exp().clamp(1e-6, 1e6)

    def canonical(self, points: Tensor, times: Tensor) -> Tensor:
        """Map points to canonical space, which is that of time 0. [N, 3], [N] -> [N, 3]"""
        if self.flow is None or self.compression is None or self.flow_planes is None:
            return points
        features = self.compression(self.flow_planes(points, times))
        encoded_time = octaves(2 * times[:, None] - 1, self.octaves[1])
        values = torch.cat([octaves(points, self.octaves[0]), encoded_time], dim=1)
        return points + self.flow(values, features) * (times > 0)[:, None]

    def features(self, places: Tensor) -> Tensor:
        """Features of the planes at canonical points. [N, 3] -> [N, F]"""
        return torch.cat(self.canonical_planes(places, torch.zeros_like(places[:, 0])), dim=1)

    def distance(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance, and features for the colour. Canonical [N, 3] -> [N], [N, width]"""
        found = self.surface(octaves(places, self.octaves[0]), self.features(places))
        return found[:, 0], found[:, 1:]

    def distance_and_slope(
        self, points: Tensor, times: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Signed distance and its gradient through the flow; all results are differentiable.

        Args:
            points: Positions. [N, 3]
            times: Times from 0 to 1. [N]

        Returns:
            Distance [N], gradient with respect to the points [N, 3], features for the colour
            [N, width], and the points in canonical space [N, 3].
        """
        trained = torch.is_grad_enabled()
        # Lightning scores in inference mode, whose tensors autograd cannot use.
        with torch.inference_mode(False), torch.enable_grad():
            points, times = points.detach().clone().requires_grad_(), times.clone()
            places = self.canonical(points, times)
            distance, features = self.distance(places)
            (slope,) = torch.autograd.grad(distance.sum(), points, create_graph=trained)
        if not trained:
            return distance.detach(), slope, features.detach(), places.detach()
        return distance, slope, features, places

    def colour(
        self, points: Tensor, slopes: Tensor, features: Tensor, directions: Tensor
    ) -> Tensor:
        """Colour at points of one time. [N, 3], [N, 3], [N, width], [N, 3] -> [N, 3]"""
        seen = octaves(directions, self.octaves[2])
        return self.tint(torch.cat([points, seen, slopes, features], dim=1))

    def signed_distance(self, points: Tensor, times: Tensor) -> Tensor:
        return self.distance(self.canonical(points, times))[0]

    def surface_colour(self, points: Tensor, times: Tensor, directions: Tensor) -> Tensor:
        _, slopes, features, _ = self.distance_and_slope(points, times)
        return self.colour(points, slopes, features, directions)

    def masked(self, keep: Callable[[Tensor], Tensor]) -> "MaskedSurface":
        return MaskedSurface(self, keep)


class MaskedSurface(Masked):
    """A surface from which some regions are removed."""

    def distance_and_slope(self, points: Tensor, times: Tensor) -> tuple[Tensor, ...]:
        """See `Tensor4D.distance_and_slope`."""
        distance, *others = self._field.distance_and_slope(points, times)
        return torch.where(self._keep(points), distance, OUTSIDE), *others


class Tensor4DDensity(ViewDependentField):
    """The nine planes of Tensor4D and its networks, with a density instead of the surface.

    This is not the published model: it has no surface, no normals and no flow.

    Args:
        planes: Nine planes, or three for a static scene.
        width: Neurons of the hidden layers.
        octaves: Frequencies of the encodings of positions, times and directions.

    Source: Tensor4D, released code.
    """

    COMPRESSED = 48
    """Columns of each group of planes after compression."""

    def __init__(
        self,
        planes: HierarchicalPlanes,
        width: int = 256,
        *,
        octaves: tuple[int, int, int] = (8, 6, 3),
    ) -> None:
        super().__init__()
        self.octaves, self.field_planes = octaves, planes
        points, times, directions = 3 + 6 * octaves[0], 1 + 2 * octaves[1], 3 + 6 * octaves[2]
        groups = len(planes.groups)
        self.compression = Compression(groups, planes.width, self.COMPRESSED)
        inputs = points + times if self.moves else points
        self.trunk = SkipNetwork(inputs, groups * self.COMPRESSED, width, 1 + width)
        self.tint = _colour_network(directions + width, width)

    @property
    def planes(self) -> Mapping[str, Tensor]:
        return self.field_planes.pictures()

    @property
    def moves(self) -> bool:
        return any("t" in name for group in self.field_planes.groups for name in group)

    @property
    def outline(self) -> str:
        sizes = "/".join(str(level.resolution) for level in self.field_planes.levels)
        return f"({len(self.planes)} planes of {sizes}, density)"

    def geometry(self, points: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
        values = octaves(points, self.octaves[0])
        if self.moves:
            encoded_time = octaves(2 * times[:, None] - 1, self.octaves[1])
            values = torch.cat([values, encoded_time], dim=1)
        found = self.trunk(values, self.compression(self.field_planes(points, times)))
        return DENSITY_SCALE * F.softplus(found[:, 0] + DENSITY_START), found[:, 1:]

    def colour(self, features: Tensor, directions: Tensor) -> Tensor:
        return self.tint(torch.cat([octaves(directions, self.octaves[2]), features], dim=1))
