"""Posed solids: ray casting and point queries in world coordinates."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from xplanes.synthetic.demo.geometry import MISS, Box, Primitive, Surface, Translucent
from xplanes.synthetic.demo.shading import Light

MAX_SURFACES = 24
"""Maximum number of surfaces that a ray passes through."""

CHUNK = 16384
"""Rays per chunk, so that temporaries fit in the cache."""


@dataclass(frozen=True)
class PosedPart:
    """A shape with its pose in the world.

    Attributes:
        shape: The solid.
        surface: Its colours.
        rotation: From part to world coordinates. [3, 3]
        translation: The part's centre in the world. [3]
        scale: World units per unit of part coordinates.
    """

    shape: Primitive
    surface: Surface
    rotation: Tensor
    translation: Tensor
    scale: float = 1.0

    def to_own(self, points: Tensor) -> Tensor:
        """World points in the part's coordinates. [N, 3]"""
        return (points - self.translation.to(points)) @ self.rotation.to(points) / self.scale

    def hit(self, origins: Tensor, directions: Tensor) -> Tensor:
        """Distance along each ray to the part, inf for a miss. [N]"""
        own = directions @ self.rotation.to(directions)
        return self.shape.hit(self.to_own(origins), own) * self.scale

    def inside(self, points: Tensor) -> Tensor:
        """Whether world points lie inside the part. bool [N]"""
        return self.shape.inside(self.to_own(points))

    def colour(self, points: Tensor) -> Tensor:
        """Unlit colours of the part at world points. [N, 3]"""
        return self.surface.colour(self.shape.material(self.to_own(points)))


class Hits(NamedTuple):
    """First hits of rays.

    Attributes:
        distance: Distance to the first surface, inf for a miss. [N]
        normal: Outward unit normal at the hit, 0 for a miss. [N, 3]
        colour: Colour, shaded if there is a light, 0 for a miss. [N, 3]
        part: Index of the part, -1 for a miss. [N]
    """

    distance: Tensor
    normal: Tensor
    colour: Tensor
    part: Tensor


@dataclass(frozen=True)
class Posed:
    """An assembly at one timestep.

    Attributes:
        parts: The posed parts.
        light: Light of the scene; None for unlit colours.
    """

    parts: tuple[PosedPart, ...]
    light: Light | None = None

    def __post_init__(self) -> None:
        if not self.parts:
            raise ValueError("an assembly needs at least one part")

    @cached_property
    def _centres(self) -> Tensor:
        return torch.stack([part.translation for part in self.parts])

    @cached_property
    def _radii(self) -> Tensor:
        """Radii of the parts' bounding spheres."""
        return torch.tensor([part.shape.radius_around * part.scale for part in self.parts])

    @cached_property
    def _lit(self) -> Tensor:
        return torch.tensor([part.surface.lit for part in self.parts])

    def cast(self, origins: Tensor, directions: Tensor) -> Hits:
        """First hit of each ray.

        Args:
            origins: Ray origins. [N, 3]
            directions: Unit directions. [N, 3]
        """
        hits = Hits(
            torch.full_like(directions[:, 0], MISS),
            torch.zeros_like(directions),
            torch.zeros_like(directions),
            torch.full_like(directions[:, 0], -1, dtype=torch.long),
        )
        low, high = (corner.to(origins) for corner in self.bounds())
        block = Box(tuple((0.5 * (high - low) + 1e-3).tolist()))
        reached = block.hit(origins - 0.5 * (low + high), directions).isfinite()
        chunk = CHUNK if all(part.shape.quick for part in self.parts) else 6 * CHUNK
        for rays in reached.nonzero()[:, 0].split(chunk):
            for whole, found in zip(hits, self._cast(origins[rays], directions[rays]), strict=True):
                whole[rays] = found
        return hits

    def render(self, origins: Tensor, directions: Tensor) -> Tensor:
        """Composite all surfaces and media along each ray, from front to back.

        Args:
            origins: Ray origins, outside all parts. [N, 3]
            directions: Unit directions. [N, 3]

        Returns:
            Premultiplied colour and opacity. [N, 4]
        """
        if not any(isinstance(part.surface, Translucent) for part in self.parts):
            hits = self.cast(origins, directions)
            return torch.cat([hits.colour, (hits.part >= 0).float()[:, None]], dim=-1)
        rgba = directions.new_zeros(len(directions), 4)
        through = torch.ones_like(directions[:, 0])
        rays = torch.arange(len(directions), device=directions.device)
        for _ in range(MAX_SURFACES):
            hits = self.cast(origins, directions)
            found = hits.distance.isfinite()
            rays, origins, directions, through = (
                kept[found] for kept in (rays, origins, directions, through)
            )
            if len(rays) == 0:
                break
            hits = Hits(*(value[found] for value in hits))
            for layer in (
                self._media(origins, directions, hits.distance),
                self._surfaces(directions, hits),
            ):
                rgba[rays] += through[:, None] * layer
                through = through * (1 - layer[:, 3])
            # Continue just beyond the surface.
            origins = origins + (hits.distance + 1e-4)[:, None] * directions
            seen = through > 1 / 512
            rays, origins, directions, through = (
                kept[seen] for kept in (rays, origins, directions, through)
            )
        return rgba

    def _media(self, origins: Tensor, directions: Tensor, distance: Tensor) -> Tensor:
        """Premultiplied colour and opacity of the media before the next surface. [N, 4]"""
        middle = origins + 0.5 * distance[:, None] * directions
        density, glow = torch.zeros_like(distance), torch.zeros_like(directions)
        for part in self.parts:
            surface = part.surface
            if isinstance(surface, Translucent) and surface.density:
                own = surface.density * part.inside(middle).to(distance)
                density = density + own
                glow = glow + own[:, None] * part.colour(middle)
        opacity = 1 - (-density * distance).exp()
        colour = glow / density.clamp_min(1e-9)[:, None]
        return torch.cat([opacity[:, None] * colour, opacity[:, None]], dim=-1)

    def _surfaces(self, directions: Tensor, hits: Hits) -> Tensor:
        """Premultiplied colour and opacity of the surfaces at hits. [N, 4]"""
        opacity = torch.ones_like(hits.distance)
        cosine = (directions * hits.normal).sum(dim=-1)
        for number, part in enumerate(self.parts):
            if isinstance(part.surface, Translucent):
                opacity = torch.where(hits.part == number, part.surface.opacity(cosine), opacity)
        return torch.cat([opacity[:, None] * hits.colour, opacity[:, None]], dim=-1)

    def nearest(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Distance to the first part on each ray, and its index (inf, -1 for a miss). [N], [N]"""
        best = torch.full_like(directions[:, 0], MISS)
        part = torch.full_like(best, -1, dtype=torch.long)
        for number, rays in self._candidates(origins, directions):
            distance = self.parts[number].hit(origins[rays], directions[rays])
            closer = distance < best[rays]
            rays = rays[closer]
            best[rays], part[rays] = distance[closer], number
        return best, part

    def inside(self, points: Tensor) -> Tensor:
        """Whether points lie inside any part. bool [N]"""
        result = torch.zeros(len(points), dtype=torch.bool, device=points.device)
        for part in self.parts:
            result |= part.inside(points)
        return result

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Corners of the axis-aligned bounding box of all parts. [3], [3]"""
        reach = torch.stack(
            [p.rotation.abs() @ p.rotation.new_tensor(p.shape.extent) * p.scale for p in self.parts]
        )
        return (self._centres - reach).amin(dim=0), (self._centres + reach).amax(dim=0)

    def _candidates(self, origins: Tensor, directions: Tensor) -> Iterator[tuple[int, Tensor]]:
        """Each part with the rays that hit its bounding sphere."""
        centres = self._centres.to(origins)
        # Enlarged by more than the float32 rounding error of the squares below.
        radii = (self._radii.to(origins) * 1.01 + 1e-3)[:, None]
        one = torch.ones_like(origins[:, :1])
        # Two matrix products give, for every part and ray, the squared distance from the origin
        # to the centre less the squared radius, and how far along the ray the centre lies.
        spare = centres.square().sum(dim=-1, keepdim=True) - radii.square()
        beyond = torch.cat([-2 * centres, spare, torch.ones_like(radii)], dim=-1) @ (
            torch.cat([origins, one, origins.square().sum(dim=-1, keepdim=True)], dim=-1).T
        )
        start = (origins * directions).sum(dim=-1, keepdim=True)
        along = torch.cat([centres, -torch.ones_like(radii)], dim=-1) @ (
            torch.cat([directions, start], dim=-1).T
        )
        through = (beyond < along.square()) & (along > -radii)
        part, rays = through.nonzero(as_tuple=True)
        counts = torch.bincount(part, minlength=len(self.parts)).tolist()
        for number, chosen in enumerate(rays.split(counts)):
            if len(chosen):
                yield number, chosen

    def _cast(self, origins: Tensor, directions: Tensor) -> Hits:
        distance, part = self.nearest(origins, directions)
        normal, colour = torch.zeros_like(directions), torch.zeros_like(directions)
        found = (part >= 0).nonzero()[:, 0]
        if len(found) == 0:
            return Hits(distance, normal, colour, part)
        points = origins[found] + distance[found, None] * directions[found]
        own = part[found]
        normals, colours = torch.empty_like(points), torch.empty_like(points)
        for number in own.unique().tolist():
            chosen, posed = (own == number).nonzero()[:, 0], self.parts[number]
            local = posed.to_own(points[chosen])
            normals[chosen] = posed.shape.normal(local) @ posed.rotation.to(points).T
            colours[chosen] = posed.surface.colour(posed.shape.material(local))
        if self.light is not None:
            shaded = self.light.shade(colours, normals, self._shadowed(points, normals, own))
            colours = torch.where(self._lit.to(own.device)[own, None], shaded, colours)
        normal[found], colour[found] = normals, colours
        return Hits(distance, normal, colour, part)

    def _shadowed(self, points: Tensor, normals: Tensor, part: Tensor) -> Tensor | None:
        """Whether surface points of parts [N] lie in shadow. bool [N]"""
        if self.light is None or not self.light.shadow:
            return None
        sun = self.light.direction(points)
        # Faces that point away from the sun need no shadow ray.
        lit = (normals @ sun > 0).nonzero()[:, 0]
        # The offset scales with the part, so that small parts cast correct shadows.
        gap = 1e-3 * points.new_tensor([posed.scale for posed in self.parts])[part[lit]]
        starts = points[lit] + gap[:, None] * normals[lit]
        shadowed = torch.zeros(len(points), dtype=torch.bool, device=points.device)
        shadowed[lit] = self.nearest(starts, sun.expand_as(starts))[1] >= 0
        return shadowed
