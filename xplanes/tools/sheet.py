"""Contact sheets of runs: renders of one view from several runs, or from several steps.

They consist of the pictures that runs write during training (``media/``).
"""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from xplanes.errors import ConfigError
from xplanes.evaluation.render import write_video
from xplanes.files import replacing
from xplanes.metrics import psnr
from xplanes.rendering.pictures import STRIP
from xplanes.tools.sweep import RunRow, read_rows
from xplanes.tools.tabulate import SCENE, SEED, differing, run_label, seed_groups

WHAT = ("runs", "steps", "parts")
"""runs: a row per scene, a column per run. steps: a row per run, a column per step. parts: low-rank
and sparse part of each run's triplanes."""

LINE, GAP = 16, 4  # Height of a line of text and gap between tiles, in pixels.
FPS, HELD = 2, 4  # Frames per second of a video, and how many times its last frame is repeated.
Line = tuple[str, Sequence[Image.Image]]  # A row of tiles with its title.

_STEP = re.compile(r"step(\d+)")
_TWICE = re.compile(r"^(train|val|test)_(?=\1_)")
"""A duplicated split at the beginning of a name, as earlier versions wrote it."""


def write_sheet(
    folder: Path,
    out: Path | None = None,
    *,
    what: str = "runs",
    show: str = "colour",
    view: str | None = None,
    steps: Sequence[int] | None = None,
    size: int = 160,
) -> Path:
    """Write a contact sheet of all runs in a folder.

    With "runs", one seed per setting is shown, unless all runs differ only in their seed.

    Args:
        folder: A run, a sweep, or any folder of runs.
        out: A PNG file, or with "steps" also a WebP video with a frame per step;
            ``folder/sheet_WHAT.png`` when None.
        what: One of `WHAT`.
        show: Quantity to show, one of `xplanes.rendering.pictures.STRIP`.
        view: Name of the view, as in ``media``, or a unique ending of it; None for the middle one
            of those that all runs of a scene have.
        steps: Steps to show; None for all, or with "runs" for the last.
        size: Pixels of a tile's longer side.

    Raises:
        ConfigError: If there are no runs, pictures, such view or step, or ``view`` is ambiguous.
    """
    out = out or folder / f"sheet_{what}.png"
    if out.suffix not in ((".png", ".webp") if what == "steps" else (".png",)):
        raise ConfigError(
            f"{out}: a contact sheet must end in .png, or with --what steps in .webp for a video"
        )
    if size < 16:
        raise ConfigError(f"size={size}: a tile must have at least 16 pixels")
    rows = read_rows(folder)
    if what == "runs":
        rows = _one_seed(rows)
    inside = {folder / row.name: row for row in rows}
    found = {path if path.is_dir() else folder: row for path, row in inside.items()}
    over = [name for name in differing(rows) if name not in (SEED, SCENE)]
    if what == "parts":
        lines = _parts(found, over)
    else:
        lines = _views(found, over, what, show, view, steps, size)
    widest = max(tile.width for _, tiles in lines for tile in tiles)
    if out.suffix == ".webp":
        frames = (_assemble(frame, widest) for frame in _frames(lines))
        return write_video(out, (torch.from_numpy(np.array(f)) for f in frames), fps=FPS)
    with replacing(out) as temporary:
        _assemble(lines, widest).save(temporary, format="PNG", optimize=True)
    return out


def _one_seed(rows: list[RunRow]) -> list[RunRow]:
    """The runs, with one per setting if there are several seeds and several settings."""
    groups = seed_groups(rows)
    repeats = [row.name for group in groups if len(groups) > 1 for row in group[1:]]
    return [row for row in rows if row.name not in repeats]


def check_what(what: str | None) -> None:
    """Check a kind of sheet.

    Raises:
        ConfigError: If it is neither None nor one of `WHAT`.
    """
    if what is not None and what not in WHAT:
        raise ConfigError(
            f"hydra.callbacks.table.sheet={what}: must be null or one of {', '.join(WHAT)}"
        )


def _parts(found: dict[Path, RunRow], over: Sequence[str]) -> list[Line]:
    lines = []
    for path, row in found.items():
        picture = path / "media" / "decomposition.png"
        if picture.is_file():
            caption = "/".join(str(part.get("rank")) for part in row.parts.values())
            tile = _tile(Image.open(picture).convert("RGB"), f"rank of xy/xz/yz: {caption}")
            lines.append((_title(row, over), [tile]))
    if not lines:
        raise ConfigError(
            "no run has media/decomposition.png: only runs initialised from an LRM have one"
        )
    return lines


def _title(row: RunRow, over: Sequence[str]) -> str:
    label = run_label(row, over) if over else ""
    return " · ".join(filter(None, (str(row.settings.get(SCENE, "")), label)))


def _views(
    found: dict[Path, RunRow],
    over: Sequence[str],
    what: str,
    show: str,
    view: str | None,
    steps: Sequence[int] | None,
    size: int,
) -> list[Line]:
    if show not in STRIP[1:]:
        raise ConfigError(f"show={show}: must be one of {', '.join(STRIP[1:])}")
    pictures = {path: _pictures(path) for path in found}
    pictures = {path: taken for path, taken in pictures.items() if taken}
    if not pictures:
        raise ConfigError(
            "no run has pictures of views (media/step*/*.png): callbacks.evaluation writes them"
        )
    scenes: dict[str, list[Path]] = {}
    for path in pictures:
        scenes.setdefault(str(found[path].settings.get(SCENE, "")), []).append(path)
    lines = []
    for scene, paths in scenes.items():
        name = _view(scene, [pictures[path] for path in paths], view)
        tiles: list[Image.Image] = []
        for path in paths:
            shown = _steps(path, pictures[path], name, steps, last=what == "runs")
            if what == "steps" or not tiles:
                tiles = [_tile(_part(shown[max(shown)], 0, size), f"{name}, true")]
            for step, strip in shown.items():
                score = f"{_score(strip):.2f} dB"
                label = f"step {step}" if what == "steps" else run_label(found[path], over)
                tiles.append(_tile(_part(strip, STRIP.index(show), size), f"{label}\n{score}"))
            if what == "steps":
                lines.append((_title(found[path], over), tiles))
        if what == "runs":
            lines.append((scene, tiles))
    return lines


def _pictures(run: Path) -> dict[int, dict[str, Path]]:
    """Pictures of a run by step and name of the view."""
    taken: dict[int, dict[str, Path]] = {}
    for folder in sorted((run / "media").glob("step*")):
        if (match := _STEP.fullmatch(folder.name)) is not None:
            named = {_TWICE.sub("", path.stem): path for path in sorted(folder.glob("*.png"))}
            if named:
                taken[int(match[1])] = named
    return taken


def _view(scene: str, runs: Sequence[dict[int, dict[str, Path]]], wanted: str | None) -> str:
    """The name of a view that all runs have at all steps."""
    common = set.intersection(*(set(named) for taken in runs for named in taken.values()))
    if not common:
        raise ConfigError(f"the runs of {scene} have no view in common: train them on equal data")
    if wanted is None:
        return sorted(common)[len(common) // 2]
    name = _TWICE.sub("", wanted.replace("/", "_").removesuffix(".png"))
    if name in common:
        return name
    found = sorted(known for known in common if known.endswith(name))
    if len(found) == 1:
        return found[0]
    if found:
        raise ConfigError(f"view={wanted}: {' and '.join(found)} end with it; name one of them")
    raise ConfigError(f"view={wanted}: the runs of {scene} show {', '.join(sorted(common))}")


def _steps(
    run: Path,
    taken: dict[int, dict[str, Path]],
    name: str,
    wanted: Sequence[int] | None,
    *,
    last: bool,
) -> dict[int, Image.Image]:
    chosen = wanted or ([max(taken)] if last else sorted(taken))
    for step in chosen:
        if step not in taken:
            known = ", ".join(map(str, sorted(taken)))
            raise ConfigError(f"steps={step}: {run.name} has pictures of the steps {known}")
    return {step: Image.open(taken[step][name]).convert("RGB") for step in chosen}


def _part(strip: Image.Image, place: int, size: int) -> Image.Image:
    """One picture of a strip, resized to ``size`` pixels along its longer side."""
    width = strip.width // len(STRIP)
    tile = strip.crop((place * width, 0, (place + 1) * width, strip.height))
    factor = size / max(tile.size)
    shape = (max(1, round(tile.width * factor)), max(1, round(tile.height * factor)))
    return tile.resize(shape, Image.Resampling.LANCZOS)


def _score(strip: Image.Image) -> float:
    """PSNR of the second picture of a strip against the first."""
    whole = torch.from_numpy(np.array(strip)).float() / 255
    truth, prediction, *_ = whole.chunk(len(STRIP), dim=1)
    return psnr(prediction, truth)


def _frames(lines: Sequence[Line]) -> Iterator[list[Line]]:
    """Ground truth and one step in each; runs with fewer steps repeat their last one."""
    last = max(len(tiles) for _, tiles in lines) - 1
    for step in [*range(1, last), *[last] * HELD]:
        yield [(title, [tiles[0], tiles[min(step, len(tiles) - 1)]]) for title, tiles in lines]


def _tile(picture: Image.Image, caption: str) -> Image.Image:
    """A picture with its caption below, on white."""
    font, lines = ImageFont.load_default(11), caption.split("\n")
    width = max(picture.width, *(int(font.getlength(line)) for line in lines))
    tile = Image.new("RGB", (width, picture.height + LINE * len(lines)), "white")
    tile.paste(picture)
    ImageDraw.Draw(tile).text((0, picture.height + 1), caption, fill="black", font=font)
    return tile


def _assemble(lines: Sequence[Line], widest: int) -> Image.Image:
    """Arrange titled rows of tiles on white, in columns of equal width."""
    font, cell = ImageFont.load_default(11), widest + GAP
    heights = [LINE + max(tile.height for tile in tiles) + 2 * GAP for _, tiles in lines]
    wide = max(int(font.getlength(title)) + GAP for title, _ in lines)
    width = max(wide, cell * max(len(tiles) for _, tiles in lines)) + GAP
    sheet = Image.new("RGB", (width, sum(heights) + GAP), "white")
    top = GAP
    for (title, tiles), height in zip(lines, heights, strict=True):
        ImageDraw.Draw(sheet).text((GAP, top), title, fill="black", font=font)
        for column, tile in enumerate(tiles):
            sheet.paste(tile, (GAP + column * cell, top + LINE))
        top += height
    return sheet
