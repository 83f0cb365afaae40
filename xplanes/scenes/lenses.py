"""Lens distortion and its inverse.

A lens maps directions to the image plane: x to the right and y down, in focal lengths. A direction
at the angle theta from the optical axis is projected to the distance tan(theta) from the plane's
centre, or theta for a fisheye lens. Distortion is applied to this point.
"""

import math
from dataclasses import dataclass, fields
from enum import IntEnum

import torch
from torch import Tensor


class LensModel(IntEnum):
    """Kinds of lenses, with their names in COLMAP and OpenCV."""

    PERSPECTIVE = 0
    """OpenCV's full model: PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV and FULL_OPENCV."""
    FISHEYE = 1
    """Equidistant: OPENCV_FISHEYE, SIMPLE_RADIAL_FISHEYE, RADIAL_FISHEYE, THIN_PRISM_FISHEYE."""
    FOV = 2
    """One angle, omega, stored in place of k1."""
    POLYNOMIAL = 3
    """Perspective, with k4 as the coefficient of r^8: nerfstudio, Metashape, RealityCapture."""


COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s1", "s2", "s3", "s4")
"""Distortion coefficients by their names in OpenCV: radial, tangential, thin prism.

For perspective lenses k4 to k6 are in the denominator. Fisheye and polynomial lenses have no k5 and
k6; their k4 is the coefficient of the eighth power. COLMAP's sx1 and sy1 are s1 and s3.
"""

STEEPEST = 1e3
"""Tangent of the largest angle from the optical axis at which perspective lenses are used."""

WIDEST = math.radians(120)
"""Largest field of view of a pinhole that replaces a lens."""

NODES = 4096
"""Number of radii at which the radial distortion is checked for monotonicity."""

CHUNK = 1 << 16
"""Rays per block, so that temporaries fit in the processor's cache."""


@dataclass(frozen=True)
class Lenses:
    """Distortion and skew of the lenses of some images.

    Attributes:
        model: Kind of each lens, a `LensModel`. int64 [V]
        coefficients: Distortion, in the order of `COEFFICIENTS`. float64 [V, 12]
        skew: Shift to the right in pixels per focal length downwards. float64 [V]
        limit: Undistorted radius up to which each lens is invertible; computed when None.
            float64 [V]
    """

    model: Tensor
    coefficients: Tensor
    skew: Tensor
    limit: Tensor = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        count = len(self.model)
        shapes = {"coefficients": (count, len(COEFFICIENTS)), "skew": (count,)}
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value.shape != shape:
                raise ValueError(f"lenses.{name} is {list(value.shape)}, but must be {list(shape)}")
            object.__setattr__(self, name, value.double())
        object.__setattr__(self, "model", self.model.long())
        if self.limit is None:
            object.__setattr__(self, "limit", _limits(self.model, self.coefficients))

    def __len__(self) -> int:
        return len(self.model)

    @classmethod
    def pinholes(cls, count: int) -> "Lenses":
        """Lenses without distortion."""
        return cls(
            torch.zeros(count, dtype=torch.int64),
            torch.zeros(count, len(COEFFICIENTS), dtype=torch.float64),
            torch.zeros(count, dtype=torch.float64),
        )

    @property
    def are_pinholes(self) -> bool:
        """Whether no lens has distortion."""
        straight = self.model != LensModel.FISHEYE
        return bool(straight.all()) and not self.coefficients.any() and not self.skew.any()

    def __getitem__(self, indices: Tensor | slice) -> "Lenses":
        """The lenses of the images at ``indices``, in that order. [K]"""
        return Lenses(*(getattr(self, each.name)[indices] for each in fields(self)))

    def joined(self, other: "Lenses") -> "Lenses":
        """These lenses, then those of ``other``."""
        names = [each.name for each in fields(self)]
        return Lenses(*(torch.cat([getattr(self, n), getattr(other, n)]) for n in names))

    def directions(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Directions that the lenses map to points of the image plane.

        Args:
            x: To the right of the principal point, in focal lengths. [R]
            y: Downwards, in focal lengths. [R]

        Returns:
            Unit vectors along the camera's axes, float64 [R, 3], and whether each point has such a
            direction, bool [R]. If it has none, the nearest direction is returned.
        """
        x, y = torch.broadcast_tensors(x.double(), y.double())
        parts = []
        for start in range(0, max(1, len(x)), CHUNK):
            part = slice(start, start + CHUNK)
            few = self if len(self) == 1 else self[part]
            parts.append(few._directions(x[part], y[part]))
        local, found = zip(*parts, strict=True)
        return torch.cat(local), torch.cat(found)

    def _directions(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        local, found = x.new_empty(len(x), 3), torch.empty(len(x), dtype=torch.bool)
        for model, rays, lenses in self._by_model(len(x)):
            if model == LensModel.FOV:
                right, down, found[rays] = _undo_fov(x[rays], y[rays], lenses)
            else:
                right, down, found[rays] = _undo(x[rays], y[rays], lenses)
            if model == LensModel.FISHEYE:
                angle = torch.hypot(right, down)
                flat = torch.sinc(angle / math.pi)
                local[rays] = torch.stack([flat * right, -flat * down, -angle.cos()], dim=-1)
            else:
                ray = torch.stack([right, -down, -torch.ones_like(right)], dim=-1)
                local[rays] = ray / ray.norm(dim=-1, keepdim=True)
        return local, found

    def image_points(self, local: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Project points in camera coordinates to the image plane.

        Args:
            local: Points along the camera's axes. [N, 3]

        Returns:
            Points of the image plane, to the right and down, in focal lengths, float64 [N] each,
            and whether the lens maps the direction of each point to the plane, bool [N].
        """
        right, down, depth = local.double().unbind(-1)
        down, depth = -down, -depth
        x, y = torch.empty_like(right), torch.empty_like(right)
        seen = torch.empty(len(right), dtype=torch.bool)
        aside = torch.hypot(right, down)
        for model, points, lenses in self._by_model(len(right)):
            scale, front = 1 / depth[points], depth[points] > 0
            if model == LensModel.FISHEYE:
                angle = torch.atan2(aside[points], depth[points])
                on_axis = aside[points] == 0
                scale = torch.where(on_axis, scale, angle / aside[points])
                front |= ~on_axis
            flat_x, flat_y = right[points] * scale, down[points] * scale
            front &= torch.hypot(flat_x, flat_y) <= lenses.limit
            if model == LensModel.FOV:
                x[points], y[points] = _apply_fov(flat_x, flat_y, lenses)
            else:
                bent_x, bent_y, slopes = _distort(flat_x, flat_y, _terms(lenses))
                x[points], y[points] = bent_x, bent_y
                front &= _determinant(slopes) > 0
            seen[points] = front
        return x, y, seen

    def ball_extent(self, local: Tensor, radius: float) -> Tensor:
        """Extent of balls from their centres, before distortion, in focal lengths.

        Args:
            local: Centres along the camera's axes. [N, 3]
            radius: Radius of the balls.

        Returns:
            An upper bound; infinity for balls that touch the camera or its plane. float64 [N]
        """
        distance, depth = local.double().norm(dim=-1), -local[:, 2].double()
        extent = torch.empty_like(distance)
        for model, points, _ in self._by_model(len(local)):
            away, front = distance[points], depth[points]
            if model == LensModel.FISHEYE:
                clear, aside = away > radius, local[points, :2].double().norm(dim=-1)
                angle, half = torch.atan2(aside, front), (radius / away).clamp(max=1).asin()
                # Length of a path along a circle and a radius, or of one through the image centre.
                turn = torch.where(aside > radius, (radius / aside).asin(), math.inf)
                through = angle + (angle + half).clamp(max=math.pi)
                bound = torch.minimum(half + angle * turn, through)
            else:
                clear = front > radius
                bound = radius * away / (front * (front - radius))
            extent[points] = torch.where(clear, bound, math.inf)
        return extent

    def _by_model(self, count: int) -> list[tuple[int, Tensor | slice, "Lenses"]]:
        """For each model: its rays and their lenses, either one for all or one for each."""
        models = self.model.unique().tolist()
        if len(models) == 1:
            return [(models[0], slice(None), self)]
        assert len(self) == count
        chosen = [(self.model == model).nonzero()[:, 0] for model in models]
        return [(m, rays, self[rays]) for m, rays in zip(models, chosen, strict=True)]


@dataclass(frozen=True)
class Sight:
    """Field of view of an image with a lens.

    Attributes:
        has_ray: Pixels to whose centre the lens maps a direction; None for all. bool [h, w]
        stretch: Largest factor by which distortion increases the distance of two points.
        pinhole: Focal lengths in pixels, along x and y, of a centred pinhole with the same angle
            between the midpoints of opposite edges, at most `WIDEST`.
    """

    has_ray: Tensor | None
    stretch: float
    pinhole: tuple[float, float]


def sight(lens: Lenses, focal: Tensor, centre: Tensor, height: int, width: int) -> Sight:
    """Field of view of an image through its lens.

    Args:
        lens: The lens.
        focal: Focal lengths along x and y in pixels. [2]
        centre: Principal point in pixels. [2]
        height: Rows.
        width: Columns.
    """

    def unproject(columns: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        y = (rows.double() - centre[1]) / focal[1]
        x = (columns.double() - centre[0] - lens.skew * y) / focal[0]
        return lens.directions(x, y)

    across, along = torch.arange(width) + 0.5, torch.arange(height) + 0.5
    ends = torch.tensor([0.5, width - 0.5]), torch.tensor([0.5, height - 0.5])
    border_x = torch.cat([across.repeat(2), ends[0].repeat_interleave(height)])
    border_y = torch.cat([ends[1].repeat_interleave(width), along.repeat(2)])
    local, found = unproject(border_x, border_y)
    has_ray = None
    if not found.all():
        rows, columns = torch.meshgrid(along, across, indexing="ij")
        has_ray = unproject(columns.flatten(), rows.flatten())[1].view(height, width)
    x, y = 0.5 * width, 0.5 * height
    edges = unproject(torch.tensor([0, width, x, x, x]), torch.tensor([y, y, 0, height, y]))[0]
    apart = torch.linalg.cross(edges[:4], edges[4:].expand(4, 3)).norm(dim=-1)
    angles = torch.atan2(apart, edges[:4] @ edges[4])
    half_x, half_y = (
        min(0.5 * float(pair.sum()), 0.5 * WIDEST) for pair in (angles[:2], angles[2:])
    )
    pinhole = 0.5 * width / math.tan(half_x), 0.5 * height / math.tan(half_y)
    return Sight(has_ray, _stretch(lens, local), pinhole)


def _stretch(lens: Lenses, border: Tensor) -> float:
    """Upper bound of the distortion's derivative within an image's border rays. [B, 3]"""
    omega = float(lens.coefficients[0, 0])
    if lens.model[0] == LensModel.FOV:
        return 2 * math.tan(omega / 2) / omega if omega else 1.0
    angle = torch.atan2(border[:, :2].norm(dim=-1), -border[:, 2])
    largest = float((angle if lens.model[0] == LensModel.FISHEYE else angle.tan()).max())
    # Border pixels extend half a pixel beyond their centres.
    radius = torch.linspace(0, min(1.05 * largest, float(lens.limit)), NODES, dtype=torch.float64)
    terms = _terms(lens)
    ratio, slope = _radial(radius, terms)
    p1, p2, s1, s2, s3, s4 = (float(term.abs()) for term in terms[7:])
    last = float(radius[-1])
    # Bounds of the other terms' derivatives on that circle, by their Frobenius norms.
    rest = 40**0.5 * (p1 + p2) * last + 2 * (s1 + s3) * last + 4 * (s2 + s4) * last**3
    return 1.01 * float(torch.maximum(ratio.abs(), slope.abs()).max()) + rest


def _terms(lenses: Lenses) -> list[Tensor]:
    """Coefficients of the radial numerator (4) and denominator (3), then p and s. [V] each"""
    k1, k2, k3, k4, k5, k6, *others = lenses.coefficients.unbind(dim=1)
    none = torch.zeros_like(k1)
    if lenses.model[0] in (LensModel.FISHEYE, LensModel.POLYNOMIAL):
        return [k1, k2, k3, k4, none, none, none, *others]
    return [k1, k2, k3, none, k4, k5, k6, *others]


def _ratio(square: Tensor, terms: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Radial distortion factor at squared radii, and its derivative with respect to them."""
    a1, a2, a3, a4, b1, b2, b3 = terms[:7]
    top = 1 + square * (a1 + square * (a2 + square * (a3 + square * a4)))
    top_slope = a1 + square * (2 * a2 + square * (3 * a3 + square * 4 * a4))
    bottom = 1 + square * (b1 + square * (b2 + square * b3))
    bottom_slope = b1 + square * (2 * b2 + square * 3 * b3)
    ratio = top / bottom
    return ratio, (top_slope - ratio * bottom_slope) / bottom


def _radial(radius: Tensor, terms: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Distorted radius over radius, and the distorted radius's derivative."""
    square = radius.square()
    ratio, slope = _ratio(square, terms)
    return ratio, ratio + 2 * square * slope


def _distort(
    x: Tensor, y: Tensor, terms: list[Tensor]
) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Distorted points and their Jacobian: x by x, x by y, y by x and y by y."""
    p1, p2, s1, s2, s3, s4 = terms[7:]
    square, product = x * x + y * y, 2 * x * y
    ratio, slope = _ratio(square, terms)
    bent_x = x * ratio + p1 * product + p2 * (square + 2 * x * x) + square * (s1 + s2 * square)
    bent_y = y * ratio + p2 * product + p1 * (square + 2 * y * y) + square * (s3 + s4 * square)
    prism_x, prism_y = 2 * (s1 + 2 * s2 * square), 2 * (s3 + 2 * s4 * square)
    mixed = product * slope + 2 * (p1 * x + p2 * y)
    slopes = (
        ratio + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x + prism_x * x,
        mixed + prism_x * y,
        mixed + prism_y * x,
        ratio + 2 * y * y * slope + 2 * p2 * x + 6 * p1 * y + prism_y * y,
    )
    return bent_x, bent_y, slopes


def _determinant(slopes: tuple[Tensor, Tensor, Tensor, Tensor]) -> Tensor:
    return slopes[0] * slopes[3] - slopes[1] * slopes[2]


def _undo(x: Tensor, y: Tensor, lenses: Lenses) -> tuple[Tensor, Tensor, Tensor]:
    """Undistorted x and y of points, and whether they exist. [R] each"""
    terms, limit = _terms(lenses), lenses.limit
    target = torch.hypot(x, y)
    most = limit * _radial(limit, terms)[0]
    found = target <= most
    radius = _undo_radial(torch.minimum(target, most), terms, limit)
    scale = torch.where(target > 0, radius / target, 1.0)
    if not any(term.any() for term in terms[7:]):
        return scale * x, scale * y, found
    # Start from the radial term, as the others are small, but inside the limit, where the
    # derivative is 0.
    scale = torch.where(found, scale, 0.98 * scale)
    right, down = scale * x, scale * y
    for _ in range(50):
        bent_x, bent_y, slopes = _distort(right, down, terms)
        by_xx, by_xy, by_yx, by_yy = slopes
        determinant = _determinant(slopes)
        off_x, off_y = bent_x - x, bent_y - y
        step_x = (by_yy * off_x - by_xy * off_y) / determinant
        step_y = (by_xx * off_y - by_yx * off_x) / determinant
        length, size = torch.hypot(step_x, step_y), torch.hypot(right, down)
        shorter = (0.2 * (0.5 + size) / length).clamp(max=1.0)
        right, down = right - shorter * step_x, down - shorter * step_y
        if not (length > 1e-13 * (1 + size)).any():
            break
    bent_x, bent_y, slopes = _distort(right, down, terms)
    found = torch.hypot(bent_x - x, bent_y - y) <= 1e-9 * (1 + target)
    found &= (_determinant(slopes) > 0) & (torch.hypot(right, down) <= limit)
    return torch.where(found, right, scale * x), torch.where(found, down, scale * y), found


def _undo_radial(target: Tensor, terms: list[Tensor], limit: Tensor) -> Tensor:
    """Radii, up to the lenses' limits, that radial distortion maps to ``target``. [R]

    Newton's method, safeguarded by bisection: a step that leaves the bounds is replaced by halving.
    """
    low, high = torch.zeros_like(target), limit.expand_as(target)
    radius = torch.minimum(target, high)
    for _ in range(100):
        ratio, slope = _radial(radius, terms)
        above = ratio * radius - target
        low = torch.where(above <= 0, radius, low)
        high = torch.where(above > 0, radius, high)
        after = radius - above / slope
        inside = (after >= low) & (after <= high)
        after = torch.where(inside, after, 0.5 * (low + high))
        moved = (after - radius).abs()
        radius = after
        if not (moved > 1e-15 * (1 + radius)).any():
            break
    return radius


def _undo_fov(x: Tensor, y: Tensor, lenses: Lenses) -> tuple[Tensor, Tensor, Tensor]:
    """`_undo` for lenses of the model FOV."""
    omega, limit = lenses.coefficients[:, 0], lenses.limit
    distorted = torch.hypot(x, y)
    slope = 2 * (omega / 2).tan()
    most = torch.where(omega > 0, (slope * limit).atan() / omega, limit)
    found = distorted <= most
    least = torch.minimum(distorted, most)
    radius = torch.where(omega > 0, (least * omega).tan() / slope, least)
    scale = torch.where(distorted > 0, radius / distorted, 1.0)
    return scale * x, scale * y, found


def _apply_fov(x: Tensor, y: Tensor, lenses: Lenses) -> tuple[Tensor, Tensor]:
    omega, radius = lenses.coefficients[:, 0], torch.hypot(x, y)
    distorted = (2 * radius * (omega / 2).tan()).atan() / omega
    first = torch.where(omega > 0, 2 * (omega / 2).tan() / omega, 1.0)
    scale = torch.where((radius > 0) & (omega > 0), distorted / radius, first)
    return scale * x, scale * y


def _limits(model: Tensor, coefficients: Tensor) -> Tensor:
    """Radii up to which the lenses are invertible. [V]"""
    rows = torch.cat([model[:, None].double(), coefficients], dim=1)
    kinds, which = rows.unique(dim=0, return_inverse=True)
    found = kinds.new_empty(len(kinds))
    steep = torch.linspace(0, math.atan(STEEPEST), NODES, dtype=torch.float64).tan()
    wide = torch.linspace(0, math.pi, NODES, dtype=torch.float64)
    for index, row in enumerate(kinds):
        kind = Lenses(row[:1], row[None, 1:], row[:1] * 0, row[:1])
        nodes = wide if row[0] == LensModel.FISHEYE else steep
        found[index] = nodes[-1] if row[0] == LensModel.FOV else _fold(nodes, _terms(kind))
    return found[which]


def _fold(nodes: Tensor, terms: list[Tensor]) -> float:
    """The largest radius up to which distorted radii increase, at most the last node."""

    def folds(radius: Tensor) -> Tensor:
        ratio, slope = _radial(radius, terms)
        return ~((ratio > 0) & (slope > 0))

    bad = folds(nodes).nonzero()[:, 0]
    if not len(bad):
        return float(nodes[-1])
    low, high = nodes[bad[0] - 1], nodes[bad[0]]
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if folds(middle[None])[0] else (middle, high)
    return float(low)
