"""The field's frame: the map from the world into the cube [-1, 1]^3."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from xplanes.errors import SceneError
from xplanes.scenes.cameras import cast_rays, project, turned
from xplanes.scenes.views import Views

MARGIN = 1.03
"""Margin around the farthest visible content."""

MIDDLE = 0.6
"""Share of an image's width and height that counts as its middle."""

OUTLIERS = 0.02
"""Share of points that the cube may leave out at either end of an axis."""

ROOM = 1.15
"""Margin around points: they are sparse, in particular on moving content."""

LEAST_POINTS, MOST_POINTS, MOST_CAMERAS = 32, 20_000, 64
"""Least number of points in the images' middle; largest numbers of sampled points and cameras."""

CONVERGENCE = 0.02
"""Least eigenvalue for which optical axes meet in a point, rather than being nearly parallel."""


@dataclass(frozen=True)
class CubeHints:
    """Information about a scene's cube other than its views.

    Attributes:
        half_side: Half the cube's side in world units; estimated when None.
        centre: Its centre in world coordinates; estimated when None. [3]
        points: World points on surfaces, if known. [N, 3]
    """

    half_side: float | None = None
    centre: Sequence[float] | None = None
    points: Tensor | None = None

    @property
    def is_given(self) -> bool:
        """Whether the user has set a part of the cube."""
        return self.half_side is not None or self.centre is not None


NO_HINTS = CubeHints()


@dataclass(frozen=True)
class Frame:
    """A similarity from the world to the field's frame: ``scale * rotation @ (p - centre)``.

    Attributes:
        scale: Field units per world unit.
        rotation: Rotation from the world's axes to the field's. [3, 3]
        centre: World point that is mapped to the origin. [3]
        source: Source of the cube's estimate; empty if unknown.
    """

    scale: float
    rotation: Tensor
    centre: Tensor
    source: str = ""

    def to(self, device: torch.device) -> "Frame":
        """The frame on another device."""
        return replace(self, rotation=self.rotation.to(device), centre=self.centre.to(device))

    def points(self, world: Tensor) -> Tensor:
        """World points in the field's frame. [..., 3]"""
        return turned(self.scale * (world - self.centre), self.rotation)

    def rays(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Rays in the field's frame; directions keep their length. [R, 3], [R, 3]"""
        return self.points(origins), turned(directions, self.rotation)

    def to_world(self, points: Tensor) -> Tensor:
        """Points of the field's frame in the world. [..., 3]"""
        return turned(points, self.rotation.T) / self.scale + self.centre


@dataclass(frozen=True)
class CameraGroups:
    """The training views grouped by pose, and the positions of the groups.

    Attributes:
        index: Group of each view. int64 [V]
        places: Position of each group's camera, in the field's frame. [C, 3]
        poses: Its pose in the world; empty in checkpoints of version 0.2. [C, 4, 4]
    """

    index: Tensor
    places: Tensor
    poses: Tensor = field(default_factory=lambda: torch.zeros(0, 4, 4))

    @classmethod
    def of(cls, views: Views, frame: Frame) -> "CameraGroups":
        """The groups of the training views; all images of a fixed camera form one group."""
        poses, index = views.camera_to_world.unique(dim=0, return_inverse=True)
        return cls(index, frame.points(poses[:, :3, 3].float()), poses)


def frame_content(frame: Frame) -> dict[str, Any]:
    """A frame as tensors and builtins, for files."""
    return {"scale": frame.scale, "rotation": frame.rotation, "centre": frame.centre}


def read_frame(content: Any, name: str) -> Frame:
    """A frame from the result of `frame_content`, with tensors or lists.

    Raises:
        SceneError: If it is not a frame; ``name`` is its source in the message.
    """
    try:
        scale = float(content["scale"])
        rotation = torch.as_tensor(content["rotation"], dtype=torch.float32)
        centre = torch.as_tensor(content["centre"], dtype=torch.float32)
    except (KeyError, TypeError, ValueError, RuntimeError, IndexError) as error:
        raise SceneError(
            f"{name}: frame must be a dict of scale, rotation [3, 3] and centre [3] "
            f"({type(error).__name__}: {error})"
        ) from error
    frame = Frame(scale, rotation, centre)
    check_frame(frame, name)
    return frame


def check_frame(frame: Frame, name: str) -> None:
    """Refuse a frame that is not a similarity.

    Raises:
        SceneError: For wrong shapes or numbers; ``name`` is its source in the message.
    """
    if frame.rotation.shape != (3, 3) or frame.centre.shape != (3,):
        raise SceneError(
            f"{name}: frame.rotation is {list(frame.rotation.shape)} and frame.centre "
            f"{list(frame.centre.shape)}, but must be [3, 3] and [3]"
        )
    if not (math.isfinite(frame.scale) and frame.scale > 0):
        raise SceneError(f"{name}: frame.scale={frame.scale}: must be finite and above 0")
    if not frame.centre.isfinite().all():
        raise SceneError(f"{name}: frame.centre={frame.centre.tolist()}: must be finite")
    rotation = frame.rotation.double()
    gap = (rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max()
    # The negated comparison also refuses NaN.
    if not gap < 1e-3 or torch.linalg.det(rotation) < 0:
        raise SceneError(f"{name}: frame.rotation is not a rotation (orthonormal, determinant 1)")


def cube_frame(half_side: float, centre: Tensor, source: str = "") -> Frame:
    """The frame that maps a world-aligned cube to [-1, 1]^3."""
    return Frame(1 / half_side, torch.eye(3), centre, source)


def backwards(views: Views) -> Tensor:
    """Unit vectors opposite to the viewing direction at each image's centre. [V, 3]

    These are the cameras' z axes if principal points are centred.
    """
    intrinsics = views.intrinsics
    rows, columns = (0.5 * intrinsics.size.double() - 0.5).unbind(dim=1)
    _, directions = cast_rays(
        views.camera_to_world.double(),
        rows,
        columns,
        focal=intrinsics.focal,
        centre=intrinsics.centre,
        lenses=intrinsics.lenses,
    )
    return -directions.float()


def optical_centre(views: Views) -> Tensor:
    """The point nearest to the central rays of all images, in the least-squares sense. [3]

    For parallel cameras the depth is undetermined; the depth of the world's origin is used.
    """
    origin, projector = views.camera_to_world[:, :3, 3].double(), _projectors(views)
    target = (projector @ origin[..., None])[..., 0].mean(dim=0)
    # The pseudo-inverse selects the solution nearest to the origin.
    inverse = torch.linalg.pinv(projector.mean(dim=0), atol=1e-4, hermitian=True)
    return (inverse @ target).float()


def axes_meet(views: Views) -> bool:
    """Whether the central rays of the images meet in a point, rather than being nearly parallel."""
    return float(torch.linalg.eigvalsh(_projectors(views).mean(dim=0))[0]) >= CONVERGENCE


def _projectors(views: Views) -> Tensor:
    """Projections onto the planes perpendicular to the optical axes. float64 [V, 3, 3]"""
    axis = backwards(views).double()
    return torch.eye(3, dtype=torch.float64) - axis[:, :, None] * axis[:, None, :]


def scene_frame(views: Views, hints: CubeHints = NO_HINTS) -> Frame:
    """The frame of a scene: the smallest cube that its cameras and silhouettes allow.

    The cameras' common field of view gives a first cube around the point at which they look. The
    distance of the farthest foreground ray from the centre is a lower bound of the scene's radius,
    and a close one for views from many sides. This bound, with a margin, shrinks the cube: less for
    views from one side, which constrain the depth less. For opaque images, which have no
    silhouettes, the cube encloses the points in the middle of most images, if enough are known.

    Args:
        views: Training views.
        hints: Known parts of the cube, and surface points.

    Raises:
        SceneError: If the cameras see no common volume.
    """
    centre, seen = optical_centre(views), None
    if hints.points is not None and views.is_opaque:
        seen = _middle_box(views, hints.points, centre)
    if seen is not None:
        centre = seen.mean(dim=0)
    given = ""
    if hints.centre is not None:
        centre, given = torch.tensor(hints.centre, dtype=torch.float32), "data.centre and "
    if hints.half_side is not None:
        return cube_frame(hints.half_side, centre, f"{given}data.half_side")
    offset = views.camera_to_world[:, :3, 3] - centre
    depth = (offset * views.camera_to_world[:, :3, 2]).sum(dim=-1)
    extent = (0.5 * views.intrinsics.size.flip(1) / views.intrinsics.pinhole).amax(dim=1)
    half = float((depth.clamp_min(0) * extent.float()).max())
    if not math.isfinite(half) or half <= 0:
        raise SceneError(
            "the cameras look away from one another, so the scene's bounds cannot be found. Poses "
            "must be camera-to-world with OpenGL axes: for OpenCV axes (y down, z forward), negate "
            "the second and third column of every pose; invert world-to-camera poses. If the poses "
            "are right, set data.half_side and data.centre, in world units"
        )
    if seen is not None:
        reach = (seen - centre).abs().max()
        return cube_frame(min(half, float(reach)), centre, f"{given}points")
    spread = _spread(views)
    reach = MARGIN * _reach(views, centre) / spread if spread > 0 else math.inf
    source = "cameras" if half <= reach or views.is_opaque else "cameras and silhouettes"
    return cube_frame(min(half, reach), centre, f"{given}{source}")


def pixels_across(views: Views, frame: Frame) -> float:
    """Number of image pixels across the cube at its centre, in the median view.

    Args:
        views: Training views.
        frame: The field's frame.
    """
    distance = (views.camera_to_world[:, :3, 3] - frame.centre).double().norm(dim=-1)
    # A camera near the centre sees the content of the cube around itself.
    distance = distance.clamp_min(0.5 / frame.scale)
    pixel = distance / views.intrinsics.pinhole.amax(dim=1)
    return float((2 / frame.scale / pixel).median())


def _middle_box(views: Views, points: Tensor, centre: Tensor) -> Tensor | None:
    """The box, with a margin, of points that most cameras see in the middle of their images.

    Args:
        views: Training views.
        points: World points. [N, 3]
        centre: Point at which the cameras look; the box must contain it if their axes meet. [3]

    Returns:
        Lower and upper corner; None if there is no such box. [2, 3]
    """
    points = points[points.isfinite().all(dim=1)]
    points = points[:: -(-len(points) // MOST_POINTS) or 1]
    cameras = range(0, len(views), -(-len(views) // MOST_CAMERAS))
    count = torch.zeros(len(points))
    for index in cameras:
        column, row, seen = project(
            views.camera_to_world[index],
            points,
            focal=views.intrinsics.focal[index],
            centre=views.intrinsics.centre[index],
            lenses=views.intrinsics.lens(index),
        )
        height, width = views.size(index)
        across, down = (column / width - 0.5).abs(), (row / height - 0.5).abs()
        count += seen & (across < 0.5 * MIDDLE) & (down < 0.5 * MIDDLE)
    points = points[count > 0.5 * len(cameras)]
    if len(points) < LEAST_POINTS:
        return None
    low, high = points.quantile(torch.tensor([OUTLIERS, 1 - OUTLIERS]), dim=0)
    box = torch.stack([low, high])
    box = box.mean(dim=0) + ROOM * (box - box.mean(dim=0))
    half = 0.5 * (box[1] - box[0]).max()
    left_out = bool(((centre - box.mean(dim=0)).abs() > half).any())
    return None if half <= 0 or (left_out and axes_meet(views)) else box


def _spread(views: Views) -> float:
    """How well the views show the worst-shown direction: its foreshortening in the best view.

    It is nearly 1 for views from all sides, small for views from one side, which foreshorten depth,
    and 0 for views along a single axis.
    """
    axis = backwards(views).double()
    common = torch.linalg.eigh(axis.T @ axis).eigenvectors.T
    cosine = torch.cat([axis, common]) @ axis.T
    shown = (1 - cosine.square()).clamp_min(0).sqrt().amax(dim=1).min()
    return float(shown) if shown > 1e-3 else 0.0


def _reach(views: Views, centre: Tensor) -> float:
    """Largest distance between ``centre`` and a ray through the foreground.

    The distance grows with the angle between the ray and the direction to the centre, up to a right
    angle. The farthest ray thus passes through the outline of the silhouette.
    """
    largest = 0.0
    for index in range(len(views)):
        origins, directions = views.outline_rays(index)
        if len(origins):
            offset = centre - origins
            along = (offset * directions).sum(dim=-1, keepdim=True)
            away = (offset - along * directions).norm(dim=-1)
            # If rays lie on both sides of a right angle, the largest distance is the camera's.
            beyond = bool((along > 0).any() and (along < 0).any())
            largest = max(largest, float((offset.norm(dim=-1) if beyond else away).max()))
    return largest if largest > 0 else math.inf
