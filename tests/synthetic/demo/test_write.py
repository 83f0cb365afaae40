"""Demo scenes on disk: layout, determinism, reuse, repair and concurrent writers."""

import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.refusals import interrupt
from xplanes.synthetic.demo import ensure_demo_scene, write
from xplanes.synthetic.demo.render import CAMERA_ANGLE_X, CAMERA_DISTANCE

USUAL_FRAMES, FRAMES = write.VIDEO_FRAMES, 5


@pytest.fixture(scope="module", autouse=True)
def short_videos():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(write, "VIDEO_FRAMES", FRAMES)
        yield


def make(root: Path, name: str = "balls", **changes) -> Path:
    asked = {"resolution": 16, "train_views": 4, "val_views": 2, "test_views": 3}
    return ensure_demo_scene(root, name, **asked | {"announce": lambda _: None} | changes)


def contents(folder: Path) -> dict[str, bytes]:
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def index(folder: Path, split: str) -> dict:
    return json.loads((folder / f"transforms_{split}.json").read_text())


@pytest.fixture(scope="module")
def folder(tmp_path_factory, short_videos) -> Path:
    return make(tmp_path_factory.mktemp("demo"))


def test_layout_is_that_of_d_nerf(folder):
    assert folder.name == "balls_16px_s0_4-2-3"
    assert USUAL_FRAMES == 50
    counts = {"train": 4, "val": 2, "test": 3, "video": FRAMES}
    for split, count in counts.items():
        content = index(folder, split)
        assert content["camera_angle_x"] == CAMERA_ANGLE_X
        assert len(content["frames"]) == count
        for number, frame in enumerate(content["frames"]):
            assert frame["file_path"] == f"./{split}/r_{number:03d}"
            with Image.open(folder / (frame["file_path"] + ".png")) as picture:
                assert picture.mode == "RGBA"
                assert picture.size == (16, 16)
            pose = torch.tensor(frame["transform_matrix"], dtype=torch.float64)
            assert pose[:3, 3].norm().item() == pytest.approx(CAMERA_DISTANCE)
            assert pose[2, 3] >= 0
            # It looks at the origin along -z.
            assert torch.allclose(pose[:3, 2] * CAMERA_DISTANCE, pose[:3, 3])
    assert {path.name for path in folder.iterdir()} == {
        "demo.json",
        *counts,
        *(f"transforms_{split}.json" for split in counts),
    }


def test_times_and_cameras(folder):
    times = {s: [f["time"] for f in index(folder, s)["frames"]] for s in ("train", "val", "test")}
    assert times["train"] == pytest.approx([0, 1 / 3, 2 / 3, 1])
    for split in ("val", "test"):
        assert times[split][0] == 0
        assert all(0 < time < 1 for time in times[split][1:])
        assert not set(times[split][1:]) & set(times["train"])
    frames = [f for s in times for f in index(folder, s)["frames"]]
    places = torch.tensor([f["transform_matrix"] for f in frames])[:, :3, 3]
    assert torch.pdist(places).min() > 1e-3
    video = index(folder, "video")["frames"]
    assert all(frame["transform_matrix"] == video[0]["transform_matrix"] for frame in video)
    assert [frame["time"] for frame in video] == pytest.approx(np.linspace(0, 1, FRAMES).tolist())


def test_the_same_request_gives_the_same_bytes(folder, tmp_path):
    threads = torch.get_num_threads()
    again = make(tmp_path)
    assert contents(again) == contents(folder)
    assert torch.get_num_threads() == threads
    other = make(tmp_path, seed=1)
    assert other != again
    ours, theirs = contents(again), contents(other)
    assert ours["train/r_000.png"] != theirs["train/r_000.png"]
    assert ours["transforms_train.json"] != theirs["transforms_train.json"]


def test_a_finished_folder_is_reused_and_a_damaged_one_rebuilt(folder, tmp_path):
    copy = tmp_path / folder.name
    shutil.copytree(folder, copy)
    record = json.loads((copy / "demo.json").read_text())
    said: list[str] = []
    assert make(tmp_path, announce=said.append) == copy
    assert said == []
    for number, damage in enumerate(
        (
            (copy / "test" / "r_001.png").unlink,
            (copy / "demo.json").unlink,
            lambda: (copy / "demo.json").write_text(json.dumps({**record, "version": -1})),
        ),
        start=1,
    ):
        damage()
        assert make(tmp_path, announce=said.append) == copy
        assert len(said) == number
        assert "balls" in said[-1]
        assert contents(copy) == contents(folder)
    assert [path.name for path in tmp_path.iterdir()] == [folder.name]


def test_writers_at_the_same_time_leave_one_whole_folder(folder, tmp_path):
    (tmp_path / folder.name).mkdir()
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: make(tmp_path), range(4)))
    assert set(found) == {tmp_path / folder.name}
    assert contents(found[0]) == contents(folder)
    assert [path.name for path in tmp_path.iterdir()] == [folder.name]


def test_a_failed_rendering_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(write, "render_image", interrupt)
    with pytest.raises(KeyboardInterrupt):
        make(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_usual_counts_give_the_short_name_and_bad_requests_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("xplanes.synthetic.demo.write._write_split", lambda *_: None)
    monkeypatch.setattr("xplanes.synthetic.demo.write._holds", lambda *_: True)
    folder = ensure_demo_scene(tmp_path, "excavator", resolution=128)
    assert folder.name == "excavator_128px_s0"
    with pytest.raises(ValueError, match="resolution"):
        make(tmp_path, resolution=0)
    with pytest.raises(ValueError, match="val"):
        make(tmp_path, val_views=0)
    with pytest.raises(ValueError, match="excavator"):
        make(tmp_path, name="excavator2")


def test_the_wait_is_printed_by_default(tmp_path, capsys):
    make(tmp_path, resolution=4, announce=None)
    assert "balls" in capsys.readouterr().out
