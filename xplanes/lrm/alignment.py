"""From the world of a scene to the frame of a Large Reconstruction Model.

A model predicts in its own frame and assumes that the image was taken by its canonical camera. A
similarity transform maps the real source camera to that camera. If the focal lengths differ, no
similarity is exact; the remaining error is reported in pixels.
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.errors import LRMError
from xplanes.lrm.canonical import CanonicalView
from xplanes.lrm.images import Crop, square_crop
from xplanes.scenes.frame import Frame

MOST = 2.0
"""Largest growth factor of a cube: the model predicts nothing far outside its own cube."""


def fit_cube(triplanes: Tensor, half_side: float, wanted: float) -> tuple[Tensor, float]:
    """Pad or crop the planes on all sides to another cube.

    The field does not change inside both cubes. Padding repeats the border texels.

    Args:
        triplanes: Planes xy, xz, yz. [T, 3, C, H, H]
        half_side: Half the side of their cube.
        wanted: Half the side of the cube that they must contain.

    Returns:
        The planes, and half the side of their cube: ``wanted``, at most `MOST` times as large as
        before, rounded up to whole texels. [T, 3, C, H', H']
    """
    size = triplanes.shape[-1]
    texel = 2 * half_side / size
    span = min(wanted, MOST * half_side)
    # A tolerance, so that rounding errors do not add a texel.
    texels = math.ceil((span - half_side) / texel - 1e-6)
    if not texels:
        return triplanes, half_side
    flat = triplanes.flatten(0, 1)
    if texels > 0:
        flat = F.pad(flat, (texels,) * 4, mode="replicate")
    else:
        flat = flat[..., -texels:texels, -texels:texels]
    return flat.unflatten(0, triplanes.shape[:2]), half_side + texels * texel


Matching = Literal["scale", "pad"]


@dataclass(frozen=True)
class Mismatch:
    """Distance between the projections of points into the source and the canonical camera.

    Attributes:
        largest: Largest distance in pixels.
        mean: Mean distance in pixels.
    """

    largest: float
    mean: float


@dataclass(frozen=True)
class Alignment:
    """Alignment of the model's frame with the world.

    Attributes:
        frame: Map from the world to the model's frame.
        half_side: Half the side of the model's cube, in its frame; the field is empty outside.
        crop: Square of the source image that is the model's input.
        mismatch: Remaining error of the similarity.
    """

    frame: Frame
    half_side: float
    crop: Crop
    mismatch: Mismatch

    @property
    def field_frame(self) -> Frame:
        """Frame that maps the model's cube in the world to the field's cube [-1, 1]^3."""
        return Frame(self.frame.scale / self.half_side, self.frame.rotation, self.frame.centre)


def align(
    camera_to_world: Tensor,
    *,
    focal: float,
    height: int,
    width: int,
    target: Tensor,
    view: CanonicalView,
    matching: Matching = "scale",
    crop: Crop | None = None,
) -> Alignment:
    """Align a model's frame with the world so that its camera matches the source camera.

    Args:
        camera_to_world: Pose of the source camera. [4, 4]
        focal: Its focal length in pixels.
        height: Height of its images in pixels.
        width: Width of its images in pixels.
        target: Centre of the scene in world coordinates. Only its depth is used, because the model
            expects the object at the centre of the image. [3]
        view: The model's own camera and box.
        matching: How to treat a focal length other than the model's. "scale" uses the image as it
            is; sizes agree at the depth of the target. "pad" first adds a margin, so that the focal
            length relative to the image side equals the model's: exact geometry, but fewer pixels
            on the object.
        crop: Square of the image that is the model's input; the smallest square around the image
            when None.

    Returns:
        The alignment; apply its ``crop`` to the images before preparing them for the model.

    Raises:
        LRMError: If the target is behind the camera, the camera would be inside the model's box, or
            both "pad" and a crop are given.
    """
    pose, middle = camera_to_world.double(), target.double()
    depth = float((middle - pose[:3, 3]) @ -pose[:3, 2])
    if depth <= 0:
        raise LRMError(f"the target is behind the source camera: {target.tolist()}")
    if crop is not None and matching == "pad":
        raise LRMError('matching="pad" makes its own crop: give crop=None, or matching="scale"')
    if crop is None:
        crop = square_crop(height, width)
        if matching == "pad":
            crop = square_crop(height, width, zoom=view.focal * crop.side / focal)
    share = focal / crop.side
    scale = view.distance * share / (depth * view.focal)
    if scale * depth <= view.half_side:
        raise LRMError(
            f"a focal length of {focal:g} pixels is too short for this model: the camera would "
            f'be inside its box; use matching="pad" or a source camera with a focal length of '
            f"{view.focal:g} of the image side"
        )
    # The point at the target's depth on the ray through the centre of the crop.
    right = (crop.left + 0.5 * crop.side - 0.5 * width) / focal
    down = (crop.top + 0.5 * crop.side - 0.5 * height) / focal
    ray = pose.new_tensor([right, -down, -1.0])
    centre = pose[:3, 3] + depth * (pose[:3, :3] @ ray)
    rotation = view.rotation_matrix() @ pose[:3, :3].T
    frame = Frame(scale, rotation.float(), centre.float())
    return Alignment(frame, view.half_side, crop, focal_mismatch(view, share, crop.side))


def focal_mismatch(view: CanonicalView, share: float, side: int) -> Mismatch:
    """Distance between projections into source and canonical camera, after "scale" matching.

    The points are those of the ball inside the model's box that the source image shows.

    Args:
        view: The model's own camera and box.
        share: Focal length of the source camera as a share of the crop's side.
        side: The crop's side in pixels.
    """
    reach = view.half_side
    line = torch.linspace(-reach, reach, 41, dtype=torch.float64)
    right, up, back = torch.meshgrid(line, line, line, indexing="ij")
    inside = right**2 + up**2 + back**2 <= reach**2 * (1 + 1e-9)
    lateral, back = torch.stack([right, up])[:, inside], back[inside]
    source_distance = view.distance * share / view.focal
    seen = lateral * share / (source_distance - back)
    predicted = lateral * view.focal / (view.distance - back)
    apart = (seen - predicted).norm(dim=0)[(seen.abs() <= 0.5).all(dim=0)] * side
    return Mismatch(float(apart.max()), float(apart.mean()))
