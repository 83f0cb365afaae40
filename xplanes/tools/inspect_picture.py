"""The picture of `xplanes inspect`: cameras, times, masks, and images with the cube's edges."""

import math
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from xplanes.evaluation.findings import pixels_of, sees_centre, time_gaps
from xplanes.files import replacing
from xplanes.scenes.frame import Frame
from xplanes.scenes.views import Views, spread
from xplanes.tools.inspect import CameraGroup, Capture, cameras_of

WIDTH, HEIGHT, MARGIN = 1600, 960, 24
SCALE = 2  # Supersampling factor of the picture, for anti-aliased lines and letters.

INK, FAINT, PAPER, PANEL = "#1f2933", "#9aa5b1", "#ffffff", "#f5f7fa"
SPLITS = {"train": "#2b6cb0", "val": "#d97706", "test": "#2f855a"}
OTHER, ASTRAY, CUBE, GAP = "#6b46c1", "#d64545", "#c026a3", "#f9d6d5"
POINT = "#627d98"
MOST_FRUSTA, MOST_RAYS, MOST_STRIPS, SAMPLES = 80, 3, 12, 6
MOST_POINTS = 3000
EDGE_POINTS = 48  # Points along an edge of the cube; distortion makes edges curved.

Box = tuple[float, float, float, float]
"""Left, top, right and bottom, in pixels of the finished picture."""


def write_picture(path: Path, capture: Capture) -> None:
    """Draw a capture to a PNG file, written atomically."""
    with replacing(path) as temporary:
        draw(capture).save(temporary, format="PNG")


def draw(capture: Capture) -> Image.Image:
    """Draw a capture."""
    sheet = _Sheet(WIDTH, HEIGHT)
    scene = capture.scene
    sheet.text((MARGIN, 16), scene.name, size=26)
    _legend(sheet, capture)
    top, side = 76, 520
    for number, (title, axes) in enumerate((("from above", "xy"), ("from the side", "xz"))):
        left = MARGIN + number * (side + MARGIN)
        sheet.paste(_cameras(side, title, axes, capture), (left, top))
    left, right = MARGIN + 2 * (side + MARGIN), WIDTH - MARGIN
    _times(sheet, (left, top, right, top + 300), capture)
    _coverage(sheet, (left, top + 324, right, top + side), capture)
    _samples(sheet, (MARGIN, top + side + MARGIN, right, HEIGHT - 12), capture)
    return sheet.image.reduce(SCALE)


class _Sheet:
    """A supersampled canvas, with coordinates in pixels of the final picture."""

    def __init__(self, width: int, height: int) -> None:
        self.image = Image.new("RGB", (SCALE * width, SCALE * height), PAPER)
        self.pen = ImageDraw.Draw(self.image)

    def line(self, points: Sequence[tuple[float, float]], colour: str, width: float = 1.0) -> None:
        places = [(SCALE * x, SCALE * y) for x, y in points]
        self.pen.line(places, fill=colour, width=max(1, round(SCALE * width)), joint="curve")

    def box(self, box: Box, fill: str) -> None:
        self.pen.rectangle([SCALE * value for value in box], fill=fill)

    def dot(self, place: tuple[float, float], radius: float, colour: str) -> None:
        x, y = place
        corners = (x - radius, y - radius, x + radius, y + radius)
        self.pen.ellipse([SCALE * value for value in corners], fill=colour)

    def text(
        self,
        place: tuple[float, float],
        text: str,
        *,
        size: int = 14,
        colour: str = INK,
        anchor: str = "la",
        room: float | None = None,
    ) -> float:
        """Write a line, shortened in the middle to ``room`` pixels, and return its width."""
        font = ImageFont.load_default(SCALE * size)
        whole, kept = text, len(text)
        while room is not None and kept > 2 and font.getlength(text) > SCALE * room:
            kept -= 1
            text = f"{whole[: kept // 2]}..{whole[len(whole) - (kept - kept // 2) :]}"
        x, y = place
        self.pen.text((SCALE * x, SCALE * y), text, fill=colour, font=font, anchor=anchor)
        return font.getlength(text) / SCALE

    def paste(self, image: Image.Image, place: tuple[float, float]) -> None:
        self.image.paste(image, (round(SCALE * place[0]), round(SCALE * place[1])))


def _colour(split: str) -> str:
    return SPLITS.get(split, OTHER)


def _legend(sheet: _Sheet, capture: Capture) -> None:
    entries = [
        (_colour(split), f"{split}, {len(views)} views")
        for split, views in capture.scene.splits.items()
    ]
    if (frame := capture.frame) is None:
        entries.append((ASTRAY, "no cube: the cameras see no common volume"))
    else:
        entries.append((CUBE, f"the field's cube, {2 / frame.scale:.3g} wide"))
        splits = capture.scene.splits.values()
        if blind := sum(int((~sees_centre(views, frame)).sum()) for views in splits):
            entries.append((ASTRAY, f"{blind} do not see the centre of the cube"))
    if (points := capture.scene.points) is not None:
        entries.append((POINT, f"{len(points)} points"))
    warned = ", ".join(dict.fromkeys(each.kind for each in capture.findings))
    entries.append((INK, f"warnings: {warned}" if warned else "no warnings"))
    x = float(MARGIN)
    for colour, words in entries:
        sheet.box((x, 54, x + 11, 65), fill=colour)
        x += 17 + sheet.text((x + 17, 60), words, anchor="lm") + 26


def _cameras(side: int, title: str, axes: str, capture: Capture) -> Image.Image:
    """Cameras with their frusta, points, the cube, and rays through the corners of some images.

    They are drawn on a separate sheet, which clips rays at the panel's border.
    """
    sheet = _Sheet(side, side)
    sheet.box((0, 0, side, side), fill=PANEL)
    frame, splits = capture.frame, capture.scene.splits
    places = torch.cat([views.camera_to_world[:, :3, 3] for views in splits.values()])
    points = places if frame is None else torch.cat([places, _cube_edges(frame).flatten(0, 1)])
    columns = ["xyz".index(name) for name in axes]
    low, high = points[:, columns].double().aminmax(dim=0)
    span = max(float((high - low).max()), 1e-9)
    per_unit = 0.88 * (side - 60) / span

    def plan(points: Tensor) -> list[tuple[float, float]]:
        """Orthographic projection of world points."""
        flat = (points[:, columns].double() - 0.5 * (low + high)) * per_unit
        return [(0.5 * side + x, 0.5 * side - y) for x, y in flat.tolist()]

    if (known := capture.scene.points) is not None:
        known = known[known.isfinite().all(dim=1)]
        for place in plan(known[:: -(-len(known) // MOST_POINTS) or 1]):
            if all(0 < value < side for value in place):
                sheet.dot(place, 0.8, POINT)
    train = splits["train"]
    for index in spread(MOST_RAYS, len(train)):
        reach = 0.5 * span
        if frame is not None:
            place = train.camera_to_world[index, :3, 3]
            reach = float((place - frame.centre).norm()) + 0.5 / frame.scale
        for tip in _corners(train, index, reach):
            sheet.line(plan(torch.stack([train.camera_to_world[index, :3, 3], tip])), FAINT, 0.6)
    if frame is not None:
        for edge in _cube_edges(frame):
            sheet.line(plan(edge[[0, -1]]), CUBE, 1.4)
    for split, views in splits.items():
        sees = torch.ones(len(views), dtype=torch.bool)
        if frame is not None:
            sees = sees_centre(views, frame)
        chosen = set(spread(MOST_FRUSTA, len(views)))
        for index in range(len(views)):
            colour = _colour(split) if sees[index] else ASTRAY
            place = views.camera_to_world[index, :3, 3]
            sheet.dot(plan(place[None])[0], 2.2, colour)
            if index in chosen or not sees[index]:
                ends = torch.cat([_corners(views, index, 0.07 * span), place[None]])
                # Around the image, and from each of its corners to the camera.
                sheet.line(plan(ends[[0, 1, 2, 3, 0, 4, 1, 4, 2, 4, 3]]), colour, 0.9)
    sheet.text((12, 8), f"{title}: {axes[0]} to the right, {axes[1]} up", size=15)
    step = 10.0 ** math.floor(math.log10(0.4 * span))
    wide = step * per_unit
    sheet.line([(14, side - 14), (14 + wide, side - 14)], INK, 2)
    words = f"{step:g} world unit{'' if step == 1 else 's'}"
    sheet.text((22 + wide, side - 14), words, anchor="lm", size=13)
    return sheet.image


def _corners(views: Views, index: int, reach: float) -> Tensor:
    """Points at distance ``reach`` on the rays through an image's corners, in order. [4, 3]"""
    height, width = views.size(index)
    rows = torch.tensor([-0.5, -0.5, height - 0.5, height - 0.5])
    columns = torch.tensor([-0.5, width - 0.5, width - 0.5, -0.5])
    number = torch.full((4,), index)
    origins, directions = views.pixel_rays(number, rows, columns)
    return origins + reach * directions


def _cube_edges(frame: Frame) -> Tensor:
    """Points along the cube's edges in the world. [12, P, 3]"""
    along = torch.linspace(-1, 1, EDGE_POINTS)
    edges = []
    for axis, (first, second) in product(range(3), product((-1.0, 1.0), repeat=2)):
        points = torch.tensor([[first, second]]).expand(EDGE_POINTS, 2)
        edges.append(torch.cat([points[:, :axis], along[:, None], points[:, axis:]], dim=1))
    return frame.to_world(torch.stack(edges))


def _strips(capture: Capture) -> list[tuple[str, str, list[float]]]:
    """Split, label and times of each strip; the last one combines cameras beyond the limit."""
    found = []
    for split, views in capture.scene.splits.items():
        groups = cameras_of(views)
        if len(groups) > MOST_STRIPS:
            rest = [index for group in groups[MOST_STRIPS - 1 :] for index in group.indices]
            name = f"{len(groups) - MOST_STRIPS + 1} others"
            groups = [*groups[: MOST_STRIPS - 1], CameraGroup(name, rest, groups[0].fixed)]
        for group in groups:
            label = split if len(groups) == 1 else f"{split} {group.name}"
            found.append((split, label, views.times[group.indices].tolist()))
    return found


def _times(sheet: _Sheet, box: Box, capture: Capture) -> None:
    """The times of each camera's views."""
    left, top, right, bottom = box
    sheet.box(box, fill=PANEL)
    sheet.text((left + 12, top + 8), "times of the views", size=15)
    strips = _strips(capture)
    start, end = left + 130, right - 18
    above, below = top + 34, bottom - 34
    pitch = min(34.0, (below - above) / len(strips))
    for first, last in time_gaps(capture.scene.splits["train"]):
        place = (start + first * (end - start), start + last * (end - start))
        sheet.box((place[0], above, place[1], below), fill=GAP)
    for number, (split, label, times) in enumerate(strips):
        middle = above + (number + 0.5) * pitch
        size = min(14, max(8, int(0.8 * pitch)))
        sheet.text((left + 12, middle), label, anchor="lm", size=size, room=start - left - 24)
        sheet.line([(start, middle), (end, middle)], "#d9dee4", 1)
        half = min(9.0, 0.38 * pitch)
        for time in sorted(set(times)):
            x = start + time * (end - start)
            sheet.line([(x, middle - half), (x, middle + half)], _colour(split), 1.2)
    for value in (0.0, 0.25, 0.5, 0.75, 1.0):
        x = start + value * (end - start)
        sheet.line([(x, below + 2), (x, below + 7)], INK, 1)
        sheet.text((x, below + 10), f"{value:g}", anchor="ma", size=13)


def _coverage(sheet: _Sheet, box: Box, capture: Capture) -> None:
    """The share of opaque pixels of each image."""
    left, top, right, bottom = box
    sheet.box(box, fill=PANEL)
    sheet.text((left + 12, top + 8), "opaque pixels of each view", size=15)
    start, end, above, below = left + 60, right - 18, top + 40, bottom - 16
    for share in (0.0, 0.5, 1.0):
        y = below - share * (below - above)
        sheet.line([(start, y), (end, y)], "#d9dee4", 1)
        sheet.text((start - 8, y), f"{share:.0%}", anchor="rm", size=13)
    bars = [(split, each.coverage) for split, images in capture.images.items() for each in images]
    pitch = min(24.0, (end - start) / len(bars))
    for number, (split, share) in enumerate(bars):
        x = start + number * pitch
        room = 0.12 * pitch
        y = below - share * (below - above)
        sheet.box((x + room, min(y, below - 1), x + pitch - room, below), fill=_colour(split))


def _samples(sheet: _Sheet, box: Box, capture: Capture) -> None:
    """Some images with the cube's edges."""
    left, top, right, bottom = box
    chosen = _chosen(capture)
    cell = (right - left - (SAMPLES - 1) * 12) / SAMPLES
    high = bottom - top - 44
    for number, (split, index) in enumerate(chosen):
        views = capture.scene.splits[split]
        height, width = views.size(index)
        scale = min(cell / width, high / height)
        size = max(1, round(scale * width)), max(1, round(scale * height))
        x = left + number * (cell + 12)
        sheet.paste(_sample(views, index, size, capture.frame), (x, top))
        y = top + size[1] + 6
        name, time = views.files[index], float(views.times[index])
        words = f"{split}, time {time:.3g}, {width}x{height} px"
        sheet.text((x, y), name, size=13, colour=_colour(split), room=cell)
        sheet.text((x, y + 17), words, size=13, room=cell)


def _chosen(capture: Capture) -> list[tuple[str, int]]:
    """Views to show: training views of different cameras and times, one of each other split."""
    splits = capture.scene.splits
    others = [(split, len(views) // 2) for split, views in splits.items() if split != "train"]
    train = splits["train"]
    groups, count, chosen = cameras_of(train), min(SAMPLES - len(others), len(train)), []
    for number in range(count):
        share = (number + 0.5) / count
        place = number % len(groups) if len(groups) < count else round(share * len(groups) - 0.5)
        views = sorted(groups[place].indices, key=lambda index: float(train.times[index]))
        chosen.append(views[round(share * len(views) - 0.5)])
    return [*(("train", index) for index in dict.fromkeys(chosen)), *others]


def _sample(views: Views, index: int, size: tuple[int, int], frame: Frame | None) -> Image.Image:
    """An image on a chequerboard, with the edges of the cube projected by its lens.

    ``size`` is its width and height in pixels of the finished picture.
    """
    height, width = views.size(index)
    wide, high = SCALE * size[0], SCALE * size[1]
    pixels = views.image(index).numpy()
    # Colours are premultiplied by alpha; Pillow would multiply an RGBA image again.
    parts = [Image.fromarray(part.copy()) for part in (pixels[..., :3], pixels[..., 3])]
    smooth = Image.Resampling.BOX if width > wide else Image.Resampling.NEAREST
    colour, alpha = (
        np.asarray(part.resize((wide, high), smooth), dtype=np.float32) / 255 for part in parts
    )
    rows, columns = np.indices((high, wide)) // (10 * SCALE)
    ground = np.where((rows + columns) % 2 == 0, 0.86, 0.78)[..., None]
    picture = colour + (1 - alpha[..., None]) * ground
    image = Image.fromarray((255 * picture.clip(0, 1)).astype(np.uint8))
    if frame is None:
        return image
    pen, edges = ImageDraw.Draw(image), _cube_edges(frame)
    x, y, seen = pixels_of(views, index, edges.flatten(0, 1))
    places = torch.stack([x * wide / width, y * high / height], dim=1).view(*edges.shape[:2], 2)
    # Pillow's coordinates overflow far outside of the picture.
    near = seen.view(edges.shape[:2]) & (places.abs().amax(dim=-1) < 20 * max(wide, high))
    for ink, thick in ((PAPER, 3.2), (CUBE, 1.6)):
        for edge, shown in zip(places.tolist(), near.tolist(), strict=True):
            for i in range(EDGE_POINTS - 1):
                if shown[i] and shown[i + 1]:
                    line = [*edge[i], *edge[i + 1]]
                    pen.line(line, fill=ink, width=round(SCALE * thick))
    return image
