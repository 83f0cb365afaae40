"""From the world of a scene to the frame of a Large Reconstruction Model.

A model predicts in its own frame, as if its image came from its own camera. A similarity takes the
real source camera there. Where the focal lengths differ no similarity is exact, because perspective
is stronger for the shorter one; what remains is reported in pixels.
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.lrm.canonical import CanonicalView
from xplanes.lrm.errors import LRMError
from xplanes.lrm.images import Crop, square_crop
from xplanes.scenes.frame import Frame

MOST = 2.0
"""A cube grows by this factor at most: what lies beyond is not the model's to say."""


def fit_cube(triplanes: Tensor, half_side: float, wanted: float) -> tuple[Tensor, float]:
    """Add or take texels on all sides until the planes span another cube.

    Inside both cubes the field stays the same function. What is added continues the border texels.

    Args:
        triplanes: Planes xy, xz, yz. [T, 3, C, H, H]
        half_side: Half the side of the cube that they span.
        wanted: Half the side of the cube that they are to hold.

    Returns:
        The planes, and half the side of their cube: ``wanted``, rounded up to whole texels.
        [T, 3, C, H', H']
    """
    size = triplanes.shape[-1]
    texel = 2 * half_side / size
    span = min(wanted, MOST * half_side)
    # A hair more than a whole number of texels is that number.
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
    """How far the source picture and the model's own picture of one scene lie apart.

    Attributes:
        largest: Largest distance in pixels.
        mean: Mean distance in pixels.
        radius: Points considered: those within this distance of the centre, in the model's frame,
            that the source camera sees.
    """

    largest: float
    mean: float
    radius: float


@dataclass(frozen=True)
class Alignment:
    """Where the model's field lies in the world.

    Attributes:
        frame: From the world to the model's frame.
        half_side: Half the side of the model's cube, in its frame; there is nothing outside.
        crop: The square of the source picture that the model is shown.
        mismatch: What the similarity cannot make good.
    """

    frame: Frame
    half_side: float
    crop: Crop
    mismatch: Mismatch

    @property
    def density_factor(self) -> float:
        """Density per unit of the world for one per unit of the model's frame."""
        return self.frame.scale

    @property
    def field_frame(self) -> Frame:
        """From the world to the field's cube [-1, 1]^3, which is the model's cube."""
        return Frame(self.frame.scale / self.half_side, self.frame.rotation, self.frame.centre)

    @property
    def field_density_factor(self) -> float:
        """Density per unit of the field's cube for one per unit of the model's frame."""
        return self.half_side


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
    """Place a model's frame in the world so that its picture is the source camera's.

    Args:
        camera_to_world: Pose of the source camera. [4, 4]
        focal: Its focal length in pixels.
        height: Height of its pictures in pixels.
        width: Width of its pictures in pixels.
        target: World point in the middle of the scene; only its depth counts, as the model expects
            the object in the middle of its picture. [3]
        view: The model's own camera and box.
        matching: How to meet a focal length that is not the model's. "scale" shows the model the
            picture as it is and makes sizes agree at the target's depth. "pad" first adds a margin
            until the focal length, as a share of the picture's side, is the model's: exact
            geometry, fewer pixels on the object.
        crop: Square of the picture that the model is shown; the smallest square around the picture
            when None.

    Returns:
        The alignment; apply its ``crop`` to the pictures before preparing them for the model.

    Raises:
        LRMError: If the target is behind the camera, the camera would stand inside the model's box,
            or both "pad" and a crop are asked for.
    """
    pose, middle = camera_to_world.double(), target.double()
    depth = float((middle - pose[:3, 3]) @ -pose[:3, 2])
    if depth <= 0:
        raise LRMError(f"the source camera looks away from the target {target.tolist()}")
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
            f'stand inside its box; use matching="pad" or a source camera with a focal length of '
            f"{view.focal:g} of the picture's side"
        )
    # The ray through the middle of what the model sees, followed to the target's depth.
    right = (crop.left + 0.5 * crop.side - 0.5 * width) / focal
    down = (crop.top + 0.5 * crop.side - 0.5 * height) / focal
    ray = pose.new_tensor([right, -down, -1.0])
    centre = pose[:3, 3] + depth * (pose[:3, :3] @ ray)
    rotation = view.rotation_matrix() @ pose[:3, :3].T
    frame = Frame(scale, rotation.float(), centre.float())
    return Alignment(frame, view.half_side, crop, focal_mismatch(view, share, crop.side))


def focal_mismatch(
    view: CanonicalView, share: float, side: int, *, radius: float | None = None
) -> Mismatch:
    """Distance between where source camera and model see the same point, after "scale" matching.

    Args:
        view: The model's own camera and box.
        share: Focal length of the source camera, as a share of the side of what the model sees.
        side: That side in pixels.
        radius: Points within this distance of the centre are considered, in the model's frame; half
            the side of the box when None.

    Returns:
        The largest and the mean distance over these points.
    """
    reach = view.half_side if radius is None else radius
    line = torch.linspace(-reach, reach, 41, dtype=torch.float64)
    right, up, back = torch.meshgrid(line, line, line, indexing="ij")
    inside = right**2 + up**2 + back**2 <= reach**2 * (1 + 1e-9)
    lateral, back = torch.stack([right, up])[:, inside], back[inside]
    source_distance = view.distance * share / view.focal
    seen = lateral * share / (source_distance - back)
    predicted = lateral * view.focal / (view.distance - back)
    apart = (seen - predicted).norm(dim=0)[(seen.abs() <= 0.5).all(dim=0)] * side
    return Mismatch(float(apart.max()), float(apart.mean()), reach)
