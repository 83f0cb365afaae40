"""What tests of several readers share: refusals, warnings, captures, and rays into known pixels."""

import json
import math
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial

import numpy as np
import torch

from tests.captures import save, settings
from tests.refusals import assert_refused
from xplanes.errors import SceneError
from xplanes.readers.dnerf import BlenderSettings
from xplanes.scenes.cameras import look_at
from xplanes.scenes.store import PixelFile, StoredImages

ANGLE = 0.7


def refused(call, *words, case=None, error=SceneError):
    """The call raises an error whose message holds all of the words. Returns the message."""
    message = assert_refused(error, words[0], call, case)
    for each in words[1:]:
        assert re.search(each, message), f"{case}: {message!r} does not say {each!r}"
    return message


@contextmanager
def told(words: str | None) -> Iterator[None]:
    """All warnings hold the words, and there is one if and only if there are words."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield
    said = [str(each.message) for each in caught]
    assert bool(said) is bool(words), said
    assert all(re.search(words or "", each) for each in said), said


def assert_same_rays(views, index, other, place, atol=1e-5):
    """Two views have the same rays."""
    for mine, theirs in zip(views.image_rays(index), other.image_rays(place), strict=True):
        torch.testing.assert_close(mine, theirs, atol=atol, rtol=0)


def keys_of(value):
    """Names cases by the keys that they are about."""
    return " ".join(value) if isinstance(value, dict) else None


def rgba(seed, width=12, height=None):
    """Straight colour with soft and fully transparent parts. uint8 [height, width, 4]"""
    height = height or width
    values = np.random.default_rng(seed).integers(0, 256, (height, width, 4), dtype=np.uint8)
    values[: height // 3, :, 3] = 0
    values[-height // 3 :, :, 3] = 255
    return values


def pose(index):
    angle = 0.3 + index
    place = torch.tensor([[4 * math.cos(angle), 4 * math.sin(angle), 1.0]], dtype=torch.float64)
    return look_at(place)[0].tolist()


class Transforms:
    """A capture on disk with cameras in JSON, which can be changed before it is read."""

    kind, option, file = BlenderSettings, "blender", "transforms_{}.json"

    def __init__(self, path):
        self.path, self.contents = path, {}

    def frames(self, split="train"):
        return self.contents[split]["frames"]

    def image(self, index):
        return (self.path / self.frames()[index]["file_path"]).with_suffix(".png")

    def change(self, index=None, split="train", **changes):
        """Change keys of a frame, or of the file; those set to ... are taken out."""
        content = self.contents[split] if index is None else self.frames(split)[index]
        content.update(changes)
        for key in [key for key, value in content.items() if value is ...]:
            del content[key]

    def change_each(self, split="train", **changes):
        """Change keys of all frames: to what a function makes of them, or to the same value."""
        for index, frame in enumerate(self.frames(split)):
            new = {key: to(frame[key]) if callable(to) else to for key, to in changes.items()}
            self.change(index, split, **new)

    def write(self):
        for split, content in self.contents.items():
            (self.path / self.file.format(split)).write_text(json.dumps(content))

    def load(self, splits=("train",), **changes):
        """What is read of the files as they are."""
        return settings(self.kind, self.option, self.path, **changes).load(splits)

    def read(self, *arguments, **changes):
        self.write()
        return self.load(*arguments, **changes)

    def train(self, **changes):
        return self.read(**changes).splits["train"]

    def refused(self, *words, case=None, error=SceneError, **arguments):
        return refused(partial(self.read, **arguments), *words, case=case, error=error)


class SceneFolder(Transforms):
    """A small scene of Blender's."""

    def add(self, split, sizes, *, fixed=False, shared=None, frames=None):
        """Images, of 12x12 pixels if ``sizes`` is their number, and keys of each frame."""
        sizes = [(12, 12)] * sizes if isinstance(sizes, int) else sizes
        content = {"camera_angle_x": ANGLE} if shared is None else dict(shared)
        self.contents[split] = content | {"frames": []}
        for i, (width, height) in enumerate(sizes):
            save(self.path / split / f"r_{i}.png", rgba(i, width, height))
            frame = {
                "file_path": f"./{split}/r_{i}",
                "time": i / max(len(sizes) - 1, 1),
                "transform_matrix": pose(0 if fixed else i),
            }
            self.frames(split).append(frame | (frames[i] if frames else {}))
        self.write()
        return self


def same(first, second):
    """Two batches of rays are equal."""
    assert first.keys() == second.keys()
    return all(torch.equal(first[name], second[name]) for name in first)


def stored(views):
    """The same views in a file."""
    file = PixelFile.of(views.image(index) for index in range(len(views)))
    return replace(views, images=StoredImages.all_of(file))


def numbered(views):
    """The same views, opaque: pixels hold their view, row and column, and padding 255."""
    images = torch.full((len(views), views.height, views.width, 4), 255, dtype=torch.uint8)
    places = torch.meshgrid(*map(torch.arange, images.shape[:3]), indexing="ij")
    images[..., :3][views.valid()] = torch.stack(places, dim=-1)[views.valid()].byte()
    return replace(views, images=images)


def places_of(batch):
    """View, row and column of rays into numbered views."""
    return tuple((255 * batch["target"]).round().long().T)


def assert_own_rays(batch, views):
    """Rays into numbered views are those of the pixels whose colours they have."""
    view, row, column = places_of(batch)
    for index in range(len(views)):
        own = view == index
        expected = views.image_rays(index)[1][row[own] * views.size(index)[1] + column[own]]
        torch.testing.assert_close(batch["directions"][own], expected, atol=1e-5, rtol=0)
        assert (batch["times"][own] == views.times[index]).all()


def drawn_pixels(batches, steps):
    """How often each pixel of numbered views is drawn. [V, H, W]"""
    views = batches.views
    counts = torch.zeros(len(views), views.height, views.width)
    for step in range(steps):
        batch = batches.draw(step)
        counts.index_put_(places_of(batch), torch.ones(len(batch["times"])), accumulate=True)
    assert_own_rays(batch, views)
    return counts


def assert_even(counts):
    """Chi-squared of numbers that should differ by chance alone."""
    chi_squared = float(((counts - counts.mean()) ** 2 / counts.mean()).sum())
    freedom = counts.numel() - 1
    assert abs(chi_squared - freedom) < 5 * (2 * freedom) ** 0.5
