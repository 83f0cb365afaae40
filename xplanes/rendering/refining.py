"""Corrects the poses of training cameras while a field is trained on their images.

If a pose is slightly wrong, the rendering is displaced from the image. To first order, their
colours differ by the image gradient times the displacement, from which the depths of the rays give
the motion of the camera (Lucas and Kanade, 1981, in three dimensions). Each batch adds its rays to
the normal equations of these motions, which are solved every few steps (Gauss-Newton). This needs
no gradient with respect to positions, so that it works with any field and any sampler of rays.

A motion and a scale common to all cameras are removed, because the field can undo them. Corrections
are damped and pulled towards the given poses, because the data are weak along some motions: the
image of a distant camera hardly changes when it moves closer.
"""

from typing import Any

import torch
from torch import Tensor, distributed, nn

from xplanes.backend import in_group
from xplanes.rendering.base import Rendering
from xplanes.rendering.sampler import Sampler, WrappingSampler
from xplanes.scenes.batches import Batch
from xplanes.scenes.frame import CameraGroups, Frame
from xplanes.streams import TrainingState

FIRST = 150
"""Steps before the first correction, in which the field takes shape."""

EVERY = 50
"""Steps between corrections."""

DAMPING, PULL = 0.01, 0.001
"""Weights of a correction and of the distance from the given pose, per mean squared gradient."""

LEAST_MOTION = 0.01
"""Share of the mean weight of turns, or of shifts, that is added to every direction's weight."""

LARGEST = 1.0
"""Largest correction at a time, in pixels."""

LEAST_RAYS = 100.0
"""Rays that a camera needs to be corrected, weighted by opacity."""

LEAST_AREA = 1e-3
"""Minimum squared sine of the angle between the changes of a ray per pixel right and down."""

BEHIND = 3.0
"""Assumed distance of the surroundings from the cube's centre, in units of half its side."""


class RefiningSampler(WrappingSampler):
    """Wraps a sampler of rays and corrects the poses of the training cameras.

    Args:
        inner: The sampler.
        groups: The training cameras.
        scale: Batch size relative to the one that schedules assume.
    """

    def __init__(self, inner: Sampler, groups: CameraGroups, scale: float = 1.0) -> None:
        super().__init__(inner)
        self.cameras = CameraCorrections(groups)
        self.every, self.first = (max(1, round(count / scale)) for count in (EVERY, FIRST))
        self._seen: Batch | None = None

    @property
    def modules(self) -> dict[str, nn.Module]:
        return self.inner.modules | {"cameras": self.cameras}

    @property
    def outline(self) -> str:
        return f"{self.inner.outline}, cameras refined".removeprefix(", ")

    def render(self, field: Any, rays: Batch, state: TrainingState) -> Rendering:
        rays = self.cameras.corrected_rays(rays)
        self._seen = rays if state.step >= self.first - self.every else None
        return self.inner.render(field, rays, state)

    def observe(self, rendering: Any) -> None:
        if self._seen is not None:
            self.cameras.observe(self._seen, rendering)
            self._seen = None
        self.inner.observe(rendering)

    def update(self, field: Any, state: TrainingState) -> None:
        self.inner.update(field, state)
        done = state.step + 1
        if done >= self.first and done % self.every == 0:
            self.cameras.solve()

    def corrected(self, poses: Tensor, frame: Frame) -> Tensor:
        return self.inner.corrected(self.cameras.corrected(poses, frame), frame)

    def scalars(self) -> dict[str, float]:
        moved = float(self.cameras.moved.mean())
        return self.inner.scalars() | {"sampler/cameras_moved_px": moved}


class CameraCorrections(nn.Module):
    """A small turn and shift of each training camera, in the field's frame.

    Args:
        groups: The training cameras.

    Attributes:
        motion: Turn about the camera's own position, as a rotation vector, then shift. [C, 6]
        moved: Root mean square displacement of each camera's image, in pixels. [C]
    """

    own = ("steepness", "residual", "pixels", "rays")
    """Buffers that differ between the processes of a distributed run."""

    index: Tensor
    places: Tensor
    given: Tensor
    motion: Tensor
    moved: Tensor
    steepness: Tensor
    residual: Tensor
    pixels: Tensor
    rays: Tensor

    def __init__(self, groups: CameraGroups) -> None:
        super().__init__()
        count, exact = len(groups.places), torch.float64
        # Not stored in checkpoints: known whenever the field is built.
        self.register_buffer("index", groups.index, persistent=False)
        self.register_buffer("places", groups.places, persistent=False)
        self.register_buffer("given", groups.poses, persistent=False)
        self.register_buffer("motion", torch.zeros(count, 6))
        self.register_buffer("moved", torch.zeros(count))
        # Sums over the rays since a camera's last correction: squares of the derivatives of
        # colours, their products with differences of colours, squares of displacements in pixels,
        # and opacities.
        self.register_buffer("steepness", torch.zeros(count, 6, 6, dtype=exact))
        self.register_buffer("residual", torch.zeros(count, 6, dtype=exact))
        self.register_buffer("pixels", torch.zeros(count, 6, 6, dtype=exact))
        self.register_buffer("rays", torch.zeros(count, dtype=exact))

    def corrected_rays(self, rays: Batch) -> Batch:
        """A batch with the rays of the corrected cameras.

        Args:
            rays: A batch with ``view`` and ``across`` (`RayBatches.slopes`).
        """
        camera = self.index[rays["view"]]
        rotation = rotations(self.motion[:, :3])[camera]
        return rays | {
            "origins": rays["origins"] + self.motion[camera, 3:],
            "directions": torch.einsum("rij,rj->ri", rotation, rays["directions"]),
            "across": torch.einsum("rij,rkj->rki", rotation, rays["across"]),
        }

    @torch.no_grad()
    def observe(self, rays: Batch, rendering: Rendering) -> None:
        """Add the rays of a batch to the normal equations.

        Args:
            rays: The batch, with ``slopes``, as `corrected_rays` returned it.
            rendering: Its rendering.
        """
        origins, directions = rays["origins"], rays["directions"]
        opacity = rendering.opacity.clamp(0, 1)
        near = opacity / rendering.depth.clamp(min=1e-3)
        inverse = near + (1 - opacity) / (origins.norm(dim=-1) + BEHIND)
        difference = rays["target"] - rendering.colour
        # Displacement in pixels, to the right and down, per change of direction: the inverse of
        # the changes of direction per pixel, within their plane. [R, 2, 3]
        right, down = rays["across"].unbind(dim=1)
        across, both, along = (
            (first * second).sum(dim=-1, keepdim=True)
            for first, second in ((right, right), (right, down), (down, down))
        )
        area = across * along - both.square()
        to_pixels = torch.stack([along * right - both * down, across * down - both * right], dim=1)
        to_pixels /= area[..., None]
        # A lens may have no ray for the next pixel, and a field may return NaN.
        usable = (difference.isfinite().all(dim=-1) & inverse.isfinite())[:, None]
        usable &= area > LEAST_AREA * across * along
        if rendering.shown is not None:
            usable &= rendering.shown[:, None]
        opacity = torch.where(usable[:, 0], opacity, 0)
        difference = torch.where(usable, difference, 0)
        inverse = torch.where(usable, inverse[:, None], 0)[:, None]
        to_pixels = torch.where(usable[:, None], to_pixels, 0)
        # A turn w changes a direction d by w x d, and a shift s, seen at depth z, by s / z.
        turn = torch.linalg.cross(directions[:, None].expand_as(to_pixels), to_pixels)
        displaced = torch.cat([turn, to_pixels * inverse], dim=-1)
        change = rays["slopes"] @ displaced  # Of the colour, by each component of a motion.
        camera = self.index[rays["view"]]
        for sums, values in (
            (self.steepness, change.mT @ change),
            (self.residual, (difference[:, None] @ change)[:, 0]),
            (self.pixels, opacity[:, None, None] * (displaced.mT @ displaced)),
            (self.rays, opacity),
        ):
            sums.index_add_(0, camera, values.double())

    @torch.no_grad()
    def solve(self) -> None:
        """Correct the cameras that enough rays have observed since their last correction.

        Their sums are cleared; the other cameras keep theirs until they have enough rays.
        """
        sums = (self.steepness, self.residual, self.pixels, self.rays)
        if in_group():
            for each in sums:  # Each process has its own rays.
                distributed.all_reduce(each)
        count = self.rays.clamp(min=1e-9)[:, None]
        steepness, residual = self.steepness / count[..., None], self.residual / count
        metric = _floored(self.pixels / count[..., None])
        known = self.rays >= LEAST_RAYS
        # Mean square of the image's gradient, per square of a displacement in pixels.
        gradient = (_trace(steepness) / _trace(metric).clamp(min=1e-30))[:, None]
        motion = self.motion.double()
        pull = PULL * gradient * (metric @ motion[..., None])[..., 0]
        left = steepness + ((PULL + DAMPING) * gradient)[..., None] * metric
        left[~known | (gradient[:, 0] <= 0)] = torch.eye(6, dtype=left.dtype, device=left.device)
        step = torch.linalg.solve(left, (residual - pull)[..., None])[..., 0]
        step *= (LARGEST / _displacement(step, metric).clamp(min=LARGEST))[:, None]
        motion = torch.where(known[:, None], motion + step, motion)
        motion = without_common(self.places.double(), motion, metric, known)
        self.motion.copy_(motion)
        self.moved.copy_(torch.where(known, _displacement(motion, metric), self.moved))
        first = not in_group() or distributed.get_rank() == 0
        for each in sums:  # The first process keeps the reduced sums of the other cameras.
            each[known if first else slice(None)] = 0

    def corrected(self, poses: Tensor, frame: Frame) -> Tensor:
        """Poses in the world, those of training cameras corrected. [V, 4, 4]

        Args:
            poses: Given poses. [V, 4, 4]
            frame: The field's frame.
        """
        count = len(self.given)
        if not count:
            return poses
        index = {pose: number for number, pose in enumerate(_keys(self.given.to(poses)))}
        camera = torch.tensor([index.get(pose, count) for pose in _keys(poses)])
        # Other cameras have no motion.
        motion = torch.cat([self.motion, self.motion.new_zeros(1, 6)]).to(poses.device)[camera]
        turn = frame.rotation.T @ rotations(motion[:, :3]) @ frame.rotation
        found = poses.clone()
        found[:, :3, :3] = turn.to(found) @ poses[:, :3, :3]
        found[:, :3, 3] += (motion[:, 3:] @ frame.rotation / frame.scale).to(found)
        return torch.where((camera < count)[:, None, None].to(poses.device), found, poses)


def _keys(poses: Tensor) -> list[bytes]:
    """Bytes of each pose; those of equal poses are equal. [V, 4, 4]"""
    return [pose.tobytes() for pose in (poses + 0.0).cpu().numpy()]  # -0 becomes 0.


def rotations(vectors: Tensor) -> Tensor:
    """Rotation matrices of rotation vectors. [N, 3] -> [N, 3, 3]"""
    return torch.linalg.matrix_exp(_cross(vectors))


def without_common(places: Tensor, motion: Tensor, metric: Tensor, known: Tensor) -> Tensor:
    """Camera motions without the part that a motion and a scaling of the whole scene would undo.

    Args:
        places: Positions of the cameras. [C, 3]
        motion: Turn and shift of each. [C, 6]
        metric: Square of the displacement in pixels, as a quadratic form of a motion. [C, 6, 6]
        known: Cameras with enough rays. bool [C]

    Returns:
        The smallest motions that differ by a common one; unchanged if not ``known``. [C, 6]
    """
    if not known.any():
        return motion
    # A common turn w, shift s and growth g turn a camera at o by w and move it by w x o + s + g o.
    eye = torch.eye(3, dtype=motion.dtype, device=motion.device).expand(len(places), 3, 3)
    zero = torch.zeros_like(eye)
    turned = torch.cat([eye, zero, zero[..., :1]], dim=2)
    shifted = torch.cat([-_cross(places), eye, places[..., None]], dim=2)
    common = torch.cat([turned, shifted], dim=1)
    weighted = common[known].mT @ metric[known]
    left, right = weighted @ common[known], weighted @ motion[known, :, None]
    # The pseudoinverse, since few cameras do not determine the whole common motion.
    found = torch.linalg.pinv(left.sum(dim=0), hermitian=True) @ right.sum(dim=0)
    return torch.where(known[:, None], motion - (common @ found)[..., 0], motion)


def _cross(vectors: Tensor) -> Tensor:
    """Matrices of cross products with vectors. [N, 3] -> [N, 3, 3]"""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).view(-1, 3, 3)


def _floored(metric: Tensor) -> Tensor:
    """A quadratic form of turn and shift, plus a minimum weight for every direction. [C, 6, 6]"""
    weights = metric.diagonal(dim1=1, dim2=2).view(-1, 2, 3).mean(dim=-1)
    least = (LEAST_MOTION * weights).clamp(min=1e-12).repeat_interleave(3, dim=1)
    return metric + torch.diag_embed(least)


def _trace(form: Tensor) -> Tensor:
    return form.diagonal(dim1=1, dim2=2).sum(dim=-1)


def _displacement(motion: Tensor, metric: Tensor) -> Tensor:
    """Root mean square displacement in pixels. [C, 6] -> [C]"""
    return (motion[:, None] @ metric @ motion[..., None])[:, 0, 0].clamp(min=0).sqrt()
