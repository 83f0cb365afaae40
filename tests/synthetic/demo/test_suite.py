"""The suite: every scene has the property that its kind is named after."""

import functools
import math
import shutil
from itertools import combinations, pairwise

import numpy as np
import pytest
import torch
import yaml
from PIL import Image

from tests.refusals import assert_refused
from tests.training.runs import changed
from xplanes.components import build
from xplanes.config import CONF
from xplanes.errors import SceneError
from xplanes.scenes.source import SceneSettings
from xplanes.synthetic.demo.assembly import Assembly, Part
from xplanes.synthetic.demo.geometry import Box, Plain, Translucent, Unlit
from xplanes.synthetic.demo.implicit import Fluid, Implicit
from xplanes.synthetic.demo.motions import Variation
from xplanes.synthetic.demo.render import render_image
from xplanes.synthetic.demo.shading import Light
from xplanes.synthetic.demo.suite import KINDS, SUITE_SCENES, suite_scene
from xplanes.synthetic.demo.suite.pieces import ball
from xplanes.synthetic.demo.write import MASKS, ensure_suite_scene

SIDE = 24
COUNTS = {"train": 50, "val": 10, "test": 12}


@functools.cache
def capture_of(name):
    return SUITE_SCENES[name].rig.capture(COUNTS, f"{name} 0")


@functools.cache
def assembly_of(name):
    return SUITE_SCENES[name].build(Variation(name, 0))


def picture(name, time, camera, side=SIDE):
    posed = assembly_of(name).pose(time)
    return render_image(posed, camera, side, samples=1, angle_x=capture_of(name).angle_x)


@functools.cache
def pictures(name):
    """Some views of a scene. uint8 [V, H, W, 4]"""
    shots = capture_of(name).shots
    chosen = [*(shots["train"][i] for i in (0, 31)), shots["val"][4], shots["test"][7]]
    return np.stack([picture(name, time, camera) for time, camera in chosen])


def both(kind):
    return kind, f"{kind}_test"


def cameras(name, split="train"):
    return torch.stack([camera for _, camera in capture_of(name).shots[split]])


def times(name, split="train"):
    return [time for time, _ in capture_of(name).shots[split]]


@pytest.mark.parametrize("kind", KINDS)
def test_a_scene_to_tune_on_and_another_to_test_on(kind):
    tuning, test = both(kind)
    assert test in SUITE_SCENES
    assert not np.array_equal(pictures(tuning), pictures(test))
    assert not torch.equal(cameras(tuning), cameras(test))
    assert repr(assembly_of(tuning)) != repr(assembly_of(test))
    shapes = [{repr(part.shape) for part in assembly_of(name).parts} for name in both(kind)]
    assert len(shapes[0] & shapes[1]) < 0.2 * min(map(len, shapes))


@pytest.mark.parametrize("name", SUITE_SCENES)
def test_every_view_shows_the_scene_within_the_picture_and_things_move(name):
    camera = cameras(name)[5]
    first, later = (picture(name, time, camera).astype(int) for time in (0.0, 0.37))
    moved = (np.abs(first - later) > 25).any(axis=-1).sum()
    assert moved == 0 if name.startswith("static") else moved >= 4
    alpha = pictures(name)[..., 3]
    assert ((alpha > 127).mean(axis=(1, 2)) > 0.015).all()
    if "white_floor" not in name:
        border = np.concatenate([alpha[:, [0, -1]], alpha.transpose(0, 2, 1)[:, [0, -1]]], axis=1)
        assert (border > 127).mean() < 0.05


@pytest.mark.parametrize("name", SUITE_SCENES)
def test_times_and_cameras_of_the_splits(name):
    last = SUITE_SCENES[name].rig.end
    expected = np.linspace(0, last, 50)
    if name in both("rig"):  # Eight cameras at each of seven times, but for six at the last.
        expected = np.linspace(0, last, 7).repeat(8)[:50]
    assert times(name) == pytest.approx(expected.tolist())
    for split in ("val", "test"):
        held_out = times(name, split)
        assert held_out[0] == 0
        if name in both("rig"):  # A held-out camera takes its pictures with the others.
            assert set(held_out) <= set(times(name))
            assert held_out == sorted(held_out)
            assert len(set(held_out)) == 7
        else:
            assert all(a < b < last for a, b in pairwise(held_out))
        distances = torch.cdist(cameras(name, split)[:, :3, 3], cameras(name)[:, :3, 3])
        assert distances.min() > 1e-3 * SUITE_SCENES[name].rig.distance


@pytest.mark.parametrize("name", both("fast_motion"))
def test_fast_things_move_further_than_their_size_between_views(name):
    poses = [assembly_of(name).pose(time) for time in times(name)]
    places = torch.stack([torch.stack([p.translation for p in pose.parts]) for pose in poses])
    ways = places.diff(dim=0).norm(dim=-1).amax(dim=0)
    assert (ways > 0.15).sum() >= 3
    assert (ways == 0).any()


@pytest.mark.parametrize("name", both("deformation"))
def test_shapes_deform(name):
    parts = assembly_of(name).parts
    changing = [part.shape for part in parts if isinstance(part.shape, Implicit)]
    assert len(changing) >= 4
    torch.manual_seed(0)
    for shape in changing:
        points = (2 * torch.rand(4000, 3) - 1) * torch.tensor(shape.at(0.3).extent)
        within = [shape.at(time).inside(points) for time in (0.05, 0.3)]
        assert (within[0] != within[1]).float().mean() > 0.01


@pytest.mark.parametrize("name", both("topology"))
def test_drops_merge_and_part(name):
    """The number of pieces of the fluid changes."""
    fluid = next(p.shape for p in assembly_of(name).parts if isinstance(p.shape, Fluid))
    pieces = set()
    for time in np.linspace(0, 1, 12):
        drops = [drop.at(float(time)) for drop in fluid.drops]
        group = list(range(len(drops)))
        for i, j in combinations(range(len(drops)), 2):
            ends = drops[i][:3], drops[j][:3]
            middle = torch.tensor([[(a + b) / 2 for a, b in zip(*ends, strict=True)]])
            if fluid.at(float(time)).inside(middle):
                group = [group[i] if k == group[j] else k for k in group]
        pieces.add(len(set(group)))
    assert len(pieces) >= 2


@pytest.mark.parametrize("name", both("scaling"))
def test_things_grow_and_shrink(name):
    scales = torch.tensor(
        [[p.scale for p in assembly_of(name).pose(time).parts] for time in (0.0, 0.5, 1.0)]
    )
    ratio = scales.amax(dim=0) / scales.amin(dim=0)
    assert ratio.max() > 2
    assert (ratio > 1.3).sum() >= 8


@pytest.mark.parametrize(
    ("name", "count"),
    [*((name, 6) for name in both("fixed_cameras")), *((name, 8) for name in both("rig"))],
)
def test_fixed_cameras_take_turns_and_a_rig_takes_eight_pictures_at_once(name, count):
    poses = cameras(name)
    assert len(poses.unique(dim=0)) == len(poses[:count].unique(dim=0)) == count
    assert torch.equal(poses[:-count], poses[count:])
    if count == 6:
        assert len(cameras(name, "test").unique(dim=0)) == 12


@pytest.mark.parametrize("name", both("phone"))
def test_a_phone_is_carried_along_an_arc(name):
    poses = cameras(name)
    places = poses[:, :2, 3]
    turns = torch.atan2(places[:, 1], places[:, 0]).diff()
    assert (turns * turns[0].sign() > 0).all()
    assert 1.9 < turns.sum().abs() < 2.6
    assert poses[:, 2, 3].std() > 0.1
    # Held-out cameras stand where the phone was at another time, and above.
    for (time, pose), distance in zip(
        capture_of(name).shots["test"],
        torch.cdist(cameras(name, "test")[:, :3, 3], poses[:, :3, 3]),
        strict=True,
    ):
        assert abs(times(name)[int(distance.argmin())] - time) > 0.04, pose


def suite_data(root, name, *overrides, side=SIDE, views=(3, 1, 2)):
    """Settings of a small capture."""
    counts = (f"data.{s}_views={n}" for s, n in zip(("train", "val", "test"), views, strict=True))
    small = ("data=suite", f"data.root={root}", f"data.resolution={side}", *counts)
    plain = changed((), *small, f"data.scene={name}", *overrides)
    return build(plain["data"], SceneSettings, "data")


@pytest.mark.parametrize("name", [*both("phone"), *both("rig")])
def test_captures_have_a_world_behind_and_masks_of_the_thing(name, tmp_path):
    data = suite_data(tmp_path, name)
    scene, folder = data.read(), data.folder
    assert scene.splits["train"].is_opaque
    assert set(scene.splits) == {"train", "val", "test"}
    shots = SUITE_SCENES[name].rig.capture({"train": 3}, f"{name} 0").shots["train"]
    for number, (time, camera) in enumerate(shots):
        mask = np.asarray(Image.open(folder / MASKS / "train" / f"r_{number:03d}.png"))
        assert np.array_equal(scene.splits["train"].foreground_in(number), mask)
        alone = render_image(assembly_of(name).pose(time), camera, SIDE)
        # The world hides nothing of the thing, but for what a pixel's rays share with it.
        assert np.abs(mask.astype(int) - alone[..., 3]).max() <= 64
        colours = scene.splits["train"].image(number)[..., :3].numpy()
        border = np.concatenate([colours[0], colours[-1], colours[:, 0], colours[:, -1]])
        assert len(np.unique(border // 16, axis=0)) > 8
        assert 0.03 < (mask > 127).mean() < 0.5


def test_masks_that_are_gone_are_rendered_again(tmp_path):
    data = suite_data(tmp_path, "phone", views=(2, 1, 1))
    masks = data.read().splits["train"].foreground
    for gone in (data.folder / MASKS / "train" / "r_001.png", data.folder / MASKS):
        shutil.rmtree(gone) if gone.is_dir() else gone.unlink()
        assert torch.equal(data.read().splits["train"].foreground, masks)


def test_masks_of_a_thing_cut_it_out_where_that_is_asked_for(tmp_path):
    def scene(name, use):
        return suite_data(tmp_path, name, f"data.mask_use={use}", views=(2, 1, 1)).read()

    whole, alpha, lrm = (scene("phone", use) for use in ("score", "alpha", "lrm"))
    masks = whole.splits["train"].foreground
    assert whole.lrm_views is None
    assert alpha.lrm_views is None
    assert torch.equal(alpha.splits["train"].images[..., 3], masks)
    assert alpha.splits["test"].is_opaque
    assert torch.equal(lrm.lrm_views.images, alpha.splits["train"].images)
    assert torch.equal(lrm.splits["train"].images, whole.splits["train"].images)
    shown = masks == 255
    assert torch.equal(lrm.lrm_views.images[shown], whole.splits["train"].images[shown])
    assert not lrm.lrm_views.images[masks == 0].any()
    words = "data.mask_use=alpha: dark has no surroundings.*score"
    assert_refused(SceneError, words, lambda: scene("dark", "alpha"), "dark")


def test_layers_are_composited_from_front_to_back_until_something_is_opaque():
    """Through a ball in a box of glass, against the formula."""
    filling = 1 - math.exp(-2.0)
    jelly = Translucent(Plain((0.0, 1.0, 0.0)), density=2.0)
    red, green = 0.3 + 0.7 * (1 - filling) * 0.3, 0.7 * filling
    unlit, light = Unlit(Plain((0.0, 0.6, 0.0))), Light(ambient=1.0, sun=0.0, sky=0.0)
    glass = Part(Box((1.0, 1.0, 1.0)), Translucent(Plain((1.0, 0.0, 0.0)), shell=0.3))
    for pattern, lit, expected, most in (
        (jelly, None, (red, green, 0.0, 1 - 0.49 * (1 - filling)), 1e-3),
        (unlit, light, (0.3, 0.7 * 0.6, 0.0, 1.0), 1e-4),
    ):
        posed = Assembly((Part(ball(0.5), pattern), glass), light=lit).pose(0)
        ray = posed.render(torch.tensor([[0.0, 0.0, 4.0]]), torch.tensor([[0.0, 0.0, -1.0]]))[0]
        assert torch.allclose(ray, torch.tensor(expected), atol=most), pattern


def test_a_folder_in_the_layout_of_d_nerf(tmp_path):
    data = suite_data(tmp_path, "dark", side=8)
    scene = data.read(("train", "val", "test"))
    counts = {split: len(views) for split, views in scene.splits.items()}
    assert counts == {"train": 3, "val": 1, "test": 2}
    assert scene.video is None
    assert data.folder.name == "dark_8px_s0_3-1-2"
    asked = {f"{split}_views": count for split, count in counts.items()}
    again = ensure_suite_scene(tmp_path, "dark", resolution=8, **asked, announce=pytest.fail)
    assert again == data.folder


@pytest.mark.parametrize(("sweep", "ending"), [("suite", ""), ("suite_test", "_test")])
def test_the_sweeps_list_every_kind(sweep, ending):
    text = (CONF / "sweep" / f"{sweep}.yaml").read_text(encoding="utf-8")
    listed = yaml.safe_load(text)["hydra"]["sweeper"]["params"]["data.scene"].split(",")
    assert listed == [kind + ending for kind in KINDS]
    assert len(listed) == 18


def test_unknown_names_are_refused_with_the_nearest():
    message = assert_refused(
        SceneError, "Did you mean 'wires'", lambda: suite_scene("wire"), "wire"
    )
    assert all(name in message for name in SUITE_SCENES)
