"""Every command of docs/your_own_data.md that needs no other program is run, in order."""

import itertools
import json
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from tests.balls import ball_views, swinging
from tests.captures import NerfiesFolder, write_colmap
from tests.training.runs import SMALL
from xplanes.cli import main
from xplanes.config import compose_plain
from xplanes.scenes.datamodule import SceneDataModule
from xplanes.scenes.views import Views
from xplanes.synthetic.demo.write import ensure_demo_scene

PAGE = Path(__file__).resolve().parent.parent / "docs" / "your_own_data.md"
SIZE = 40
CAMERAS, FRAMES = 4, 4


def commands(program: str) -> list[list[str]]:
    """Arguments of the page's commands of a program."""
    lines = re.findall(rf"^    {program} (.*)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    return [shlex.split(line) for line in lines]


def ball(count: int, **options: Any) -> Views:
    return ball_views(count, 0.6, centre=swinging(0.3, 1), size=SIZE, **options)


def save(path: Path, image: torch.Tensor) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image.numpy()).save(path)


def opaque(image: torch.Tensor) -> torch.Tensor:
    """An image before a wall of grey noise. uint8 [h, w, 3]"""
    noise = torch.randint(40, 200, image.shape, dtype=torch.uint8)
    return torch.where(image[..., 3:] > 0, image, noise)[..., :3].contiguous()


def write_dancer(folder: Path) -> None:
    """A COLMAP model with masks and times."""
    views = ball(16)
    names = [f"frame_{number:04d}.jpg" for number in range(16)]
    for index, name in enumerate(names):
        save(folder / "images" / name, opaque(views.image(index)))
        save(folder / "masks" / f"{name}.png", views.image(index)[..., 3].contiguous())
    focal = float(views.intrinsics.focal[0, 0])
    camera = {1: ("OPENCV", SIZE, SIZE, (focal, focal, SIZE / 2, SIZE / 2, -0.02, 0.0, 0.0, 0.0))}
    poses = views.camera_to_world.double().numpy()
    images = [(name, pose, 1, 2) for name, pose in zip(names, poses, strict=True)]
    write_colmap(folder / "sparse" / "0", camera, images, [[0.1, 0.2, 0.3]])
    rows = [f"{name},{index / 10}" for index, name in enumerate(names)]
    (folder / "times.csv").write_text("\n".join(["file,time", *rows]) + "\n")


def write_transforms(folder: Path, first: int = 0, ending: str = "png", **content: Any) -> None:
    """nerfstudio's transforms.json, with images numbered from ``first``."""
    views = ball(16)
    frames = []
    for index, pose in enumerate(views.camera_to_world.tolist()):
        name = f"images/image{first + index:06d}.{ending}"
        save(folder / name, opaque(views.image(index)))
        frames.append({"file_path": name, "transform_matrix": pose, "time": index / 30})
    content |= {"fl_x": float(views.intrinsics.focal[0, 0]), "w": SIZE, "h": SIZE}
    (folder / "transforms.json").write_text(json.dumps({**content, "frames": frames}))


def write_cameras(folder: Path, camera_name: str, ending: str) -> Views:
    """A folder of images for each camera, whose first views are returned."""
    firsts, times = ball(CAMERAS), torch.linspace(0, 1, FRAMES)
    for camera, pose in enumerate(firsts.camera_to_world):
        views = ball(FRAMES, poses=pose.repeat(FRAMES, 1, 1), times=times)
        for index in range(FRAMES):
            name = f"{camera_name.format(camera)}/{index:04d}.{ending}"
            save(folder / name, opaque(views.image(index)))
    return firsts


def write_fly(folder: Path) -> None:
    """Folders of images, and one frame of each camera in transforms.json."""
    views = write_cameras(folder, "cam{}", "jpg")
    known = {"fl_x": float(views.intrinsics.focal[0, 0]), "w": SIZE, "h": SIZE}
    poses = enumerate(views.camera_to_world.tolist())
    frames = [
        {"file_path": f"cam{camera}/0000.jpg", "transform_matrix": pose, **known}
        for camera, pose in poses
    ]
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))


def write_kitchen(folder: Path) -> None:
    """Neural 3D Video's calibration, with folders of images."""
    write_poses_bounds(folder, write_cameras(folder, "cam{:02d}", "png"))


def write_fern(folder: Path) -> None:
    """LLFF's rows, and an image for each."""
    views = ball(10)
    for index in range(10):
        save(folder / "images" / f"IMG_{index:04d}.png", opaque(views.image(index)))
    write_poses_bounds(folder, views)


def write_poses_bounds(folder: Path, views: Views) -> None:
    """A row for each view's pose, size and focal length, near and far."""
    rows = []
    for index, pose in enumerate(views.camera_to_world):
        right, up, back, place = pose[:3].double().numpy().T
        size = np.array([SIZE, SIZE, float(views.intrinsics.focal[index, 0])])
        matrix = np.stack([-up, right, back, place, size], axis=1)
        rows.append([*matrix.ravel(), 1.0, 9.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the page's reader works."""
    root = tmp_path_factory.mktemp("work")
    captures = root / "captures"
    write_dancer(captures / "dancer")
    write_transforms(captures / "statue", camera_model="OPENCV", k1=0.01)
    write_transforms(captures / "hand", first=50, ending="jpg")
    write_fly(captures / "fly")
    write_kitchen(captures / "kitchen")
    write_fern(captures / "fern")
    NerfiesFolder(captures / "broom", 10)
    counts = {"train_views": 10, "val_views": 2, "test_views": 3}
    demo = ensure_demo_scene(root / "demo", "balls", resolution=24, **counts)
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


def times_of(folder: Path) -> dict[Path, int]:
    """When each file was changed."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


@pytest.mark.parametrize("words", each_capture("xplanes inspect"))
def test_inspect_as_the_page_says(words, place, monkeypatch, capsys):
    monkeypatch.chdir(place)
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
    scene = SceneDataModule(compose_plain("train", settings)["data"]).scene
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
