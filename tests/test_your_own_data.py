"""Every command of docs/your_own_data.md that needs no other program is run, in order."""

import itertools
import json
import re
import shlex
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.balls import ball_views, swinging
from tests.captures import NerfiesFolder, save, write_colmap, write_rows
from tests.training.runs import SMALL, changed
from xplanes.cli import main
from xplanes.config import compose_plain
from xplanes.scenes.datamodule import SceneDataModule
from xplanes.scenes.views import Views
from xplanes.synthetic.demo.write import ensure_demo_scene
from xplanes.tools import inspect

PAGE = Path(__file__).resolve().parent.parent / "docs" / "your_own_data.md"
SIZE = 40
CAMERAS, FRAMES = 4, 4


def commands(program: str) -> list[list[str]]:
    """Arguments of the page's commands of a program."""
    lines = re.findall(rf"^    {program} (.*)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    return [shlex.split(line) for line in lines]


def ball(count: int, **options: Any) -> Views:
    return ball_views(count, 0.6, centre=swinging(0.3, 1), size=SIZE, **options)


def save_all(folder: Path, names: Iterable[str], views: Views) -> None:
    """Write images before a wall of grey noise, without alpha."""
    for index, name in enumerate(names):
        image = views.image(index)
        noise = torch.randint(40, 200, image.shape, dtype=torch.uint8)
        save(folder / name, torch.where(image[..., 3:] > 0, image, noise)[..., :3].numpy())


def focal_of(views: Views) -> float:
    return float(views.intrinsics.focal[0, 0])


def write_dancer(folder: Path) -> None:
    """A COLMAP model with masks and times."""
    views, names = ball(16), [f"frame_{number:04d}.jpg" for number in range(16)]
    save_all(folder / "images", names, views)
    for index, name in enumerate(names):
        save(folder / "masks" / f"{name}.png", views.image(index)[..., 3].numpy())
    lens = (focal_of(views), focal_of(views), SIZE / 2, SIZE / 2, -0.02, 0.0, 0.0, 0.0)
    poses = views.camera_to_world.double().numpy()
    images = [(name, pose, 1, 2) for name, pose in zip(names, poses, strict=True)]
    camera = {1: ("OPENCV", SIZE, SIZE, lens)}
    write_colmap(folder / "sparse" / "0", camera, images, [[0.1, 0.2, 0.3]])
    rows = [f"{name},{index / 10}" for index, name in enumerate(names)]
    (folder / "times.csv").write_text("\n".join(["file,time", *rows]) + "\n")


def write_transforms(folder: Path, names: list[str], views: Views, **content: Any) -> None:
    """nerfstudio's transforms.json."""
    frames = [
        {"file_path": name, "transform_matrix": pose, "time": index / 30}
        for index, (name, pose) in enumerate(
            zip(names, views.camera_to_world.tolist(), strict=True)
        )
    ]
    content |= {"fl_x": focal_of(views), "w": SIZE, "h": SIZE, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))


def write_moving(folder: Path, first: int, ending: str, **content: Any) -> None:
    """Images of one moving camera, numbered from ``first``."""
    views = ball(16)
    names = [f"images/image{first + index:06d}.{ending}" for index in range(16)]
    save_all(folder, names, views)
    write_transforms(folder, names, views, **content)


def write_cameras(folder: Path, camera_name: str, ending: str) -> Views:
    """A folder of images for each camera, whose first views are returned."""
    firsts, times = ball(CAMERAS), torch.linspace(0, 1, FRAMES)
    for camera, pose in enumerate(firsts.camera_to_world):
        views = ball(FRAMES, poses=pose.repeat(FRAMES, 1, 1), times=times)
        names = [f"{index:04d}.{ending}" for index in range(FRAMES)]
        save_all(folder / camera_name.format(camera), names, views)
    return firsts


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the page's reader works."""
    root = tmp_path_factory.mktemp("work")
    captures = root / "captures"
    write_dancer(captures / "dancer")
    write_moving(captures / "statue", 0, "png", camera_model="OPENCV", k1=0.01)
    write_moving(captures / "hand", 50, "jpg")
    firsts = write_cameras(captures / "fly", "cam{}", "jpg")
    write_transforms(captures / "fly", [f"cam{k}/0000.jpg" for k in range(CAMERAS)], firsts)
    firsts = write_cameras(captures / "kitchen", "cam{:02d}", "png")
    names = [f"images/IMG_{index:04d}.png" for index in range(10)]
    save_all(captures / "fern", names, ball(10))
    for name, views in (("kitchen", firsts), ("fern", ball(10))):
        poses = views.camera_to_world.double()
        write_rows(captures / name, poses, SIZE, SIZE, focal_of(views))
    NerfiesFolder(captures / "broom", 10)
    counts = {"train_views": 5, "val_views": 1, "test_views": 1}
    demo = ensure_demo_scene(root / "demo", "balls", resolution=16, **counts)
    demo.rename(captures / "excavator")
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
    return [*sizes, *kept, "lrm=none", "trainer.max_steps=2", "callbacks.evaluation.at=[0]"]


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
