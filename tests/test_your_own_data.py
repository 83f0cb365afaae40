"""Every command of docs/your_own_data.md that needs no other program is run, in order."""

import itertools
import json
import re
import shlex
from pathlib import Path
from typing import Any

import pytest

from tests.captures import NerfiesFolder, save, write_rows, write_transforms
from tests.readers.test_formats_agree import (
    CAMERAS,
    FOCAL,
    FRAMES,
    NAMES,
    POSES,
    SIZE,
    before_noise,
    blender,
    colmap,
    nerfstudio,
)
from tests.training.runs import SMALL, changed
from xplanes.cli import main
from xplanes.config import compose_plain
from xplanes.scenes.datamodule import SceneDataModule
from xplanes.tools import inspect

NUMBERS = itertools.count()
PAGE = Path(__file__).resolve().parent.parent / "docs" / "your_own_data.md"


def commands(program: str) -> list[list[str]]:
    """Arguments of the page's commands of a program."""
    lines = re.findall(rf"^    {program} (.*)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    return [shlex.split(line) for line in lines]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the page's reader works: a small capture of four cameras in every format."""
    root = tmp_path_factory.mktemp("work")
    captures = root / "captures"
    for name in ("dancer", "statue", "hand", "excavator", "fly", "kitchen", "fern"):
        (captures / name).mkdir(parents=True)
    colmap(captures / "dancer", text=False)
    rows = [f"{name}.png,{index / 10}" for index, name in enumerate(NAMES)]
    (captures / "dancer/times.csv").write_text("\n".join(["file,time", *rows]) + "\n")
    nerfstudio(captures / "statue")
    blender(captures / "excavator")
    NerfiesFolder(captures / "broom", 10)
    for index in range(len(NAMES)):
        camera, frame = divmod(index, FRAMES)
        for start in (f"fly/cam{camera}/", f"kitchen/cam{camera:02d}/", f"fern/images/{camera}_"):
            save(captures / f"{start}{frame:04d}.png", before_noise(index))
    firsts = POSES[::FRAMES]
    for folder, poses in (("kitchen", firsts), ("fern", POSES)):
        write_rows(captures / folder, poses, SIZE, SIZE, FOCAL)
    lens = {"fl_x": FOCAL, "w": SIZE, "h": SIZE}
    names = [f"cam{camera}/0000.png" for camera in range(CAMERAS)]
    write_transforms(captures / "fly", names, firsts, [k / 30 for k in range(CAMERAS)], **lens)
    names = [f"images/image{50 + index:06d}.jpg" for index in range(len(NAMES))]
    times = [index / 30 for index in range(len(NAMES))]
    write_transforms(captures / "hand", names, POSES, times, **lens)
    for index, name in enumerate(names):
        save(captures / "hand" / name, before_noise(index))
    return root


def test_the_page_has_a_section_for_each_format():
    words = " ".join(itertools.chain(*commands(r"python train\.py")))
    formats = {"colmap", "nerfstudio", "blender", "nerfies", "llff", "multicamera"}
    assert set(re.findall(r"\bdata=(\S+)", words)) == formats


def each_capture(program: str) -> list[Any]:
    """The page's commands of a program; further ones on the same capture are slow."""
    found, seen = [], set()
    for words in commands(program):
        names = re.findall("dancer|statue|excavator|broom|fern|kitchen|hand|fly", " ".join(words))
        again = pytest.mark.slow if set(names) <= seen else ()
        found.append(pytest.param(words, marks=again, id=" ".join(words)))
        seen |= set(names)
    return found


def composed(name: str | None, settings: list[str]) -> dict[str, Any]:
    """What these settings compose to, of which options of groups are composed once."""
    return changed((), *settings) if name else compose_plain(name, settings)


def times_of(folder: Path) -> dict[Path, int]:
    """When each file was changed."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


@pytest.mark.parametrize("words", each_capture("xplanes inspect"))
def test_inspect_as_the_page_says(words, place, monkeypatch, capsys):
    monkeypatch.chdir(place)
    monkeypatch.setattr(inspect, "compose_plain", composed)
    before = times_of(place / "captures")
    smaller = [re.sub(r"^data.resolution=\d+$", "data.resolution=24", text) for text in words]
    assert main(["inspect", *smaller]) == 0, capsys.readouterr().err
    printed = capsys.readouterr().out
    if "--json" in words:
        picture = json.loads(printed)["picture"]
    else:
        picture = printed.partition("\nwrote   ")[2].splitlines()[0]
    assert (place / picture).is_file()
    assert times_of(place / "captures") == before


def small(words: list[str]) -> list[str]:
    """A command's settings, with what makes a run short."""
    kept = [text for text in SMALL if not text.startswith(("data.", "lrm="))]
    sizes = [re.sub(r"^data.resolution=\d+$", "data.resolution=24", text) for text in words]
    if "data=llff" in words:  # Whose images are looked for at 400 pixels if nobody says more.
        sizes.append("data.resolution=24")
    short = "lrm=none", "trainer.max_steps=2", "callbacks.evaluation.at=[0]"
    if not any(text.startswith("hydra.run.dir=") for text in words):  # Two may end in one second.
        sizes.append(f"hydra.run.dir=outputs/{next(NUMBERS)}")
    return [*sizes, *kept, *short]


@pytest.mark.parametrize("words", each_capture(r"python train\.py"))
def test_training_reads_what_the_page_says(words, place, monkeypatch):
    monkeypatch.chdir(place)
    settings = [text for text in small(words) if not text.startswith("hydra.")]
    scene = SceneDataModule(changed((), *settings)["data"]).scene
    assert {"train"} < set(scene.splits)
    assert len(scene.splits["train"]) > 4


@pytest.mark.slow
def test_training_and_rendering_as_the_page_says(place, monkeypatch):
    from xplanes.launch import train

    monkeypatch.chdir(place)
    for words in commands(r"python train\.py"):
        train(small(words), ["train"])
    for words in commands("xplanes render"):
        assert main(["render", *words, "--frames", "2", "--size", "16"]) == 0
        assert Path(words[-1]).is_file()
