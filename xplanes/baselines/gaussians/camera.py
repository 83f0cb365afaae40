"""The camera of the rasteriser: a pinhole with OpenCV axes."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with OpenCV axes: x right, y down, looking along +z.

    Attributes:
        world_to_camera: Rigid transform from world to camera coordinates. [4, 4]
        fx: Focal length along x, in pixels.
        fy: Focal length along y, in pixels.
        cx: Principal point in pixels from the left edge; the first column's centre lies at 0.5.
        cy: Principal point in pixels from the top edge.
        width: Columns of the image.
        height: Rows of the image.
        near: Depth that a Gaussian's mean must exceed to be drawn, in world units.
        far: Depth below which a Gaussian's mean must lie to be drawn, in world units.

    Raises:
        ValueError: If the pose is not [4, 4] or not finite, ``fx``, ``fy``, ``width``, ``height``
            or ``near`` is not positive, or ``far`` does not exceed ``near``.
    """

    world_to_camera: Tensor
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    near: float = 0.01
    far: float = 1e10

    def __post_init__(self) -> None:
        shape = list(self.world_to_camera.shape)
        if shape != [4, 4]:
            raise ValueError(f"camera.world_to_camera is {shape}, but must be [4, 4]")
        if not self.world_to_camera.isfinite().all():
            raise ValueError("camera.world_to_camera is not finite: check the poses of the views")
        for name in ("fx", "fy", "width", "height", "near"):
            if not 0 < getattr(self, name) < float("inf"):
                raise ValueError(f"camera.{name}={getattr(self, name)}: must be positive")
        if self.far <= self.near:
            raise ValueError(f"camera.far={self.far}: must exceed camera.near={self.near}")

    @classmethod
    def from_pose(
        cls,
        camera_to_world: Tensor,
        *,
        focal: Tensor | Sequence[float],
        centre: Tensor | Sequence[float],
        width: int,
        height: int,
        near: float = 0.01,
        far: float = 1e10,
    ) -> "Camera":
        """Convert a pose with OpenGL axes (y up, looking along -z), as in `Views`.

        Args:
            camera_to_world: A rigid pose. [4, 4]
            focal: Focal lengths along x and y, in pixels. [2]
            centre: Principal point in pixels, from the left and the top edge. [2]
            width: Columns of the image.
            height: Rows of the image.
            near: See `Camera`.
            far: See `Camera`.

        Raises:
            ValueError: See `Camera`.
        """
        pose = camera_to_world.double()
        rotation = (pose[:3, :3] * pose.new_tensor([1.0, -1.0, -1.0])).T
        world_to_camera = torch.eye(4, dtype=pose.dtype, device=pose.device)
        world_to_camera[:3, :3] = rotation
        world_to_camera[:3, 3] = -rotation @ pose[:3, 3]
        (fx, fy), (cx, cy) = map(float, focal), map(float, centre)
        return cls(
            world_to_camera.to(camera_to_world.dtype), fx, fy, cx, cy, width, height, near, far
        )

    @property
    def slant(self) -> tuple[float, float, float, float]:
        """Least and largest x/z, then y/z, at which a projection is linearised.

        Values beyond are clamped. The bounds lie 0.15 of the image size beyond each edge: for a
        centred image, 1.3 times the tangent of half the field of view (Kerbl et al. 2023).
        """
        x, y = 0.15 * self.width, 0.15 * self.height
        return (
            -(self.cx + x) / self.fx,
            (self.width - self.cx + x) / self.fx,
            -(self.cy + y) / self.fy,
            (self.height - self.cy + y) / self.fy,
        )
