"""Pictures of the viewer: a field from any camera, optionally cropped, and its floaters."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from xplanes.rendering.base import RayRenderer, Renderer
from xplanes.rendering.box import snapshot
from xplanes.rendering.grid_renderer import GridRenderer
from xplanes.rendering.pictures import depth_picture
from xplanes.scenes.cameras import PosedCamera
from xplanes.scenes.frame import Frame
from xplanes.scenes.silhouettes import may_hold
from xplanes.scenes.views import Views, spread
from xplanes.training.scores import VISIBLE

MODES = ("colour", "depth", "opacity", "floaters")

NEAREST = 4  # Number of training images, nearest in time, whose silhouettes identify floaters.

SLACK = 0.02
"""Margin around silhouettes, in the field's frame, within which nothing counts as a floater."""

RED = (0.9, 0.1, 0.1)


@dataclass(frozen=True)
class Shot:
    """Camera, time and mode, one of `MODES`, of a picture.

    Attributes:
        pose: Camera-to-world matrix, in the field's frame. [4, 4]
        time: From 0 to 1.
        fov: Vertical field of view, in radians.
        height: Rows.
        aspect: Columns per row.
        box: Least and largest corner of the crop, in the field's frame; None for all. [2, 3]
    """

    pose: Tensor
    time: float
    fov: float
    height: int
    aspect: float
    mode: str = "colour"
    box: Tensor | None = None

    @property
    def width(self) -> int:
        """Columns."""
        return max(1, round(self.height * self.aspect))

    @property
    def camera(self) -> PosedCamera:
        """The camera, in the field's frame."""
        focal = 0.5 * self.height / math.tan(0.5 * self.fov)
        return PosedCamera(self.pose, focal, self.height, self.width)


@dataclass(frozen=True)
class Picture:
    """A picture with its depth.

    Attributes:
        colours: From 0 to 1. [H, W, 3]
        depth: Distance along the optical axis where the opacity is at least 0.5; infinity
            elsewhere. [H, W]
    """

    colours: Tensor
    depth: Tensor


def draw(
    field: Any,
    renderer: Renderer,
    shot: Shot,
    *,
    views: Views,
    frame: Frame,
    background: Tensor,
    at_once: int = 8192,
    stop: Callable[[], bool] = lambda: False,
) -> Picture | None:
    """Render a picture.

    Args:
        field: The field.
        renderer: The renderer.
        shot: Camera, time and mode.
        views: Training views, whose silhouettes identify floaters.
        frame: The field's frame.
        background: Background colour. [3]
        at_once: Rays per call of ``stop``, with a `RayRenderer`.
        stop: Function that returns whether to abandon the picture.

    Returns:
        The picture on the CPU; None once ``stop`` returns true.
    """
    device, box = renderer.device, shot.box
    field = snapshot(field, shot.time)
    background = background.to(device)
    shown, solid = field, renderer
    if box is not None or shot.mode == "floaters":
        # The grid's surfaces may be cropped away, and then they must not occlude anything.
        solid = replace(renderer, occlusion=0.0) if isinstance(renderer, GridRenderer) else renderer
    if box is not None:
        shown = field.masked(in_box(box.to(device)))
    outside = None
    if shot.mode == "floaters":
        outside = shown.masked(ruled_out(views, frame, shot.time))
    origins, directions = shot.camera.rays()
    moved = shift(renderer, shot.pose[:3, 3], views, frame)
    at_once = at_once if isinstance(renderer, RayRenderer) else len(origins)
    parts: list[Tensor] = []
    origins = origins + moved * directions
    for rays in zip(origins.split(at_once), directions.split(at_once), strict=True):
        if stop():
            return None
        given = rays[0].to(device), rays[1].to(device), shot, background
        seen = _seen(solid if box is not None else renderer, shown, *given)
        columns = [seen["colour"], seen["opacity"][:, None], seen["depth"][:, None]]
        if outside is not None:
            columns.append(_seen(solid, outside, *given)["opacity"][:, None])
        parts.append(torch.cat(columns, dim=1).float().cpu())
    image = torch.cat(parts).view(shot.height, shot.width, -1)
    colours, opacity, depth = image[..., :3], image[..., 3], image[..., 4] + moved
    forward = (directions @ -shot.pose[:3, 2]).view_as(depth)
    if shot.mode == "depth":
        colours = depth_picture(depth, opacity)
    elif shot.mode == "opacity":
        colours = opacity[..., None].expand_as(colours)
    elif outside is not None:
        colours = mark(colours, image[..., 5])
    nearest = torch.where(opacity >= 0.5, depth * forward, torch.inf)
    return Picture(colours.clamp(0, 1), nearest)


def _seen(
    renderer: Renderer,
    field: Any,
    origins: Tensor,
    directions: Tensor,
    shot: Shot,
    background: Tensor,
) -> dict[str, Tensor]:
    """Render rays of a shot; a renderer that is no `RayRenderer` renders the whole picture."""
    if isinstance(renderer, RayRenderer):
        return renderer.image(field, origins, directions, shot.time, background)
    frame = Frame(1.0, torch.eye(3), torch.zeros(3))
    image = renderer.view(field, frame, shot.camera, shot.time, background)
    return {name: value.flatten(0, 1) for name, value in image.items()}


def shift(renderer: Renderer, position: Tensor, views: Views, frame: Frame) -> float:
    """Distance by which to move ray origins for a renderer with near and far bounds.

    The bounds fit cameras as far from the scene as the training cameras; at other distances they
    would cut the scene off. Origins are moved backwards by at most the near bound.

    Args:
        renderer: The renderer; its ``near``, in the field's frame, is used if it has one.
        position: Position of the camera, in the field's frame. [3]
        views: Training views.
        frame: The field's frame.
    """
    near = getattr(renderer, "near", None)
    if near is None:
        return 0.0
    usual = frame.points(views.camera_to_world[:, :3, 3]).norm(dim=-1).median()
    return max(float(position.norm() - usual), -near)


def mark(colours: Tensor, share: Tensor) -> Tensor:
    """A pale grey picture with visible floaters in red.

    Args:
        colours: The picture. [H, W, 3]
        share: Opacity of the floaters. [H, W]
    """
    grey = (0.4 + 0.6 * colours.mean(dim=-1, keepdim=True)).expand_as(colours)
    strength = torch.where(share > VISIBLE, 0.5 + 0.5 * share, 0)[..., None]
    return torch.lerp(grey, colours.new_tensor(RED).expand_as(colours), strength)


def in_box(box: Tensor) -> Callable[[Tensor], Tensor]:
    """A function that returns which points [N, 3] are in a box [2, 3]."""
    return lambda points: ((points >= box[0]) & (points <= box[1])).all(dim=-1)


def ruled_out(views: Views, frame: Frame, time: float) -> Callable[[Tensor], Tensor]:
    """A function that returns which points [N, 3] of the field's frame are outside of silhouettes.

    The silhouettes are those of the training images nearest in time, or of evenly spaced ones in a
    static scene. Points out of their view, or within `SLACK` of a silhouette, are not ruled out.
    """
    if views.is_static:
        chosen = torch.tensor(spread(NEAREST, len(views)))
    else:
        chosen = (views.times - time).abs().argsort(stable=True)[:NEAREST]
    near, radius = views.subset(chosen), SLACK / frame.scale

    def found(points: Tensor) -> Tensor:
        held = may_hold(near, frame.to_world(points.cpu()), radius=radius).all(dim=0)
        return ~held.to(points.device)

    return found
