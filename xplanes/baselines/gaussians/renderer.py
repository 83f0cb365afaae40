"""Renders Gaussians, for training and for images."""

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from xplanes.baselines.gaussians.camera import Camera
from xplanes.baselines.gaussians.field import Gaussians
from xplanes.baselines.gaussians.harmonics import spherical_harmonics
from xplanes.baselines.gaussians.rasteriser import RasterisedImage, rasterise
from xplanes.errors import SceneError
from xplanes.rendering.base import Renderer, Rendering
from xplanes.rendering.marching import Samples
from xplanes.rendering.sampler import Sampler, SamplerSettings, Site
from xplanes.scenes.batches import Batch
from xplanes.scenes.cameras import PosedCamera
from xplanes.scenes.frame import Frame
from xplanes.streams import TrainingState


def camera_in(frame: Frame, camera: PosedCamera) -> Camera:
    """Convert a camera in the world to the rasteriser's, in a field's frame.

    Raises:
        SceneError: If its lens distorts the image.
    """
    if camera.lens is not None:
        raise SceneError(
            "the images have lens distortion, but Gaussians are rasterised with pinhole cameras "
            "only: undistort the images (COLMAP's image_undistorter), or choose a model that "
            "renders rays, such as model=six_planes"
        )
    pose = torch.eye(4)
    pose[:3, :3] = frame.rotation @ camera.camera_to_world[:3, :3]
    pose[:3, 3] = frame.points(camera.camera_to_world[:3, 3])
    focal, centre = camera.focal, camera.centre
    return Camera.from_pose(
        pose,
        focal=focal if isinstance(focal, Tensor) else (focal, focal),
        centre=(0.5 * camera.width, 0.5 * camera.height) if centre is None else centre,
        width=camera.width,
        height=camera.height,
    )


@dataclass(frozen=True)
class RasterisedRendering(Rendering):
    """A rendering of all pixels of a view.

    Attributes:
        image: The rasteriser's result.
    """

    image: RasterisedImage


class GaussianRenderer(Renderer):
    """Projects and blends Gaussians.

    Args:
        field: The Gaussians.
        antialiased: See `rasterise`.
    """

    def __init__(self, field: Gaussians, *, antialiased: bool) -> None:
        self.field, self.antialiased = field, antialiased

    @property
    def device(self) -> torch.device:
        return self.field.means.device

    def draw(
        self, field: Gaussians, camera: Camera, time: float, background: Tensor
    ) -> RasterisedImage:
        """Rasterise the Gaussians at one time; gradients reach them.

        Raises:
            GaussianError: If a parameter is not finite.
        """
        posed = field.at(time)
        pose = camera.world_to_camera.to(posed.means)
        eye = -pose[:3, :3].T @ pose[:3, 3]
        colours = 0.5 + spherical_harmonics(posed.degree, posed.harmonics, posed.means - eye)
        return rasterise(
            posed.means,
            posed.quaternions,
            posed.scales,
            posed.opacities,
            colours.clamp(min=0),
            camera,
            background,
            antialiased=self.antialiased,
        )

    @torch.no_grad()
    def view(
        self, field: Any, frame: Frame, camera: PosedCamera, time: float, background: Tensor
    ) -> dict[str, Tensor]:
        pinhole = camera_in(frame, camera)
        image = self.draw(field, pinhole, time, background.to(self.device))
        depth = image.depth * _slants(pinhole).to(image.depth)
        return {"colour": image.colour, "opacity": image.opacity, "depth": depth}


def _slants(camera: Camera) -> Tensor:
    """Distance along each pixel's ray per unit of depth along the optical axis. [H, W]"""
    across = (torch.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    down = (torch.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    return (1 + across.square() + down.square()[:, None]).sqrt()


@dataclass(frozen=True, kw_only=True)
class RasteriserSettings(SamplerSettings):
    """Gaussians are projected and blended; there are no samples."""

    devices: ClassVar = 1
    kind: ClassVar = Gaussians

    antialiased: bool  # Lower the opacity of Gaussians that the low-pass filter widens.

    def build(self, field: Gaussians, site: Site) -> "Rasteriser":
        if site.views is not None:
            camera_in(site.frame, site.views.camera(0))
        return Rasteriser(GaussianRenderer(field, antialiased=self.antialiased), site.frame)


class Rasteriser(Sampler):
    """Renders whole views, and collects the gradients that densification uses.

    Args:
        renderer: The renderer.
        frame: The field's frame.
    """

    def __init__(self, renderer: GaussianRenderer, frame: Frame) -> None:
        self._renderer, self.frame = renderer, frame

    @property
    def renderer(self) -> GaussianRenderer:
        return self._renderer

    @property
    def outline(self) -> str:
        return "none: Gaussians are projected and blended"

    def render(self, field: Any, rays: Batch, state: TrainingState) -> RasterisedRendering:
        camera = camera_in(self.frame, rays["camera"])
        background = rays["background"][0]
        time = field.training_time(float(rays["times"][0]), state)
        image = self._renderer.draw(field, camera, time, background)
        if image.means2d.requires_grad:
            image.means2d.retain_grad()
        empty = image.opacity.new_empty(0)
        none = torch.empty(0, dtype=torch.int64)
        return RasterisedRendering(
            colour=image.colour.flatten(0, 1),
            opacity=image.opacity.flatten(),
            depth=image.depth.detach().flatten(),
            density=empty,
            samples=Samples(none, none, empty.view(0, 3), empty, none, 0, 0, 0),
            image=image,
        )

    @torch.no_grad()
    def observe(self, rendering: Any) -> None:
        """Add the norms of the projected means' gradients, in units of half the image's side."""
        image, field = rendering.image, self._renderer.field
        height, width = image.opacity.shape
        half = image.means2d.new_tensor([0.5 * width, 0.5 * height])
        drawn = image.radii > 0
        field.slopes += (image.means2d.grad * half).norm(dim=1) * drawn
        field.seen += drawn
