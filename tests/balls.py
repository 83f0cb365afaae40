"""Small scenes whose content is known exactly: a moving or static ball, seen from all sides."""

import math
from dataclasses import replace

import torch

from xplanes.scenes.cameras import PosedCamera, focal_length, look_at
from xplanes.scenes.datamodule import UNIFORM
from xplanes.scenes.views import Scene, Views

STATIC = torch.zeros(3)

RAYS = replace(
    UNIFORM, per_batch=64, samples_per_batch=4096, skip_background=True, background_share=0.1
)
"""Rays of most tests of batches; what they need otherwise they replace."""


def surrounding(count, distance, seed=0):
    """Cameras spread over the upper half of a sphere, looking at the origin. [count, 4, 4]"""
    generator = torch.Generator().manual_seed(seed)
    places = torch.randn(count, 3, generator=generator)
    places[:, 2] = places[:, 2].abs()
    return look_at(distance * places / places.norm(dim=-1, keepdim=True))


def ball_views(
    count, radius, *, centre=None, size=40, distance=4.0, angle=0.7, times=None, poses=None, seed=0
):
    """Render a ball; ``centre`` maps a time to its position. Alpha is sampled at pixel centres."""
    poses = surrounding(count, distance, seed) if poses is None else poses
    times = torch.linspace(0, 1, count) if times is None else times
    focal = focal_length(angle, size)
    images = torch.zeros(count, size * size, 4, dtype=torch.uint8)
    for image, pose, time in zip(images, poses, times.tolist(), strict=True):
        origins, directions = PosedCamera(pose, focal, size, size).rays()
        offset = (STATIC if centre is None else centre(time)) - origins
        along = (offset * directions).sum(dim=-1)
        image[offset.square().sum(dim=-1) - along.square() < radius**2] = torch.tensor(
            [200, 100, 50, 255], dtype=torch.uint8
        )
    files = tuple(f"{number:03d}.png" for number in range(count))
    return Views(images.view(count, size, size, 4), poses, times, focal, files)


def swinging(amplitude, turns):
    """A centre that swings along x."""
    return lambda time: torch.tensor([amplitude * math.sin(2 * math.pi * turns * time), 0.0, 0.0])


def ball_scene(count=6, size=16, *, moving=True):
    """A scene with training and test views."""
    times = None if moving else torch.zeros(count)
    train = ball_views(count, 0.6, size=size, times=times)
    test = ball_views(2, 0.6, size=size, seed=1, times=None if moving else torch.zeros(2))
    return Scene("ball", {"train": train, "test": test})


def inside_ball(count, radius, seed=0):
    """Points spread evenly in a ball around the origin. [count, 3]"""
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(count, 3, generator=generator)
    points = points / points.norm(dim=-1, keepdim=True)
    return points * radius * torch.rand(count, 1, generator=generator) ** (1 / 3)
