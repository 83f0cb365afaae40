"""Cameras whose poses are slightly wrong are corrected while a field is trained."""

from dataclasses import replace

import pytest
import torch

from tests.balls import RAYS, ball_scene, surrounding
from tests.training.runs import checkpoint, gone_on, metrics, same_state, small_config
from xplanes import RadianceModule
from xplanes.errors import ConfigError
from xplanes.rendering import refining
from xplanes.rendering.base import Rendering
from xplanes.rendering.marching import Samples
from xplanes.rendering.refining import CameraCorrections, rotations, without_common
from xplanes.run import run
from xplanes.scenes.batches import RayBatches, ViewBatches, ViewSettings
from xplanes.scenes.cameras import project
from xplanes.scenes.datamodule import SceneDataModule, whole_view
from xplanes.scenes.frame import CameraGroups, cube_frame
from xplanes.scenes.views import Views
from xplanes.tools.runs import load_run
from xplanes.training.scores import score_view

SIZE, FOCAL, RADIUS = 64, 80.0, 0.8
FRAME = cube_frame(1.25, torch.tensor([0.1, 0.0, -0.1]))


def ball(origins, directions):
    """Colour, opacity and depth of a painted ball in a painted world, in the field's frame."""
    along = -(origins * directions).sum(dim=-1)
    half = RADIUS**2 - (origins.square().sum(dim=-1) - along.square())
    hit = half > 0
    depth = along - half.clamp(min=0).sqrt()
    points = origins + depth[:, None] * directions
    colour = 0.5 + 0.25 * (torch.sin(7 * points) + torch.cos(5 * points.roll(1, dims=-1)))
    sky = 0.5 + 0.4 * torch.sin(6 * directions)
    opacity = hit.float()
    return torch.where(hit[:, None], colour, sky), opacity, opacity * depth


def views_of(poses):
    """What cameras see of the ball, in the world of `FRAME`. poses [V, 4, 4]"""
    blank = torch.full((len(poses), SIZE, SIZE, 4), 255, dtype=torch.uint8)
    files = tuple(f"{number}.png" for number in range(len(poses)))
    views = Views(blank, poses, torch.linspace(0, 1, len(poses)), FOCAL, files)
    for index, image in enumerate(blank):
        colour, _, _ = ball(*FRAME.rays(*views.image_rays(index)))
        image[..., :3] = (255 * colour).round().byte().view(SIZE, SIZE, 3)
    return views


def disturbed(poses, pixels, seed=3):
    """Poses with random turns and shifts that move the ball by about so many pixels."""
    generator = torch.Generator().manual_seed(seed)
    size = torch.tensor([[1.0], [float(poses[0, :3, 3].norm())]]) * 0.5 * pixels / FOCAL
    turn, shift = torch.randn(2, len(poses), 3, generator=generator) * size[:, None]
    found = poses.clone()
    found[:, :3, :3] = rotations(turn) @ poses[:, :3, :3]
    found[:, :3, 3] += shift
    return found


def apart(poses, truth):
    """Pixels by which points of the ball are displaced. [V]"""
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(40, 3, generator=generator, dtype=torch.float64)
    points = FRAME.centre.double() + RADIUS / FRAME.scale * points / points.norm(dim=1)[:, None]
    lens = {"focal": torch.tensor([FOCAL, FOCAL]), "centre": torch.tensor([SIZE / 2, SIZE / 2])}
    here, there = (
        torch.stack([torch.stack(project(pose.double(), points, **lens)[:2]) for pose in given])
        for given in (poses, truth)
    )
    return (here - there).square().sum(dim=1).mean(dim=1).sqrt()


def batches_of(views, rays=2048):
    settings = replace(RAYS, per_batch=rays, skip_background=False, background_share=1.0)
    batches = RayBatches(views, FRAME, settings, seed=0)
    batches.add_slopes()
    return batches


def refined(views, rounds=12):
    """Corrections of the cameras of ``views`` in front of the true ball."""
    batches = batches_of(views)
    cameras = CameraCorrections(CameraGroups.of(views, FRAME))
    for step in range(8 * rounds):
        rays = cameras.corrected_rays(batches.draw(step))
        colour, opacity, depth = ball(rays["origins"], rays["directions"])
        seen = Rendering(colour, opacity, depth, torch.empty(0), None)  # pyright: ignore
        cameras.observe(rays, seen)
        if step % 8 == 7:
            cameras.solve()
    return cameras


def test_cameras_return_to_where_they_stood(monkeypatch):
    # This field is exact and does not follow the cameras: nothing about their place is arbitrary.
    monkeypatch.setattr(refining, "PULL", 0.0)
    monkeypatch.setattr(refining, "without_common", lambda places, motion, metric, known: motion)
    truth = surrounding(10, 4.0)
    views = views_of(truth)
    wrong = disturbed(truth, 2.5)
    before = apart(wrong, truth)
    cameras = refined(replace(views, camera_to_world=wrong))
    after = apart(cameras.corrected(wrong, FRAME), truth)
    assert before.mean() > 1.5
    assert after.max() < 0.1
    # The poses in the world are those whose rays were cast.
    found = replace(views, camera_to_world=cameras.corrected(wrong, FRAME))
    rays = batches_of(replace(views, camera_to_world=wrong)).draw(0)
    expected = batches_of(found).draw(0)
    corrected = cameras.corrected_rays(rays)
    for name in ("origins", "directions", "across"):
        assert torch.allclose(corrected[name], expected[name], atol=2e-6), name
    # Held-out frames of these cameras share their corrections; other cameras are left alone.
    both = torch.stack([truth[0], wrong[3]])
    assert torch.equal(
        cameras.corrected(both, FRAME), torch.stack([truth[0], found.camera_to_world[3]])
    )
    # What they are said to have moved is what is seen of the ball.
    moved = apart(cameras.corrected(wrong, FRAME), wrong)
    assert cameras.moved[cameras.index].mean() == pytest.approx(float(moved.mean()), rel=0.25)


def test_exact_cameras_stay_and_a_fixed_camera_has_one_pose():
    poses = surrounding(5, 4.0).repeat_interleave(3, dim=0)
    cameras = refined(views_of(poses), rounds=3)
    assert len(cameras.motion) == 5
    assert len(cameras.index.view(5, 3).unique(dim=1).T) == 1
    assert cameras.moved.max() < 0.05


def test_corrections_are_the_same_on_a_gpu(fake_gpu):
    truth = surrounding(6, 4.0)
    views = replace(views_of(truth), camera_to_world=disturbed(truth, 1.0))
    found = []
    for device in (torch.device("cpu"), fake_gpu):
        cameras = CameraCorrections(CameraGroups.of(views, FRAME)).to(device)
        for step in range(4):
            drawn = batches_of(views).draw(step)
            rays = cameras.corrected_rays({name: value.to(device) for name, value in drawn.items()})
            shown = ball(rays["origins"].cpu(), rays["directions"].cpu())
            seen = (part.to(device) for part in shown)
            cameras.observe(rays, Rendering(*seen, torch.empty(0), None))  # pyright: ignore
        cameras.solve()
        found.append(cameras.motion.cpu())
    assert found[0].abs().max() > 1e-3
    assert torch.allclose(found[0], found[1], atol=1e-6)


def test_what_the_field_can_undo_is_removed():
    generator = torch.Generator().manual_seed(1)
    places = torch.randn(6, 3, generator=generator, dtype=torch.float64)
    own = torch.randn(6, 6, generator=generator, dtype=torch.float64)
    root = torch.randn(6, 6, 6, generator=generator, dtype=torch.float64)
    metric, known = root @ root.mT + torch.eye(6), torch.ones(6, dtype=torch.bool)
    turn = torch.tensor([0.1, -0.2, 0.3]).double().expand(6, 3)
    shift = torch.tensor([1.0, 2.0, -1.0]).double()
    moved = torch.linalg.cross(turn, places) + shift + 0.4 * places
    common = torch.cat([turn, moved], dim=1)
    alone = without_common(places, own, metric, known)
    assert torch.allclose(without_common(places, own + common, metric, known), alone, atol=1e-9)
    # A camera without rays stays as it was.
    known[2] = False
    assert torch.equal(without_common(places, own, metric, known)[2], own[2])


def test_rays_that_say_nothing_move_nothing():
    views = views_of(surrounding(4, 4.0))
    cameras = CameraCorrections(CameraGroups.of(views, FRAME))
    rays = batches_of(views).draw(0)
    target, one = rays["target"], torch.ones(len(rays["times"]))
    # Pixels of a fisheye lens beside the last one with a ray.
    same = rays | {"across": torch.zeros_like(rays["across"])}
    lost = torch.full_like(one, torch.nan)
    # Rays without slots for their samples.
    none = torch.empty(0, dtype=torch.int64)
    left_out = Samples(none, none, torch.empty(0, 3), none, none, 0, 0, 0, shown=one == 0)
    cases = (
        (rays, torch.full_like(target, torch.nan), one, None),
        (rays, target, one, None),
        (same, target / 2, one, None),
        (rays, target / 2, lost, None),
        (rays, target / 2, one, left_out),
    )
    for drawn, colour, opacity, samples in cases:
        cameras.observe(drawn, Rendering(colour, opacity, one, one, samples))  # pyright: ignore
        cameras.solve()
        assert torch.equal(cameras.motion, torch.zeros(4, 6))
    cameras.observe(rays, Rendering(target / 2, one, one, one, None))  # pyright: ignore
    cameras.solve()
    assert (cameras.motion != 0).any(dim=1).all(), "what said nothing has done no harm"


def test_cameras_that_few_rays_show_are_corrected_in_the_end():
    """Between two corrections each of them gets fewer rays than it needs."""
    truth = surrounding(60, 4.0)
    views = replace(views_of(truth), camera_to_world=disturbed(truth, 1.0))
    batches = batches_of(views, rays=512)
    cameras = CameraCorrections(CameraGroups.of(views, FRAME))
    observed = []
    for step in range(120):
        rays = cameras.corrected_rays(batches.draw(step))
        seen = ball(rays["origins"], rays["directions"])
        cameras.observe(rays, Rendering(*seen, torch.empty(0), None))  # pyright: ignore
        if step % 4 == 3:
            observed.append(float(cameras.rays.max()))
            cameras.solve()
    assert observed[0] < refining.LEAST_RAYS
    assert (cameras.moved > 0).all()


def test_slopes_are_those_of_the_colours():
    """On a plane of colours the differences are exact, with the background behind its alpha."""
    views = views_of(surrounding(2, 4.0))
    row, column = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    planes = torch.stack([2 * column, 3 * row, column + row, 128 + column], dim=-1)
    images = planes.clamp(max=255).to(torch.uint8).expand(2, -1, -1, -1).contiguous()
    rays = batches_of(replace(views, images=images)).draw(0)
    _, pixel = torch.where(rays["alpha"][:, None] * 255 == torch.arange(256.0))
    inside = (pixel - 128 >= 2) & (pixel - 128 < SIZE - 2)
    expected = torch.tensor([[2.0, 0], [0, 3], [1, 1]]) - torch.tensor([[1.0, 0]])
    slopes = rays["slopes"][inside] * 255
    middle = slopes[:, 1, 1].isclose(torch.tensor(3.0), atol=1e-4).float().mean()
    assert middle > 0.85  # All but the uppermost and lowest rows.
    assert torch.allclose(slopes[..., 0], expected[:, 0].expand(len(slopes), 3), atol=1e-4)
    assert (rays["across"].mul(rays["directions"][:, None]).sum(dim=-1).abs() < 2e-2).all()


def test_batches_without_rays_in_memory_are_refused():
    views = views_of(surrounding(2, 4.0))
    with pytest.raises(ConfigError, match=r"refine_cameras=true: this model trains on whole views"):
        ViewBatches(views, ViewSettings(background="white"), seed=0).add_slopes()


@pytest.fixture
def soon(monkeypatch):
    """Corrections from the fourth step on."""
    for name, value in (("FIRST", 4), ("EVERY", 2), ("LEAST_RAYS", 5.0)):
        monkeypatch.setattr(refining, name, value)


def test_a_run_refines_its_cameras(soon, scenes, tmp_path):
    few = ("data.refine_cameras=true", "callbacks.evaluation.at=[]", "logger=none")
    folder = tmp_path / "run"
    run(small_config(scenes, *few, "trainer.max_steps=9"), folder, [], resume=False)
    found = metrics(folder)["cameras"]
    assert 0 < found["mean_px"] <= found["most_px"]
    assert found["farthest"] in found["camera_to_world"]
    assert "cameras  moved by" in (folder / "train.log").read_text()
    trained = load_run(folder)
    train = trained.scene.splits["train"]
    assert train.camera_to_world.tolist() == list(found["camera_to_world"].values())
    loaded = RadianceModule.load_from_checkpoint(folder / "checkpoints" / "last.ckpt")
    same_state(loaded.state_dict(), checkpoint(folder)["state_dict"])
    exact = small_config(scenes, *few, "data.refine_cameras=false", "trainer.max_steps=12")
    with pytest.raises(ConfigError, match=r"trained with data\.refine_cameras=True"):
        run(exact, folder, [], resume=True)


def test_refinement_goes_on_exactly(soon, scenes, tmp_path):
    """From a checkpoint between two corrections, with sums that are half done."""
    scene = replace(ball_scene(), refine_cameras=True)
    whole, parts = (
        end["state_dict"] for end in gone_on(scene, small_config(scenes), tmp_path, 12, 7)
    )
    assert whole["cameras.motion"].abs().max() > 0
    same_state(whole, parts)


def test_a_scene_in_python_says_whether_its_cameras_are_refined():
    scene = ball_scene()
    for wanted in (False, True):
        data = SceneDataModule.of(replace(scene, refine_cameras=wanted))
        assert ("slopes" in data.batches(0).draw(0)) == wanted


def test_a_frame_held_out_of_a_corrected_camera_is_rendered_from_the_corrected_pose(scenes):
    scene = replace(ball_scene(), refine_cameras=True)
    module = RadianceModule(small_config(scenes))
    module.build(scene)
    views, background = scene.splits["train"], scene.background
    item = whole_view(views, 0, background)
    given = module.predict_step(item, 0)
    module.sampler.modules["cameras"].motion[:, 3] = 0.2
    poses = module.corrected(views.camera_to_world)
    moved = replace(views, camera_to_world=poses)
    parts = module.field, module.renderer, module.frame
    expected = score_view(*parts, moved, 0, background)[1]["colour"]
    assert torch.equal(module.predict_step(item, 0)["colour"], expected)
    assert not torch.equal(given["colour"], expected)
