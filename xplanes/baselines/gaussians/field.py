"""Dynamic Gaussians: parameters, and motion by planes, by a network or by polynomials."""

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from xplanes.baselines.gaussians.ply import write_gaussians
from xplanes.baselines.networks import layers, octaves
from xplanes.baselines.products import PlaneProducts
from xplanes.fields.base import Masked, Representation, Writer
from xplanes.streams import Stream, TrainingState

BASE = 0.28209479177387814
"""The spherical harmonic of degree 0."""

NEIGHBOURS = 3
"""Neighbours whose mean squared distance is a Gaussian's initial variance (Kerbl et al. 2023)."""

FIRST_OPACITY = 0.1
"""Initial opacity of Gaussians without known surfaces (Kerbl et al. 2023)."""

ROWS = 1024
"""Points per block in the search for neighbours."""

TIME_FEATURES = 30
"""Number of time features (Yang et al. 2024)."""

LARGEST = 7.0
"""Largest logarithm of a standard deviation: 500 cubes. In scenes with surroundings some grow."""

HEADS = {"shift": 3, "turn": 4, "growth": 3}
"""Columns of the offsets of means, quaternions and scales."""

ORDER = 3
"""Degree of the polynomials of means in time (Li et al. 2024)."""


@dataclass(frozen=True)
class PointCloud:
    """Points from which Gaussians are initialised.

    Attributes:
        points: Positions in the field's frame. [N, 3]
        colours: From 0 to 1. [N, 3]
        times: Time at which each point was observed, from 0 to 1; None if unknown. [N]
        scales: Standard deviations; None for `neighbour_distance`. [N]
        opacity: Initial opacity, from 0 to 1.
    """

    points: Tensor
    colours: Tensor
    times: Tensor | None = None
    scales: Tensor | None = None
    opacity: float = FIRST_OPACITY


@dataclass(frozen=True)
class PosedGaussians:
    """Gaussians at one time, ready for the rasteriser.

    Attributes:
        means: In the field's frame. [N, 3]
        quaternions: Rotations (w, x, y, z) of any length. [N, 4]
        scales: Standard deviations along the rotated axes. [N, 3]
        opacities: From 0 to 1. [N]
        harmonics: Coefficients of the spherical harmonics of colours minus 0.5. [N, K, 3]
        degree: Highest degree in use.
    """

    means: Tensor
    quaternions: Tensor
    scales: Tensor
    opacities: Tensor
    harmonics: Tensor
    degree: int


class Gaussians(Representation):
    """Canonical Gaussians, whose number changes in training, and their motion.

    `rows` lists the tensors with one row per Gaussian. A state with another number of Gaussians can
    be loaded.

    Args:
        cloud: Initial means and colours.
        degree: Highest degree of the spherical harmonics.
        extent: Extent of the cameras, see `camera_extent`, in units of the field's frame.
        moves: Whether the scene is dynamic.

    Source: Kerbl et al. 2023, released code.
    """

    PARAMETERS: tuple[str, ...] = ("means", "quaternions", "log_scales", "logits", "base", "detail")
    STATISTICS = ("slopes", "seen")

    def __init__(self, cloud: PointCloud, *, degree: int, extent: float, moves: bool) -> None:
        super().__init__()
        points, count = cloud.points, len(cloud.points)
        scales = neighbour_distance(points) if cloud.scales is None else cloud.scales
        self.means = nn.Parameter(points.clone())
        self.quaternions = nn.Parameter(points.new_tensor([1.0, 0, 0, 0]).repeat(count, 1))
        self.log_scales = nn.Parameter(scales.log()[:, None].repeat(1, 3))
        self.logits = nn.Parameter(torch.full((count,), cloud.opacity).logit())
        self.base = nn.Parameter((cloud.colours - 0.5)[:, None] / BASE)  # [N, 1, 3]
        self.detail = nn.Parameter(torch.zeros(count, (degree + 1) ** 2 - 1, 3))
        self._moves = moves
        # Sum of gradient norms of the projected means, and number of views with each Gaussian.
        self.register_buffer("slopes", torch.zeros(count))
        self.register_buffer("seen", torch.zeros(count))
        self.register_buffer("degree", torch.tensor(0))
        self.register_buffer("deforms", torch.tensor(False))
        self.register_buffer("extent", torch.tensor(extent))
        self.register_load_state_dict_pre_hook(_fit_rows)

    slopes: Tensor
    seen: Tensor
    degree: Tensor
    deforms: Tensor
    extent: Tensor

    @property
    def moves(self) -> bool:
        return self._moves

    @property
    def outline(self) -> str:
        return f"{len(self):,} Gaussians"

    def __len__(self) -> int:
        return len(self.means)

    @property
    def exports(self) -> Mapping[str, Writer]:
        return {"gaussians": lambda path, time, frame: write_gaussians(path, self.at(time), frame)}

    @torch.no_grad()
    def cloud(self, time: float) -> tuple[Tensor, Tensor]:
        """Means and colours of the Gaussians at least half as opaque as the most opaque one."""
        posed = self.at(time)
        order = posed.opacities.argsort(descending=True)
        order = order[: int((posed.opacities >= posed.opacities.max() / 2).sum())]
        return posed.means[order], (0.5 + BASE * posed.harmonics[order, 0]).clamp(0, 1)

    def masked(self, keep: Callable[[Tensor], Tensor]) -> "MaskedGaussians":
        return MaskedGaussians(self, keep)

    @property
    def rows(self) -> dict[str, Tensor]:
        """The tensors with one row per Gaussian."""
        return {name: getattr(self, name) for name in (*self.PARAMETERS, *self.STATISTICS)}

    @property
    def scales(self) -> Tensor:
        """Canonical standard deviations. [N, 3]"""
        return self.log_scales.clamp_max(LARGEST).exp()

    @property
    def opacities(self) -> Tensor:
        """Canonical opacities, from 0 to 1. [N]"""
        return self.logits.sigmoid()

    @abstractmethod
    def moved(self, canonical: PosedGaussians, time: float) -> PosedGaussians:
        """The Gaussians after their motion to a time.

        Args:
            canonical: The canonical Gaussians.
            time: From 0 to 1.
        """

    def at(self, time: float) -> PosedGaussians:
        """The Gaussians at a time from 0 to 1; gradients reach the parameters."""
        harmonics = torch.cat([self.base, self.detail], dim=1)
        shape = self.means, self.quaternions, self.scales
        canonical = PosedGaussians(*shape, self.opacities, harmonics, int(self.degree))
        return self.moved(canonical, time) if self.moves and self.deforms else canonical

    def training_time(self, time: float, state: TrainingState) -> float:
        """The time at which a view is rendered in training; subclasses may add noise."""
        return time


def _fit_rows(field: Gaussians, state: Mapping[str, Any], prefix: str, *_rest: Any) -> None:
    """Resize the rows to the number of Gaussians of the state."""
    count = len(state.get(f"{prefix}means", field.means))
    if count != len(field):
        for tensor in field.rows.values():
            tensor.data = tensor.new_zeros(count, *tensor.shape[1:])


class MaskedGaussians(Masked):
    """Gaussians without those whose means are in some regions."""

    def at(self, time: float) -> PosedGaussians:
        """See `Gaussians.at`."""
        posed = self._field.at(time)
        return replace(posed, opacities=posed.opacities * self._keep(posed.means))


class HexPlaneGaussians(Gaussians):
    """Gaussians that a multi-resolution field of six planes moves, rotates and scales.

    The deformation reads detached means: its gradients reach only planes and networks.

    Args:
        cloud: See `Gaussians`.
        planes: The planes; None for a static scene.
        width: Neurons of the hidden layers.
        canonical: Other arguments of `Gaussians`.

    Source: 4D-GS (Wu et al. 2024), Section 4.
    """

    def __init__(
        self, cloud: PointCloud, *, planes: PlaneProducts | None, width: int, **canonical: Any
    ) -> None:
        super().__init__(cloud, **canonical, moves=planes is not None)
        self.products = planes
        self.network = nn.ModuleDict()
        if planes is not None:
            self.network["features"] = _linear(planes.features, width)
            for name, outputs in HEADS.items():
                self.network[name] = nn.Sequential(
                    nn.ReLU(), _linear(width, width), nn.ReLU(), _still(width, outputs)
                )

    @property
    def planes(self) -> Mapping[str, Tensor]:
        return {} if self.products is None else self.products.finest

    def moved(self, canonical: PosedGaussians, time: float) -> PosedGaussians:
        assert self.products is not None
        times = torch.full_like(self.means[:, 0], time)
        hidden = self.network["features"](self.products(self.means.detach(), times))
        shift, turn, growth = (self.network[name](hidden) for name in HEADS)
        return replace(
            canonical,
            means=canonical.means + shift,
            quaternions=canonical.quaternions + turn,
            scales=(self.log_scales + growth).clamp_max(LARGEST).exp(),
        )


class DeformedGaussians(Gaussians):
    """Gaussians that a network of position and time moves, rotates and scales.

    The network reads detached means: its gradients reach only its weights.

    Args:
        cloud: See `Gaussians`.
        depth: Number of hidden layers; the encoded input is concatenated after the middle one.
        width: Neurons of the hidden layers.
        octaves: Frequencies of the encodings of positions and times.
        noise: Initial standard deviation of the noise on time.
        noise_until: Share of training over which the noise fades to 0.
        canonical: Other arguments of `Gaussians`.

    Source: Deformable 3D Gaussians (Yang et al. 2024), Section 3, and its released code.
    """

    def __init__(
        self,
        cloud: PointCloud,
        *,
        depth: int,
        width: int,
        octaves: tuple[int, int],
        noise: float = 0.0,
        noise_until: float = 0.0,
        **canonical: Any,
    ) -> None:
        super().__init__(cloud, **canonical)
        self.octaves, self.noise, self.noise_until = octaves, noise, noise_until
        self.network = nn.ModuleDict()
        if self.moves:
            of_place, of_time = 3 * (1 + 2 * octaves[0]), 1 + 2 * octaves[1]
            inputs, self._entry = of_place + TIME_FEATURES, depth // 2 + 1
            self.network["time"] = layers([of_time, width, TIME_FEATURES])
            columns = [inputs, *[width] * (depth - 1)]
            if self._entry < depth:
                columns[self._entry] += inputs
            self.network["hidden"] = nn.ModuleList(nn.Linear(count, width) for count in columns)
            for name, outputs in HEADS.items():
                self.network[name] = _still(width, outputs)

    def moved(self, canonical: PosedGaussians, time: float) -> PosedGaussians:
        places = octaves(self.means.detach(), self.octaves[0])
        times = self.network["time"](octaves(places.new_tensor([[time]]), self.octaves[1]))
        given = torch.cat([places, times.expand(len(places), -1)], dim=1)
        hidden = given
        for number, layer in enumerate(self.network["hidden"]):  # type: ignore[arg-type]
            if number == self._entry:
                hidden = torch.cat([given, hidden], dim=1)
            hidden = layer(hidden).relu()
        shift, turn, growth = (self.network[name](hidden) for name in HEADS)
        return replace(
            canonical,
            means=canonical.means + shift,
            quaternions=F.normalize(canonical.quaternions, dim=1) + turn,
            # The covariance does not depend on the sign.
            scales=(canonical.scales + growth).abs(),
        )

    def training_time(self, time: float, state: TrainingState) -> float:
        """The time with fading noise, for smooth motion (Yang et al. 2024, Eq. 6)."""
        left = 1 - state.progress / self.noise_until if self.noise_until else 0.0
        if not (self.noise and left > 0 and self.deforms):
            return time
        generator = state.generator(torch.device("cpu"), Stream.TIME_NOISE)
        return time + left * self.noise * float(torch.randn((), generator=generator))


class SpacetimeGaussians(Gaussians):
    """Gaussians whose opacity varies with time, and which move along polynomials in time.

    Opacity is a radial basis function of time with a learned centre per Gaussian; means are
    polynomials of degree 3, and quaternions of degree 1, in the time since this centre.

    Args:
        cloud: See `Gaussians`; its times are the initial centres, which are random without times.
        width: Initial width of the radial basis; the whole sequence has length 1.
        canonical: Other arguments of `Gaussians`.

    Source: Spacetime Gaussians (Li et al. 2024), Section 4.1, in its lite version: without the
    network after the rasteriser.
    """

    PARAMETERS = (*Gaussians.PARAMETERS, "centres", "log_widths", "motion", "spin")

    def __init__(self, cloud: PointCloud, *, width: float, **canonical: Any) -> None:
        super().__init__(cloud, **canonical)
        count = len(cloud.points)
        centres = torch.rand(count) if cloud.times is None else cloud.times.clone()
        self.centres = nn.Parameter(centres)
        self.log_widths = nn.Parameter(torch.full((count,), math.log(width)))
        self.motion = nn.Parameter(torch.zeros(count, ORDER, 3))
        self.spin = nn.Parameter(torch.zeros(count, 4))
        self.deforms.fill_(self.moves)

    def moved(self, canonical: PosedGaussians, time: float) -> PosedGaussians:
        since = time - self.centres
        life = (-(since / self.log_widths.exp()).square()).exp()
        # As in the released code, gradients of the motion do not reach the centres.
        since = since.detach()[:, None]
        powers = torch.cat([since**power for power in range(1, ORDER + 1)], dim=1)
        return replace(
            canonical,
            means=canonical.means + (powers[..., None] * self.motion).sum(dim=1),
            quaternions=canonical.quaternions + since * self.spin,
            opacities=canonical.opacities * life,
        )


def _still(inputs: int, outputs: int) -> nn.Linear:
    """A last layer initialised to zero: the initial deformation is the identity."""
    layer = nn.Linear(inputs, outputs)
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


def _linear(inputs: int, outputs: int) -> nn.Linear:
    layer = nn.Linear(inputs, outputs)
    nn.init.xavier_uniform_(layer.weight)
    return layer


def neighbour_distance(points: Tensor) -> Tensor:
    """Root of the mean squared distance to the three nearest other points, at least 3e-4. [N]"""
    if len(points) < 2:
        return torch.full_like(points[:, 0], 0.1)
    count = min(NEIGHBOURS, len(points) - 1)
    found = [
        # The nearest point is the point itself.
        torch.cdist(part, points).topk(count + 1, largest=False).values[:, 1:]
        for part in points.split(ROWS)
    ]
    return torch.cat(found).square().mean(dim=1).clamp(min=1e-7).sqrt()
