"""The canonical camera of a Large Reconstruction Model, which it assumes for its input."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class CanonicalView:
    """A model's canonical camera and box. Camera axes are OpenGL's: x right, y up, view along -z.

    Attributes:
        rotation: Rotation from camera axes to the model's frame. 3 rows of 3
        distance: Distance from the camera to the centre of the box, in the model's frame.
        focal: Focal length as a share of the image's width.
        half_side: Half the side of the cube of the model's field.
        background: Grey value, from 0 to 1, behind the object in the model's input.
    """

    rotation: tuple[tuple[float, float, float], ...]
    distance: float
    focal: float
    half_side: float
    background: float

    def rotation_matrix(self) -> Tensor:
        """`rotation` in double precision. [3, 3]"""
        return torch.tensor(self.rotation, dtype=torch.float64)

    def camera_to_world(self) -> Tensor:
        """Pose of the camera in the model's frame, in double precision. [4, 4]"""
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = self.rotation_matrix()
        pose[:3, 3] = self.distance * pose[:3, 2]
        return pose


OPENLRM_VIEW = CanonicalView(
    rotation=((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    distance=2.0,
    focal=0.75,
    half_side=1.0,
    background=1.0,
)
"""At -y, z up. The training data has distances from 1.9 to 2.6 and this focal length only."""

TRIPOSR_VIEW = CanonicalView(
    rotation=((0, 0, 1), (1, 0, 0), (0, 1, 0)),
    distance=1.9,
    focal=0.5 / math.tan(math.radians(20)),
    half_side=0.87,
    background=0.5,
)
"""At +x, z up. Nominal: the model has no camera input."""


def camera_vector(camera_to_world: Tensor, focal: tuple[float, float]) -> Tensor:
    """OpenLRM's camera vector: three rows of the pose, focal lengths, a centred principal point.

    Args:
        camera_to_world: Poses in the model's frame, OpenGL camera axes. [N, 4, 4] or [N, 3, 4]
        focal: Along x and y, as shares of the image's width and height.

    Returns:
        One vector per camera. [N, 16]

    Source: OpenLRM 1.1.
    """
    poses = camera_to_world[:, :3].flatten(1)
    intrinsics = poses.new_tensor([*focal, 0.5, 0.5])
    return torch.cat([poses, intrinsics.expand(len(poses), -1)], dim=1)


def canonical_vector(view: CanonicalView = OPENLRM_VIEW) -> Tensor:
    """OpenLRM's camera vector of the canonical camera. [16]"""
    return camera_vector(view.camera_to_world()[None], (view.focal, view.focal))[0].float()
