"""`xplanes inspect`: what it says of captures in order, and of those with one thing wrong."""

import json
import math
import re
import shlex
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from PIL import Image

from tests.balls import ball_views, surrounding, swinging
from tests.captures import save, write_transforms
from tests.lens_oracle import direction, pixel
from tests.refusals import assert_refused
from tests.training.runs import changed, small_config
from xplanes.cli import main
from xplanes.components import build
from xplanes.config import compose_plain
from xplanes.errors import ConfigError, MissingSplitError, SceneError
from xplanes.evaluation.findings import _outward, camera_findings
from xplanes.models.base import ModelSettings
from xplanes.run import run
from xplanes.scenes.cameras import look_at
from xplanes.scenes.frame import scene_frame
from xplanes.scenes.lenses import Lenses, LensModel
from xplanes.scenes.source import SceneSettings
from xplanes.scenes.views import Intrinsics, Scene, Views
from xplanes.tools.image_findings import texel_findings
from xplanes.tools.inspect import (
    Choice,
    cameras_of,
    choose,
    distortion,
    facts,
    inspect,
    lens_words,
    next_command,
    table,
)
from xplanes.tools.inspect_picture import HEIGHT, POINT, WIDTH, _chosen, draw

SIZE, COUNT, HELD = 32, 16, 4


@dataclass(frozen=True, kw_only=True)
class Given(SceneSettings):
    """A scene that is there already."""

    content: Any

    def load(self, splits):
        missing = [split for split in splits if split not in self.content.splits]
        if missing:
            raise MissingSplitError(f"no {missing}")
        return replace(self.content, splits={split: self.content.splits[split] for split in splits})


@pytest.fixture(scope="module")
def inspected():
    model = build(compose_plain("train", [])["model"], ModelSettings, "model")
    usual = compose_plain(None, ["+data=blender"])["data"]
    known = {field.name for field in fields(Given)}

    def read(scene, half_side=None, texels=16):
        given = {**usual, "name": "given", "scene": "ball", "resolution": None}
        given |= {"half_side": half_side, "content": scene}
        settings = Given(**{key: value for key, value in given.items() if key in known})
        return inspect(Choice((), settings, replace(model, resolution=texels)))

    return read


def ball(*, moving=True, **train):
    """A ball that swings, or lies beside the centre, in order."""
    centre = swinging(0.3, 1) if moving else lambda _: torch.tensor([0.3, 0.1, 0.0])
    held = torch.linspace(0.1, 0.9, HELD)
    options = {"centre": centre, "size": SIZE}
    parts = {
        "train": ball_views(COUNT, 0.6, **options, **train),
        "test": ball_views(HELD, 0.6, **options, seed=1, times=held),
    }
    named = {
        split: replace(views, files=tuple(f"{split}/{name}" for name in views.files))
        for split, views in parts.items()
    }
    return Scene("ball", named)


def within(seconds, scene):
    """The scene, all of whose times lie between 0 and that one."""
    for views in scene.splits.values():
        views.times.mul_(seconds)
    return scene


def painted(paint):
    """The ball with other images: ``paint`` changes those of a split. uint8 [V, H, W, 4]"""
    scene = ball()
    for views in scene.splits.values():
        paint(views.images)
    return scene


def white(images, where):
    """Pixels become opaque white; ``where`` says of their alpha which ones."""
    images.masked_fill_(where(images[..., 3:]), 255)


NOT_SHOWN = partial(white, where=lambda alpha: alpha == 0)


def textured(images):
    """Opaque images: the ball before a wall of noise."""
    noise = torch.randint(30, 200, images.shape, dtype=torch.uint8)
    noise[..., 3] = 255
    images[:] = torch.where(images[..., 3:] > 0, images, noise)


def world_to_camera():
    scene = ball()
    for views in scene.splits.values():
        views.camera_to_world[:] = torch.linalg.inv(views.camera_to_world)
    return scene


def turned():
    """The ball with poses of OpenCV's axes."""
    scene = ball()
    scene.splits["train"].camera_to_world[..., 1:3] *= -1
    return scene


def test_cameras_that_walk_on_are_not_taken_for_inverse_poses():
    train = ball().splits["train"]
    steps = torch.linspace(0, 1, COUNT)
    turn = 0.4 * torch.sin(9 * steps)
    poses = torch.eye(4).repeat(COUNT, 1, 1)
    poses[:, 0, 0], poses[:, 0, 2] = turn.cos(), turn.sin()
    poses[:, 2, 0], poses[:, 2, 2] = -turn.sin(), turn.cos()
    poses[:, 0, 3], poses[:, 2, 3] = 0.2 * torch.sin(5 * steps), -10 * steps
    finding = _outward(replace(train, camera_to_world=poses))
    assert finding is None or "inverse" not in finding.text


def rig(count=4):
    """Fixed cameras that take turns in pairs of images."""
    return surrounding(count, 4.0).repeat(COUNT // count, 1, 1)


def bent(model, **coefficients):
    """The ball through lenses."""
    scene, row = ball(), torch.zeros(12, dtype=torch.float64)
    for name, value in coefficients.items():
        row[["k1", "k2", "k3", "k4", "k5", "k6", "p1"].index(name)] = value
    for split, views in scene.splits.items():
        count = len(views)
        lenses = Lenses(torch.full((count,), int(model)), row.repeat(count, 1), torch.zeros(count))
        intrinsics = replace(views.intrinsics, lenses=lenses)
        scene.splits[split] = replace(views, intrinsics=intrinsics)
    return scene


def fisheye():
    return bent(LensModel.FISHEYE, k1=0.05, k2=-0.01)


IN_ORDER = {
    "moving camera": ball,
    "fixed cameras": lambda: ball(poses=rig()),
    "one time": lambda: within(0, ball(moving=False)),
    "fixed cameras, one time": lambda: within(0, ball(moving=False, poses=rig())),
    "opaque": lambda: painted(textured),
    "fisheye": fisheye,
    "random times": lambda: ball(
        times=torch.rand(COUNT, generator=torch.Generator().manual_seed(3))
    ),
}


@pytest.mark.parametrize("name", IN_ORDER)
def test_a_capture_in_order_gets_no_warning(inspected, name):
    capture = inspected(IN_ORDER[name]())
    assert capture.findings == ()
    assert capture.problem == ""
    assert "no warnings" in table(capture)


def gap():
    scene = ball()
    halves = [torch.linspace(0, 0.25, 8), torch.linspace(0.75, 1, 8)]
    scene.splits["train"].times[:] = torch.cat(halves)
    return scene


def astray():
    scene = ball()
    poses = scene.splits["train"].camera_to_world[::5]
    place = poses[:, :3, 3]
    poses[:] = look_at(place, place.flip(1) * 3 + 1)
    return scene


def sharing(*, files=(), cameras=(), images=()):
    """The ball, where some test views have what training views have: pairs of their numbers."""
    scene = ball()
    train, test = scene.splits["train"], scene.splits["test"]
    names = list(test.files)
    for mine, theirs in files:
        names[mine] = train.files[theirs]
    for mine, theirs in cameras:
        test.camera_to_world[mine] = train.camera_to_world[theirs]
        test.times[mine] = train.times[theirs]
    for mine, theirs in images:
        test.images[mine] = train.images[theirs]
    return replace(scene, splits={"train": train, "test": replace(test, files=tuple(names))})


def hardly_masked(images):
    textured(images)
    images[:, :2, :2] = 0


def stray(images):
    images[1, 1, 2:4, 3] = 3
    images[2, -2, -3] = 255


def inverted(images):
    shown = images[..., 3] > 0
    textured(images)
    images[shown] = 0


def two_sizes():
    scene = ball()
    train = scene.splits["train"]
    lenses = train.intrinsics
    half = train.images[::2, ::2, ::2].clone()
    train.images[::2] = 0
    train.images[::2, : SIZE // 2, : SIZE // 2] = half
    scale = torch.tensor([0.5, 1.0]).repeat(COUNT // 2)[:, None]
    size = (lenses.size * scale).long()
    halved = Intrinsics(lenses.focal * scale, lenses.centre * scale, size)
    return replace(scene, splits={**scene.splits, "train": replace(train, intrinsics=halved)})


WRONG = {
    "a gap in the times": (gap, "times: .*between 0.25 and 0.75, 14 times"),
    "times in other units": (lambda: within(0.01, ball()), "times: .*run from 0 to 0.01, 1% of"),
    "no times": (
        lambda: within(0, ball(poses=rig())),
        "one_time: .*train/000.png and train/004.png differ, although they have the same camera",
    ),
    "other axes": (turned, "axes: 16 of 16 cameras look away"),
    "world-to-camera poses": (
        world_to_camera,
        "axes: the cameras' axes do not meet, but those of the inverse poses do",
    ),
    "cameras astray": (astray, "astray: 4 of 16 cameras do not see"),
    "a small cube": (ball, "scale: .*too small", {"half_side": 0.05}),
    "a large cube": (ball, "scale: .*too large", {"half_side": 20.0}),
    "a cut scene": (ball, "cut: .*cuts off .*% of the foreground", {"half_side": 0.5}),
    "a shared file": (
        lambda: sharing(files=[(0, 3)], images=[(0, 3)]),
        r"shared: .*1 of 4 test.*\(train/003.png is train/003",
    ),
    "a shared camera": (
        lambda: sharing(cameras=[(2, 5)]),
        r"shared: .*1 of 4 test.*\(test/002.png is train/005",
    ),
    "shared pixels": (
        lambda: sharing(images=[(1, 7), (3, 9)]),
        r"shared: .*2 of 4 .* pixels \(test/001.png is train/007",
    ),
    "white on white": (
        lambda: painted(partial(white, where=lambda alpha: alpha > 0)),
        "white: .*100% of the silhouettes",
    ),
    "opaque white": (lambda: painted(NOT_SHOWN), "white: .*the images are opaque"),
    "empty images": (
        lambda: painted(lambda images: images[::3].zero_()),
        "empty: .*8 of 20 images show",
    ),
    "a mask is missing": (
        lambda: painted(lambda images: textured(images[-1:])),
        "opaque: .*2 of 20 images",
    ),
    "useless masks": (lambda: painted(hardly_masked), "opaque: .*20 of 20 .* less tha"),
    "inverted masks": (lambda: painted(inverted), "inverted: .*of 20 images are opaqu"),
    "stray pixels": (
        lambda: painted(stray),
        r"stray: .*4 of 20 images .* 6 in all, in train/001.png \(2\), test/001.png \(2\), ",
    ),
    "two sizes": (two_sizes, r"sizes: .*8 of 16x16 px, 12 of 32x32 px"),
    "coarse planes": (ball, r"texels: .*planes with 2 texels.*data\.resolution=", {"texels": 2}),
}
"""How each is made, the kind and words of its warning, and how it is looked at."""


def test_finer_planes_are_recommended_as_the_model_can_have_them():
    advice = {True: "model.fine.texels=256 adds", False: "Planes with 256 texels per side would"}
    for fine, words in advice.items():
        (found,) = texel_findings(15, 960, 64, fine=fine)
        assert f"960 pixels wide. {words}" in found.text


@pytest.mark.parametrize("name", WRONG)
def test_each_warning_is_given_where_it_is_deserved_and_no_other(inspected, name):
    make, words, *options = WRONG[name]
    capture = inspected(make(), **dict(*options))
    (finding,) = capture.findings
    assert re.match(words, f"{finding.kind}: {finding.text}"), finding
    assert finding.text in table(capture)
    assert {"kind": finding.kind, "text": finding.text} in facts(capture)["warnings"]


def test_cameras_that_look_at_no_one_thing_are_told_of():
    generator = torch.Generator().manual_seed(0)
    places = torch.randn(40, 3, generator=generator) * torch.tensor([0.3, 0.3, 0.05])
    targets = places + torch.tensor([0.0, 0.0, 5.0])
    targets += torch.randn(40, 3, generator=generator) * 0.3
    views = replace(ball_views(40, 0.6, size=8), camera_to_world=look_at(places, targets))
    for poses, expected in ((views.camera_to_world, ["astray"]), (surrounding(40, 3.0), [])):
        scene = Scene("hall", {"train": replace(views, camera_to_world=poses)})
        found = camera_findings(scene, scene_frame(scene.splits["train"]))
        assert [each.kind for each in found] == expected


def test_axes_that_diverge_leave_a_table_and_a_picture(inspected):
    capture = inspected(WRONG["other axes"][0]())
    assert "negate the second and third column" in capture.problem
    assert facts(capture)["cube"] is None
    assert draw(capture).size == (WIDTH, HEIGHT)


def test_the_table_says_what_was_found_out(inspected):
    notes = {"times": "the numbers in their names, from 1 to 9: 1.png -> 1", "masks": "leave out"}
    capture = inspected(replace(ball(), notes=notes))
    assert facts(capture)["notes"] == notes
    assert "times   the numbers in their names, from 1 to 9: 1.png -> 1\nmasks   leave out\n" in (
        table(capture)
    )


def test_facts_are_those_of_the_scene(inspected):
    capture = inspected(ball())
    known = json.loads(json.dumps(facts(capture)))
    train = known["splits"]["train"]
    assert (train["views"], train["sizes"]) == (COUNT, [[SIZE, SIZE]])
    assert (train["timesteps"], train["times"]) == (COUNT, [0, 1])
    assert train["largest_gap"] == pytest.approx(1 / (COUNT - 1))
    assert train["field_of_view"] == pytest.approx([math.degrees(0.7)] * 2)
    assert (train["lens"], train["distortion_pixels"]) == ("pinhole", 0)
    shown = (capture.scene.splits["train"].images[..., 3] > 0).float().mean(dim=(1, 2))
    assert train["opaque"][0] == pytest.approx(float(shown.min()))
    assert train["opaque"][2] == pytest.approx(float(shown.max()))
    assert known["cube"]["source"] == "cameras and silhouettes"
    assert known["cube"]["camera_distance"] == pytest.approx([4, 4, 4], abs=0.1)
    # A texel is side / 16 wide, a pixel 4 / focal.
    focal = 0.5 * SIZE / math.tan(0.35)
    expected = known["cube"]["side"] / 16 / (4 / focal)
    assert known["pixels_per_texel"] == pytest.approx(expected, rel=0.02)
    given = facts(inspected(ball(), half_side=1.0))["cube"]
    assert (given["source"], given["side"]) == ("data.half_side", 2.0)


def test_cameras_are_told_apart_by_poses_or_lenses(inspected):
    fixed = cameras_of(ball(poses=rig(4)).splits["train"])
    assert [group.indices for group in fixed] == [list(range(k, COUNT, 4)) for k in range(4)]
    assert all(group.fixed for group in fixed)
    views = ball().splits["train"]
    assert [(group.fixed, len(group.indices)) for group in cameras_of(views)] == [(False, COUNT)]
    files = tuple(f"cam{i % 2:02d}/{i}.png" for i in range(COUNT))
    focal = views.intrinsics.focal.clone()
    focal[1::2] *= 1.5
    two = replace(views, files=files, intrinsics=replace(views.intrinsics, focal=focal))
    assert [group.name for group in cameras_of(two)] == ["cam00", "cam01"]


def test_the_picture_shows_each_camera_of_a_rig(inspected):
    capture = inspected(ball(poses=rig(4)))
    train = capture.scene.splits["train"]
    shown = [index for split, index in _chosen(capture) if split == "train"]
    of = {index: n for n, group in enumerate(cameras_of(train)) for index in group.indices}
    assert len({of[index] for index in shown}) == min(4, len(shown))
    assert len({float(train.times[index]) for index in shown}) > 1


def test_what_the_reader_says_is_a_warning(tmp_path, capsys):
    write_nerfstudio(tmp_path / "ball", ball().splits["train"], n_frames=4)
    assert main(["inspect", str(tmp_path / "ball"), "--out", str(tmp_path / "a.png")]) == 0
    printed = capsys.readouterr()
    assert "warning (files)" in printed.out
    assert "n_frames=4" in printed.out
    assert "no warnings" not in printed.out
    assert "n_frames" not in printed.err


def test_distortion_is_how_far_the_oracle_moves_a_corner():
    k = {"k1": -0.2, "k2": 0.03, "p1": 0.01}
    lensed = bent(LensModel.PERSPECTIVE, **k).splits["train"]
    assert lens_words(lensed) == "perspective k1 k2 p1"
    focal, centre = [0.5 * SIZE / math.tan(0.35)] * 2, [SIZE / 2] * 2
    moved = []
    for corner in [(0, 0), (SIZE, 0), (0, SIZE), (SIZE, SIZE)]:
        ray = direction("perspective", corner, k, focal, centre)
        straight = pixel("perspective", ray, {}, focal, centre)
        moved.append(math.dist(corner, straight))
    assert distortion(lensed) == pytest.approx(max(moved), rel=1e-6)
    assert "fisheye k1 k2" in lens_words(fisheye().splits["train"])


def test_points_give_opaque_scenes_their_cube_and_are_drawn(inspected):
    bare = painted(lambda images: images[..., 3].fill_(255))
    generator = torch.Generator().manual_seed(0)
    near = 0.7 * (2 * torch.rand(300, 3, generator=generator) - 1)
    far = 50 + torch.rand(100, 3, generator=generator)
    scene = replace(bare, points=torch.cat([near, far]))
    known = facts(inspected(scene))["cube"]
    assert known["source"] == "points"
    assert known["side"] == pytest.approx(2 * 1.15 * 0.96 * 0.7, rel=0.05)
    assert facts(inspected(bare))["cube"]["source"] == "cameras"
    assert facts(inspected(scene, half_side=1.5))["cube"]["source"] == "data.half_side"
    ink = [int(POINT[i : i + 2], 16) for i in (1, 3, 5)]
    plans = np.asarray(draw(inspected(scene)))[100:580, 24:1088].astype(int)
    dots = (np.abs(plans - ink).max(axis=-1) < 40).sum()
    # Twice 300 dots, of which some lie on one another, and none of those outside of the panels.
    assert 250 < dots < 2500


def write_nerfstudio(folder: Path, views: Views, **more):
    names = [f"images/{index:03d}.png" for index in range(len(views))]
    for index, name in enumerate(names):
        save(folder / name, views.image(index).numpy())
    content = {"fl_x": float(views.intrinsics.focal[0, 0]), "w": SIZE, "h": SIZE, **more}
    write_transforms(folder, names, views.camera_to_world, views.times.tolist(), **content)


def test_a_folder_is_recognised_read_and_drawn(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "my captures" / "a ball's"
    write_nerfstudio(folder, ball().splits["train"], k1=-0.1, camera_model="OPENCV")
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    assert main(["inspect", str(folder)]) == 0
    printed = capsys.readouterr().out
    assert "as nerfstudio" in printed
    assert "perspective k1" in printed
    assert "no warnings" in printed
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before
    with Image.open("inspect_a ball's.png") as picture:
        assert picture.size == (WIDTH, HEIGHT)
    command = printed.splitlines()[-1].partition("train data=")[2]
    assert command.startswith("nerfstudio ")
    again = choose(shlex.split(f"data={command}"))
    assert again.scene.folder == folder
    assert main(["inspect", str(folder), "data.half_side=0.1", "--json", "--out", "a.png"]) == 0
    known = json.loads(capsys.readouterr().out)
    assert known["cube"]["side"] == pytest.approx(0.2)
    assert [each["kind"] for each in known["warnings"]] == ["scale"]
    assert Path(known["picture"]).is_file()


def test_large_images_are_trained_on_at_the_usual_width_unless_asked_for(tmp_path):
    folder = tmp_path / "ball"
    write_nerfstudio(folder, ball_views(3, 0.6, size=404))
    for given, width in (((), "400"), (("data.resolution=null",), "null")):
        capture = inspect(choose([str(folder), *given]))
        assert capture.scene.splits["train"].width == 404
        command = shlex.split(next_command(capture))
        assert [text for text in command if "resolution" in text] == [f"data.resolution={width}"]
        again = choose([text for text in command if text.startswith("data")])
        assert again.scene.read().splits["train"].width == (400 if width == "400" else 404)


def test_errors_are_one_line_and_leave_1(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_nerfstudio(tmp_path / "ball", ball().splits["train"])
    write_nerfstudio(tmp_path / "away", turned().splits["train"])
    for name in ("packed/renders.zip", "rig/transforms_a.json", "trained/run.json"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).touch()
    for arguments, words in (
        (["missing"], "missing is not a folder"),
        (["."], r"not a scene of a known format. Scenes inside it: away, ball"),
        (["rig"], r"Join the frames of transforms_a\.json in a transforms\.json\. What"),
        (["packed"], r"contains renders\.zip\. Unpack renders\.zip first.*ns-process-data"),
        (["trained"], "trained is a run, not a scene: xplanes render"),
        (["ball", "ball"], "give one folder"),
        (["ball", "--out", "ball/a.png"], "the scene's own folder"),
        (["ball", "--out", "a.jpg"], "must end in .png"),
        (["ball", "data.resolutoin=3"], "data.resolution"),
        (["ball", "data.views=64"], "data.views=64"),
        (["ball", "data=blender"], "transforms_train"),
        (["away"], "negate the second and third column"),
    ):
        assert main(["inspect", *arguments]) == 1, arguments
        error = capsys.readouterr().err
        assert re.search(words, error), (arguments, error)
        assert "Traceback" not in error
    (tmp_path / "ball" / "transforms_train.json").write_text("{}")
    assert_refused(
        ConfigError, "several formats.*choose one with data=", lambda: choose(["ball"]), "both"
    )


def test_a_format_of_ones_own_joins(tmp_path, monkeypatch):
    conf = tmp_path / "conf" / "data"
    conf.mkdir(parents=True)
    base = compose_plain("train", [])["data"]
    dropped = ("seed", "train_views", "test_views", "val_views", "_target_")
    node = {name: value for name, value in base.items() if name not in dropped}
    node |= {"_target_": "tests.plugins.disc_format.DiscSettings", "name": "disc", "count": 6}
    (conf / "disc.yaml").write_text(json.dumps(node))
    folder = tmp_path / "shells"
    folder.mkdir()
    (folder / "discs.txt").write_text("six")
    plugin = ["plugins=[tests.plugins]", f"hydra.searchpath=[file://{tmp_path}/conf]"]
    assert_refused(SceneError, "not a scene of a known", lambda: choose([str(folder)]), "unknown")
    assert choose([str(folder), *plugin]).scene.name == "disc"


def test_a_run_says_what_cameras_and_times_tell(tmp_path, caplog, monkeypatch):
    views = painted(NOT_SHOWN).splits["train"]
    views.times[:] = gap().splits["train"].times
    write_nerfstudio(tmp_path / "ball", views)
    chosen = ("data=nerfstudio", f"data.root={tmp_path}", "data.scene=ball", "data.resolution=null")
    config = small_config(tmp_path) | {"data": changed((), *chosen)["data"]}
    monkeypatch.setattr("xplanes.run.initialisation_of", Mock(side_effect=SceneError("far enough")))
    with pytest.raises(SceneError, match="far enough"):
        run(config, tmp_path / "run", [], resume=False)
    said = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    for words in (
        "no training view shows the times between 0.25 and 0.75",
        "opaque, with a background of constant colour",
    ):
        assert sum(words in text for text in said) == 1, words
