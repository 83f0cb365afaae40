"""Published bounds of baselines (a cube around the origin, near and far), checked on a scene."""

import logging

import torch

from xplanes.errors import ConfigError, SceneError
from xplanes.rendering.sampler import Site
from xplanes.scenes.frame import NO_HINTS, CubeHints, Frame, cube_frame, scene_frame
from xplanes.scenes.views import Views

logger = logging.getLogger(__name__)


def origin_cube(half_side: float, views: Views, hints: CubeHints = NO_HINTS) -> Frame:
    """A cube around the world's origin; warns if the scene seems to have another size.

    Args:
        half_side: Half the side of the cube, in world units.
        views: Training views.
        hints: Known properties of the scene's cube; the user must not have set its side or centre.

    Raises:
        ConfigError: If the user has set the scene's cube as well.
    """
    for name in ("half_side", "centre"):
        if (given := getattr(hints, name)) is not None:
            raise ConfigError(
                f"data.{name}={given} with model.half_side={half_side}: both set the cube; set "
                f"model.half_side=null to use data.{name}, or leave data.{name} out"
            )
    try:
        scene = scene_frame(views)
    except SceneError:
        return cube_frame(half_side, torch.zeros(3), "model.half_side")
    if not fits_origin_cube(half_side, scene):
        logger.warning(
            "model.half_side=%g: the scene reaches %.3g world units from the origin; set it to "
            "about that, or to null for the scene's own cube",
            half_side,
            _reach(scene),
        )
    return cube_frame(half_side, torch.zeros(3), "model.half_side")


def fits_origin_cube(half_side: float, scene: Frame) -> bool:
    """Whether a cube around the world's origin has about the size of a scene.

    Args:
        half_side: Half the side of the cube, in world units.
        scene: The scene's cube.
    """
    # A scene that fills the cube's corners extends sqrt(3) times as far as its faces.
    return half_side / 4 < _reach(scene) < half_side * 3**0.5


def _reach(scene: Frame) -> float:
    """Largest distance of a scene from the world's origin."""
    return 1 / scene.scale + float(scene.centre.norm())


def seen_range(views: Views, scene: Frame) -> tuple[float, float]:
    """Least and largest distance of a scene from its cameras, in world units.

    Args:
        views: Training views.
        scene: The scene's cube, whose inscribed ball contains the content.
    """
    away = (views.camera_to_world[:, :3, 3] - scene.centre).norm(dim=-1)
    return max(float(away.min()) - 1 / scene.scale, 0.0), float(away.max()) + 1 / scene.scale


def check_range(site: Site, near: float, far: float) -> None:
    """Refuse near and far if the centre of the field's box does not lie between them.

    Warns if a part of the scene does not.

    Raises:
        ConfigError: With the cameras' distances.
    """
    if site.views is None:
        return
    centre = site.frame.centre if site.bounds is None else site.bounds.mean(dim=0)
    away = (site.views.camera_to_world[:, :3, 3] - centre).norm(dim=-1)
    nearest, farthest = float(away.min()), float(away.max())
    if nearest <= near or farthest >= far:
        raise ConfigError(
            f"model.sampler.near={near} with model.sampler.far={far}: the cameras stand "
            f"{nearest:.3g} to {farthest:.3g} world units from the centre of the field's box; set "
            "both to numbers around these"
        )
    if site.bounds is not None:
        return  # The box is larger than the scene.
    least, most = seen_range(site.views, site.frame)
    if least < near or most > far:
        logger.warning(
            "model.sampler.near=%g with model.sampler.far=%g: the scene is %.3g to %.3g world "
            "units from the cameras, and nothing is sampled outside the bounds; set them to these",
            *(near, far, least, most),
        )
