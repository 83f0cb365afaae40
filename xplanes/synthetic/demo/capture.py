"""Cameras and times of the views of a procedural scene."""

import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from xplanes.scenes.cameras import camera_around
from xplanes.synthetic.demo.render import CAMERA_ANGLE_X, CAMERA_DISTANCE

Shot = tuple[float, Tensor]
"""Time and camera-to-world matrix [4, 4] of a view."""


Station = tuple[float, float, float]
"""Time, and azimuth and elevation in degrees, of a view."""


@dataclass(frozen=True)
class Capture:
    """The views of a scene.

    Attributes:
        shots: Times and cameras of each split.
        angle_x: Field of view of all cameras, in radians.
        samples: Rays per pixel and axis.
    """

    shots: Mapping[str, Sequence[Shot]]
    angle_x: float = CAMERA_ANGLE_X
    samples: int = 2


def even_times(count: int) -> list[float]:
    """Times evenly spaced from 0 to 1."""
    return [i / max(count - 1, 1) for i in range(count)]


def held_out_times(count: int, draw: random.Random) -> list[float]:
    """Stratified random times in [0, 1].

    The first is 0, because readers of D-NeRF's format expect every split to begin at time 0.
    """
    return [0.0, *((i + draw.random()) / count for i in range(1, count))]


@dataclass(frozen=True)
class Rig:
    """The cameras of a scene, which look at one point from one distance.

    Attributes:
        distance: Distance of the cameras from the target.
        target: Point that all cameras look at.
        azimuths: Range of azimuths in degrees, from +x towards +y.
        elevations: Range of elevations in degrees.
        fixed: Number of fixed training cameras, used in turn; None draws a camera for each view.
            Validation and test cameras lie between the fixed ones.
        end: Time of the last training view.
        angle_x: Field of view in radians.
        samples: Rays per pixel and axis.
    """

    distance: float = CAMERA_DISTANCE
    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    azimuths: tuple[float, float] = (0.0, 360.0)
    elevations: tuple[float, float] = (1.0, 78.0)
    fixed: int | None = None
    end: float = 1.0
    angle_x: float = CAMERA_ANGLE_X
    samples: int = 2

    def capture(self, counts: Mapping[str, int], seed: str) -> Capture:
        """Draw times and cameras.

        Args:
            counts: Number of views per split; times of ``train`` are evenly spaced.
            seed: Seed; each split has its own random stream.
        """
        shots, target = {}, torch.tensor(self.target, dtype=torch.float64)
        for split, count in counts.items():
            draw = random.Random(f"{seed} {split}")
            stations = self._stations(count, draw, seed, training=split == "train")
            shots[split] = [
                (time * self.end, camera_around(azimuth, elevation, self.distance, target))
                for time, azimuth, elevation in stations
            ]
        return Capture(shots, self.angle_x, self.samples)

    def _stations(
        self, count: int, draw: random.Random, seed: str, *, training: bool
    ) -> list[Station]:
        """Times and places of the views of a split."""
        if self.fixed is not None:
            fixed = self._fixed(self.fixed, random.Random(f"{seed} fixed"))
            places = [
                fixed[i % self.fixed] if training else self._between(fixed, draw)
                for i in range(count)
            ]
        else:
            places = [self._anywhere(draw) for _ in range(count)]
        times = even_times(count) if training else held_out_times(count, draw)
        return [(time, *place) for time, place in zip(times, places, strict=True)]

    def _anywhere(self, draw: random.Random) -> tuple[float, float]:
        """Azimuth and elevation, uniformly distributed over the region of the sphere."""
        low, high = (math.sin(math.radians(angle)) for angle in self.elevations)
        return draw.uniform(*self.azimuths), math.degrees(math.asin(draw.uniform(low, high)))

    def _fixed(self, count: int, draw: random.Random) -> list[tuple[float, float]]:
        """Azimuths with even spacing and some jitter; low and high elevations alternate."""
        start, stop = self.azimuths
        low, high = self.elevations
        step = (stop - start) / count
        return [
            (
                start + step * (i + 0.5 + draw.uniform(-0.15, 0.15)),
                low + (high - low) * (draw.uniform(0.0, 0.4) + 0.6 * (i % 2)),
            )
            for i in range(count)
        ]

    def _between(
        self, places: Sequence[tuple[float, float]], draw: random.Random
    ) -> tuple[float, float]:
        """Azimuth and elevation between two neighbouring cameras."""
        closed = self.azimuths[1] - self.azimuths[0] >= 360
        first = draw.randrange(len(places) if closed else len(places) - 1)
        (left, low), (right, high) = places[first], places[(first + 1) % len(places)]
        if right < left:
            right += 360
        share = draw.uniform(0.25, 0.75)
        return left + share * (right - left), low + share * (high - low)


@dataclass(frozen=True)
class Phone(Rig):
    """One hand-held camera that moves along an arc over time, slightly up and down.

    Validation and test cameras are above its positions slightly earlier or later.
    """

    def _stations(
        self, count: int, draw: random.Random, seed: str, *, training: bool
    ) -> list[Station]:
        if training:
            return [(time, *self._carried(time)) for time in even_times(count)]
        stations = []
        for time in held_out_times(count, draw):
            shift = draw.choice((-1, 1)) * draw.uniform(0.06, 0.15)
            other = time + shift if 0 <= time + shift <= 1 else time - shift
            azimuth, elevation = self._carried(other)
            stations.append((time, azimuth, elevation + draw.uniform(2.0, 5.0)))
        return stations

    def _carried(self, time: float) -> tuple[float, float]:
        """Azimuth and elevation at a time."""
        (left, right), (low, high) = self.azimuths, self.elevations
        wave = 0.5 + 0.5 * math.sin(2 * math.pi * 1.7 * time)
        return left + (right - left) * time, low + (high - low) * wave


@dataclass(frozen=True)
class Array(Rig):
    """Fixed cameras that all record each timestep; the last timestep may lack some.

    Validation and test views have the same times as the training views.
    """

    fixed: int = 8  # type: ignore[assignment]

    def capture(self, counts: Mapping[str, int], seed: str) -> Capture:
        whole = super().capture(counts, seed)
        times = even_times(math.ceil(counts["train"] / self.fixed))
        shots = {}
        for split, taken in whole.shots.items():
            cameras = self.fixed if split == "train" else len(taken) / len(times)
            shots[split] = [
                (self.end * times[int(i / cameras)], camera) for i, (_, camera) in enumerate(taken)
            ]
        return replace(whole, shots=shots)
