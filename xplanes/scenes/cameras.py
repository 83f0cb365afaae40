"""Cameras in the convention of D-NeRF files: rays through pixels, and projection of points.

Camera axes are OpenGL's: x right, y up, looking along -z. Pixel centres lie at +0.5.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from xplanes.scenes.lenses import Lenses


def focal_length(angle_x: float, width: float) -> float:
    """Focal length in pixels of a camera that sees ``angle_x`` radians across ``width`` pixels."""
    return 0.5 * width / math.tan(0.5 * angle_x)


@dataclass(frozen=True)
class PosedCamera:
    """A camera with pose, intrinsics and image size.

    Attributes:
        camera_to_world: Its pose. [4, 4]
        focal: Focal length in pixels, or one each along x and y. [2]
        height: Rows.
        width: Columns.
        centre: Principal point, x from the left and y from the top; the middle when None. [2]
        lens: Its lens; a pinhole when None.
    """

    camera_to_world: Tensor
    focal: float | Tensor
    height: int
    width: int
    centre: Tensor | None = None
    lens: Lenses | None = None

    def rays(self) -> tuple[Tensor, Tensor]:
        """Rays through every pixel, row by row.

        Returns:
            Origins and unit directions in the world. [H W, 3], [H W, 3]
        """
        lines = [torch.arange(count, dtype=torch.float32) for count in (self.height, self.width)]
        rows, columns = torch.meshgrid(*lines, indexing="ij")
        return cast_rays(
            self.camera_to_world,
            rows.flatten(),
            columns.flatten(),
            focal=self.focal,
            centre=(0.5 * self.width, 0.5 * self.height) if self.centre is None else self.centre,
            lenses=self.lens,
        )

    def resized(self, height: int, width: int) -> "PosedCamera":
        """The same camera with an image of another size."""
        scale = torch.tensor([width / self.width, height / self.height])
        lens = None if self.lens is None else replace(self.lens, skew=self.lens.skew * scale[0])
        centre = None if self.centre is None else self.centre * scale
        return PosedCamera(self.camera_to_world, self.focal * scale, height, width, centre, lens)

    def to(self, device: torch.device) -> "PosedCamera":
        """Returns the camera itself: it stays on the CPU when Lightning moves a batch."""
        return self


def cast_rays(
    camera_to_world: Tensor,
    rows: Tensor,
    columns: Tensor,
    *,
    focal: Tensor | float,
    centre: Tensor | tuple[float, float],
    lenses: Lenses | None = None,
) -> tuple[Tensor, Tensor]:
    """Cast one ray through each given pixel.

    If a lens maps no direction to a pixel, the nearest ray is used.

    Args:
        camera_to_world: Pose of the camera of each ray. [R, 4, 4] or [4, 4]
        rows: Pixel rows, from 0 at the top; fractions are allowed. [R]
        columns: Pixel columns, from 0 at the left. [R]
        focal: Focal lengths along x and y in pixels, or one for both. [R, 2] or [2]
        centre: Principal point, x from the left and y from the top, in pixels. [R, 2] or [2]
        lenses: One for each ray, or one for all; pinholes when None.

    Returns:
        Origins and unit directions in the world. Directions through lenses are computed in double
        precision and returned in that of ``rows``. [R, 3], [R, 3]
    """
    rotation = camera_to_world[..., :3, :3]
    if lenses is not None:
        x, y = image_plane(rows, columns, focal=focal, centre=centre, lenses=lenses)
        local = lenses.directions(x, y)[0]
        directions = turned(local, rotation.double()).to(rows.dtype)
        return camera_to_world[..., :3, 3].expand_as(directions), directions
    middle = columns + 0.5
    focal_x, focal_y = _pair(focal)
    centre_x, centre_y = _pair(centre)
    right = (middle - _like(middle, centre_x)) / _like(middle, focal_x)
    up = (_like(middle, centre_y - 0.5) - rows) / _like(middle, focal_y)
    local = torch.stack([right, up, -torch.ones_like(right)], dim=-1)
    local = local / local.norm(dim=-1, keepdim=True)
    directions = turned(local, rotation)
    return camera_to_world[..., :3, 3].expand_as(directions), directions


def turned(points: Tensor, rotation: Tensor) -> Tensor:
    """Rotate points, all by one rotation or each by its own; [..., 3] by [3, 3] or [..., 3, 3].

    Without a matrix product, which a GPU may compute in TF32: an error of half a pixel at 800 px.
    """
    x, y, z = (points[..., i : i + 1] for i in range(3))
    return (rotation[..., 0] * x).addcmul_(rotation[..., 1], y).addcmul_(rotation[..., 2], z)


def image_plane(
    rows: Tensor,
    columns: Tensor,
    *,
    focal: Tensor | float,
    centre: Tensor | tuple[float, float],
    lenses: Lenses,
) -> tuple[Tensor, Tensor]:
    """Pixel centres in focal lengths, for `Lenses.directions`; arguments as for `cast_rays`.

    Returns:
        Offsets from the principal point to the right and down. float64 [R], [R]
    """
    focal_x, focal_y = _pair(focal)
    centre_x, centre_y = _pair(centre)
    y = (rows.double() + 0.5 - centre_y) / focal_y
    return (columns.double() + 0.5 - centre_x - lenses.skew * y) / focal_x, y


def project(
    camera_to_world: Tensor,
    points: Tensor,
    *,
    focal: Tensor,
    centre: Tensor,
    lenses: Lenses | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Project points to pixels; the inverse of `cast_rays`.

    Args:
        camera_to_world: Pose of the camera. [4, 4]
        points: World points. [N, 3]
        focal: Focal lengths along x and y in pixels. [2]
        centre: Principal point in pixels. [2]
        lenses: The camera's lens; a pinhole when None.

    Returns:
        Pixel coordinates from the image's left and top edges, with pixel centres at +0.5, [N] each,
        and whether the point projects to the image plane, inside the image or outside, bool [N]. If
        not, its coordinates are meaningless.
    """
    local = camera_axes(camera_to_world, points)
    (focal_x, focal_y), (centre_x, centre_y) = focal.unbind(-1), centre.unbind(-1)
    if lenses is None:
        depth = -local[:, 2]
        right, down = local[:, 0] / depth * focal_x, -local[:, 1] / depth * focal_y
        return right + centre_x, down + centre_y, depth > 0
    x, y, seen = lenses.image_points(local)
    right, down = x * focal_x + y * lenses.skew + centre_x, y * focal_y + centre_y
    return right.to(points.dtype), down.to(points.dtype), seen


def ball_extent(
    camera_to_world: Tensor,
    points: Tensor,
    radius: float,
    *,
    focal: Tensor,
    lenses: Lenses | None = None,
    stretch: float = 1.0,
) -> Tensor:
    """Extent of a ball around each point in an image, from its centre along either axis.

    Args:
        camera_to_world: Pose of the camera. [4, 4]
        points: Centres in the world. [N, 3]
        radius: Radius of the balls, in world units.
        focal: Focal lengths along x and y in pixels. [2]
        lenses: The camera's lens; a pinhole when None.
        stretch: Largest magnification by the lens's distortion (`Sight.stretch`).

    Returns:
        Upper bounds in pixels; infinity for balls that the camera touches. [N]
    """
    local = camera_axes(camera_to_world, points)
    if lenses is not None:
        across = torch.hypot(focal[0], lenses.skew)
        pixels = stretch * torch.maximum(across, focal[1])
        return (pixels * lenses.ball_extent(local, radius)).to(points.dtype)
    depth = -local[:, 2]
    slant = torch.hypot(depth, local[:, :2].abs().amax(dim=-1))
    extent = focal.max() * radius * slant / (depth * (depth - radius))
    return torch.where(depth > radius, extent, math.inf)


def camera_axes(camera_to_world: Tensor, points: Tensor) -> Tensor:
    """World points in camera coordinates. [N, 3]"""
    return (points - camera_to_world[:3, 3]) @ camera_to_world[:3, :3]


def _pair(value: Tensor | tuple[float, float] | float) -> tuple[Tensor | float, ...]:
    if isinstance(value, Tensor):
        return value.unbind(-1)
    return value if isinstance(value, tuple) else (value, value)


def _like(reference: Tensor, value: Tensor | float) -> Tensor | float:
    """Intrinsics in the precision of rays, which they would otherwise promote."""
    return value.to(reference) if isinstance(value, Tensor) else value


def look_at(position: Tensor, target: Tensor | None = None) -> Tensor:
    """Camera-to-world matrices of cameras at ``position`` that look at ``target``, world z up.

    Args:
        position: Camera centres. [N, 3]
        target: Points at which they look; the origin when None. [N, 3] or [3]

    Returns:
        Poses; for a camera directly above or below its target, up is world y. [N, 4, 4]
    """
    backward = position if target is None else position - target
    backward = backward / backward.norm(dim=-1, keepdim=True)
    up = torch.zeros_like(backward)
    vertical = backward[..., 2].abs() > 1 - 1e-6
    up[..., 2] = (~vertical).to(up.dtype)
    up[..., 1] = vertical.to(up.dtype)
    right = torch.linalg.cross(up, backward, dim=-1)
    right = right / right.norm(dim=-1, keepdim=True)
    pose = torch.eye(4, dtype=position.dtype, device=position.device).repeat(len(position), 1, 1)
    pose[:, :3, 0] = right
    pose[:, :3, 1] = torch.linalg.cross(backward, right, dim=-1)
    pose[:, :3, 2] = backward
    pose[:, :3, 3] = position
    return pose


def upright(up_vectors: Tensor) -> Tensor | None:
    """A rotation of the world after which the cameras' mean up vector is its z axis.

    Args:
        up_vectors: Unit vectors, one for each camera. [V, 3]

    Returns:
        The rotation, in double precision, [3, 3]; None if the up vectors cancel out, such as for
        cameras that look straight down with all headings.
    """
    up = up_vectors.double().mean(dim=0)
    length = up.norm()
    if length < 0.1:
        return None
    x, y, z = (up / length).tolist()
    # If z is negative, rotate by 180 degrees about x first, as the smallest rotation is ill-posed
    # near 180 degrees.
    side = -1.0 if z < 0 else 1.0
    y, z = side * y, side * z
    share = 1 / (1 + z)
    rows = [
        [1 - x * x * share, -x * y * share, -x],
        [-x * y * share, 1 - y * y * share, -y],
        [x, y, z],
    ]
    return torch.tensor(rows, dtype=torch.float64) * torch.tensor([1.0, side, side])


def camera_around(
    azimuth: float, elevation: float, distance: float, target: Tensor | None = None
) -> Tensor:
    """Pose of a camera that faces ``target`` (the origin when None) from a direction.

    Args:
        azimuth: In degrees, from the world's x axis towards y.
        elevation: Elevation above the horizontal plane, in degrees.
        distance: Distance from the target, in world units.
        target: World point at the image centre. [3]

    Returns:
        Camera-to-world matrix in double precision. [4, 4]
    """
    turn, rise = math.radians(azimuth), math.radians(elevation)
    flat = math.cos(rise)
    direction = [math.cos(turn) * flat, math.sin(turn) * flat, math.sin(rise)]
    pose = look_at(distance * torch.tensor([direction], dtype=torch.float64))[0]
    if target is not None:
        pose[:3, 3] += target
    return pose


def orbit(count: int, *, radius: float, elevation: float, target: Tensor | None = None) -> Tensor:
    """Poses evenly spaced on a circle around ``target`` (the origin when None).

    Args:
        count: Number of cameras.
        radius: Distance to the target, in world units.
        elevation: Elevation above the horizontal plane, in degrees.
        target: World point at the image centre. [3]

    Returns:
        Camera-to-world matrices; the first camera is on the -y side. [count, 4, 4]
    """
    azimuth = torch.arange(count) * (2 * math.pi / max(count, 1)) - 0.5 * math.pi
    height = math.radians(elevation)
    offset = radius * torch.stack(
        [
            azimuth.cos() * math.cos(height),
            azimuth.sin() * math.cos(height),
            torch.full_like(azimuth, math.sin(height)),
        ],
        dim=-1,
    )
    centre = torch.zeros(3) if target is None else target
    return look_at(offset + centre, centre)
