"""Scenes in which nothing moves."""

from dataclasses import replace

import torch

from xplanes.scenes.views import Scene, Views

SAME = 2
"""Steps of 1/255 by which a pixel that stands still may differ between frames."""


def stands_still(video: Views) -> bool:
    """Whether all frames of a fixed camera, at two moments or more, show the same."""
    first = video.images[0].to(torch.int16)
    return not video.is_still and all(
        int((frame.to(torch.int16) - first).abs().max()) <= SAME for frame in video.images[1:]
    )


def at_one_moment(scene: Scene, reason: str) -> Scene:
    """The scene with all views at time 0, and one frame of its video.

    Args:
        scene: The scene.
        reason: How it is known that nothing moves, for the header of a run.
    """
    splits = {
        name: replace(views, times=torch.zeros_like(views.times))
        for name, views in scene.splits.items()
    }
    video = scene.video
    if video is not None:
        video = video.subset(torch.zeros(1, dtype=torch.long))
        video = replace(video, times=torch.zeros(1))
    return replace(scene, splits=splits, video=video, still=reason)
