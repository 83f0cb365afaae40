"""Gaussians that planes deform: what is added and removed, what is drawn, what is written."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from tests.balls import ball_scene, ball_views
from tests.baselines.gaussian_oracle import rotated
from tests.baselines.runs import under
from tests.training.runs import changed
from xplanes.baselines.gaussians.densification import densify, reset_opacity, select_rows
from xplanes.baselines.gaussians.field import (
    Gaussians,
    HexPlaneGaussians,
    PointCloud,
    neighbour_distance,
)
from xplanes.baselines.gaussians.harmonics import spherical_harmonics
from xplanes.baselines.gaussians.hull import hull_points
from xplanes.baselines.gaussians.rasteriser import GaussianError, rasterise
from xplanes.baselines.gaussians.renderer import GaussianRenderer, camera_in
from xplanes.baselines.products import PlaneProducts
from xplanes.errors import ConfigError, SceneError
from xplanes.models.initialisation import Method
from xplanes.rendering.sampler import Site
from xplanes.scenes.batches import ViewBatches, ViewSettings
from xplanes.scenes.cameras import project
from xplanes.scenes.frame import Frame
from xplanes.scenes.lenses import Lenses
from xplanes.streams import TrainingState
from xplanes.tools.export import ExportOptions, export

FRAME = Frame(0.6, torch.eye(3), torch.tensor([0.3, -0.2, 0.1]))
TURN = torch.linalg.qr(torch.tensor([[1.0, 0.5, 0.2], [-0.3, 1.0, 0.4], [0.1, -0.6, 1.0]]))[0]
TURNED = replace(FRAME, rotation=TURN * torch.linalg.det(TURN).sign())


def shaken(field: Any, network: float = 0.05) -> Any:
    """The field with numbers of its own in every row, and in its network."""
    with torch.no_grad():
        for name in field.PARAMETERS[1:]:
            getattr(field, name).add_(0.3 * torch.randn_like(getattr(field, name)))
        for parameter in getattr(field, "network", torch.nn.Module()).parameters():
            parameter.add_(network * torch.randn_like(parameter))
    field.deforms.fill_(True)
    return field


def gaussians(count: int, *, degree: int = 1) -> HexPlaneGaussians:
    torch.manual_seed(0)
    planes = PlaneProducts(4, 6, [1, 2], 5, low=0.1, high=0.5)
    cloud = PointCloud(torch.rand(count, 3) - 0.5, torch.rand(count, 3))
    field = HexPlaneGaussians(cloud, degree=degree, extent=2.0, planes=planes, width=8)
    field.degree.fill_(degree)
    return shaken(field)


def stepped(field: Gaussians, steps: int = 3) -> torch.optim.Adam:
    """An optimiser of the Gaussians with moments."""
    optimizer = torch.optim.Adam([getattr(field, n) for n in field.PARAMETERS], lr=1e-3, fused=True)
    for _ in range(steps):
        for group in optimizer.param_groups:
            for parameter in group["params"]:
                parameter.grad = torch.randn_like(parameter)
        optimizer.step()
    optimizer.zero_grad()
    return optimizer


def settings(*overrides: str, model: str = "gaussians_hexplane") -> Any:
    return Method.read(changed((), f"model={model}", *overrides)).model


def control(**changes: Any) -> Any:
    return replace(settings().densify, **changes)


def test_rows_are_doubled_split_and_removed_with_their_moments():
    field = gaussians(60)
    optimizer = stepped(field)
    with torch.no_grad():
        field.logits[::7] = -8.0  # Too faint.
        field.log_scales[::2] = math.log(0.05)
        field.log_scales[1::2] = math.log(0.005)
        field.seen.copy_(torch.arange(60) % 5)
        field.slopes.copy_(torch.rand(60) * 0.002)
    before = {name: tensor.detach().clone() for name, tensor in field.rows.items()}
    moments = {
        name: {key: value.clone() for key, value in optimizer.state[getattr(field, name)].items()}
        for name in field.PARAMETERS
    }
    rules = control(threshold=0.0005, large=0.01)
    densify(field, optimizer, rules, torch.Generator().manual_seed(1), remove_large=False)

    rows = torch.arange(60)
    kept, steep = rows % 7 != 0, before["slopes"] / (rows % 5).clamp(min=1) >= 0.0005
    large = rows % 2 == 0  # 0.05 is above 0.01 of the extent, which is 2.
    stay, clones, halves = (
        rows[kept & mask] for mask in (~(steep & large), steep & ~large, steep & large)
    )
    assert len(clones) > 5
    assert len(halves) > 5
    source = torch.cat([stay, clones, halves, halves])
    assert len(field) == len(source)
    for name in field.PARAMETERS:
        now, expected = getattr(field, name).detach(), before[name][source]
        if name == "log_scales":
            expected[-2 * len(halves) :] -= math.log(1.6)
        exact = len(source) - (2 * len(halves) if name == "means" else 0)
        torch.testing.assert_close(now[:exact], expected[:exact])
        state = optimizer.state[getattr(field, name)]
        for key in ("exp_avg", "exp_avg_sq"):
            assert torch.equal(state[key][: len(stay)], moments[name][key][stay])
            assert not state[key][len(stay) :].any()
        assert state["step"] == moments[name]["step"]
    assert not field.slopes.any()
    assert not field.seen.any()
    assert len(field.slopes) == len(field.seen) == len(source)


def test_halves_are_drawn_from_the_gaussian_that_is_split():
    field = gaussians(1)
    scales, none = torch.tensor([0.5, 0.2, 0.1]), torch.zeros(4000)
    with torch.no_grad():
        select_rows(field, torch.optim.Adam([field.means]), none.long(), none.bool())
        field.log_scales.copy_(scales.log().expand(4000, 3))
        centre, quaternion = field.means[0].clone(), field.quaternions[0].clone()
    field.seen.fill_(1)
    field.slopes.fill_(1)
    rules = control(most=100_000)
    densify(field, stepped(field), rules, torch.Generator().manual_seed(2), remove_large=False)
    assert len(field) == 8000
    turned = np.stack([rotated(quaternion.double().numpy(), unit) for unit in np.eye(3)])
    offsets = (field.means.detach() - centre).double()
    along = offsets @ torch.from_numpy(turned).T / scales
    assert along.mean(dim=0).abs().max() < 0.05
    assert (along.std(dim=0) - 1).abs().max() < 0.05
    assert (torch.corrcoef(along.T) - torch.eye(3)).abs().max() < 0.05


def test_no_more_than_the_most_and_those_with_the_largest_gradients():
    field = gaussians(30)
    field.seen.fill_(1)
    field.slopes.copy_(torch.arange(1, 31))
    with torch.no_grad():
        field.log_scales.fill_(-9)
    last = field.means[-4:].detach().clone()
    rules = control(most=34)
    densify(field, stepped(field, 0), rules, torch.Generator(), remove_large=False)
    assert len(field) == 34
    assert torch.equal(field.means[30:].sort(dim=0).values, last.sort(dim=0).values)
    field.slopes.fill_(1)
    densify(field, stepped(field, 0), rules, torch.Generator(), remove_large=False)
    assert len(field) == 34


def test_resets_clear_the_moments_of_opacities_alone():
    field = gaussians(6)
    optimizer = stepped(field)
    reset_opacity(field, optimizer)
    assert float(field.opacities.detach().max()) <= 0.01 + 1e-7
    assert not optimizer.state[field.logits]["exp_avg"].any()
    assert optimizer.state[field.means]["exp_avg"].all()


def test_large_ones_are_split_before_they_are_removed():
    """As released: halves whose size is within bounds stay, whatever they came from."""
    field = gaussians(9)
    with torch.no_grad():
        # A tenth of the extent, which is 2; halves of 0.3 are smaller, those of 0.35 are not.
        field.log_scales[:6] = math.log(0.3)
        field.log_scales[6:] = math.log(0.35)
    field.seen.fill_(1)
    field.slopes[3:].fill_(1)
    densify(field, stepped(field, 0), control(), torch.Generator(), remove_large=True)
    expected = torch.full((6, 3), 0.3 / 1.6)
    torch.testing.assert_close(field.scales.detach(), expected)


@pytest.mark.parametrize("accumulate", [1, 2])
def test_a_view_counts_whole_beside_others_of_its_step(accumulate):
    model = settings("model.count=10").build(Site(FRAME, torch.tensor([0.0, 1.0]), 0, "32"))
    field = model.field
    field.deforms.fill_(True)
    optimizer = torch.optim.Adam([field.means])
    field.seen.fill_(1)
    # Of the mean of the losses of a step's views, as training differentiates it.
    field.slopes.fill_(1.2 * model.settings.densify.threshold / accumulate)
    model.before_step(TrainingState(0, 300, 300 * accumulate, 0, 0.3), optimizer)
    assert len(field) == 2
    field.seen.fill_(1)
    field.slopes.fill_(0.8 * model.settings.densify.threshold / accumulate)
    model.before_step(TrainingState(0, 400, 400 * accumulate, 0, 0.4), optimizer)
    assert len(field) == 2


def test_nothing_left_and_numbers_that_are_not_finite_are_named():
    field = gaussians(10)
    with torch.no_grad():
        field.logits.fill_(-20)
    words = r"all 10 Gaussians are fainter than model\.densify\.least_opacity=0\.005"
    with pytest.raises(GaussianError, match=words):
        densify(field, stepped(field, 0), control(), torch.Generator(), remove_large=False)
    with torch.no_grad():
        field.log_scales[3, 1] = math.nan
    view = ball_views(1, 0.6).camera(0)
    renderer = GaussianRenderer(field, antialiased=False)
    with pytest.raises(GaussianError, match=r"scales of Gaussian 3 of 10 are .*learning rate"):
        renderer.view(field, FRAME, view, 0.5, torch.ones(3))


@pytest.mark.parametrize("frame", [FRAME, TURNED], ids=["world axes", "turned"])
def test_a_gaussian_is_seen_where_its_point_is(frame):
    views = ball_views(3, 0.6, size=48)
    point = torch.tensor([[0.35, -0.25, 0.4]])
    colour = torch.tensor([0.2, 0.4, 0.9])
    cloud = PointCloud(frame.points(point), colour[None])
    field = HexPlaneGaussians(cloud, degree=0, extent=1.0, planes=None, width=8)
    with torch.no_grad():
        field.log_scales.fill_(math.log(0.02))
        field.logits.fill_(9.0)
    renderer = GaussianRenderer(field, antialiased=False)
    for index in range(3):
        image = renderer.view(field, frame, views.camera(index), 0.0, torch.ones(3))
        pose, intrinsics = views.camera_to_world[index], views.intrinsics
        column, row, _ = project(
            pose, point, focal=intrinsics.focal[index], centre=intrinsics.centre[index]
        )
        weight = image["opacity"]
        pixels = torch.arange(48) + 0.5
        found = [float((weight.sum(axis) * pixels).sum() / weight.sum()) for axis in (0, 1)]
        assert found == pytest.approx([float(column), float(row)], abs=0.05)
        best = divmod(int(weight.argmax()), 48)
        distance = float((point - pose[:3, 3]).norm()) * frame.scale
        assert float(image["depth"][best]) == pytest.approx(distance, rel=2e-3)
        shown = (image["colour"][best] - 1 + weight[best]) / weight[best]
        torch.testing.assert_close(shown, colour, atol=2e-3, rtol=0)


def test_points_on_the_hull_of_a_ball():
    views = ball_views(40, 0.6, size=64)
    torch.manual_seed(0)
    cloud = hull_points(views, FRAME, 500)
    points, colours = cloud.points, cloud.colours
    away = FRAME.to_world(points).norm(dim=1)
    cell = 2 / 48 / FRAME.scale
    assert away.max() < 0.6 + 3 * cell
    assert away.quantile(0.1) > 0.6 - 3 * cell
    expected = torch.tensor([200.0, 100.0, 50.0]) / 255
    assert (colours - expected).abs().max() < 0.02
    assert away.std() > 0
    opaque = replace(views, images=views.in_memory().index_fill(3, torch.tensor(3), 255))
    anywhere = hull_points(opaque, FRAME, 500)
    assert float(anywhere.points.abs().max()) > 0.9
    assert (anywhere.colours == 0.5).all()


def test_first_scales_are_the_distances_to_neighbours():
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0))
    distance = (points[:, None].double() - points.double()).norm(dim=-1).sort(dim=1).values
    expected = distance[:, 1:4].square().mean(dim=1).sqrt().float()
    torch.testing.assert_close(neighbour_distance(points), expected, rtol=1e-3, atol=1e-5)
    assert neighbour_distance(points[:1]) == 0.1


def test_gradients_of_the_planes_terms_are_those_of_their_values():
    overrides = (*under("model", channels=4, resolution=6), "model.loss.every=2")
    model = settings(*overrides).build(Site(FRAME, torch.linspace(0, 1, 9), 0, "32"))
    field = model.field
    field.deforms.fill_(True)
    planes = [plane for _, plane in field.products.planes()]
    with torch.no_grad():
        for plane in planes:
            plane.add_(0.3 * torch.randn_like(plane))
            plane.grad = torch.zeros_like(plane)
    state = TrainingState(0, 4, 4, 0)
    model.regularise(state)
    found = [plane.grad.clone() for plane in planes]
    weights, sum_of_all = model.settings.loss, 0.0
    for (name, plane), gradient in zip(field.products.planes(), found, strict=True):
        wide = plane.detach().double().requires_grad_()
        bend = wide.diff(2, dim=2).square().mean()
        if "t" in name:
            term = weights.time_smoothness * bend + weights.time_identity * (1 - wide).abs().mean()
        else:
            term = weights.space_smoothness * bend
        term.backward()
        sum_of_all += float(term.detach())
        torch.testing.assert_close(gradient, 2 * wide.grad.float(), rtol=1e-4, atol=1e-9)
    assert sum(model.regularisers(state).values()) == pytest.approx(sum_of_all, rel=1e-5)
    model.regularise(TrainingState(0, 5, 5, 0))
    assert all(torch.equal(a, p.grad) for a, p in zip(found, planes, strict=True))


def test_batches_are_whole_views_each_once_in_a_turn():
    views = replace(ball_views(5, 0.6, size=12), files=tuple("abcde"))
    batches = ViewBatches(views, ViewSettings(background="white"), seed=3)
    seen = []
    for step in range(10):
        batch = batches.draw(step)
        pose = batch["camera"].camera_to_world
        (index,) = [i for i in range(5) if torch.equal(pose, views.camera_to_world[i])]
        seen.append(index)
        assert torch.equal(batch["target"].view(12, 12, 3), views.composite(index, torch.ones(3)))
        assert (batch["times"] == views.times[index]).all()
        assert torch.equal(batch["alpha"].view(12, 12), views.image(index)[..., 3] / 255)
    assert sorted(seen[:5]) == sorted(seen[5:]) == list(range(5))
    assert seen[:5] != seen[5:]
    again = ViewBatches(views, ViewSettings(background="white"), seed=3)
    assert torch.equal(again.draw(7)["target"], batches.draw(7)["target"])
    coloured = ViewBatches(views, ViewSettings(background="one"), seed=3).draw(7)
    away = coloured["alpha"] == 0
    assert (coloured["target"][away] == coloured["background"][away]).all()
    assert len(coloured["background"].unique(dim=0)) == 1


def trained(field: Any) -> Any:
    """Enough of a run for exports."""
    renderer = GaussianRenderer(field, antialiased=False)
    model = SimpleNamespace(model=SimpleNamespace(name="gaussians_hexplane"))
    return SimpleNamespace(
        module=SimpleNamespace(field=field, renderer=renderer),
        experiment=SimpleNamespace(method=model),
        frame=FRAME, scene=ball_scene(), is_static=False, path=None, checkpoint="last", step=1,
    )  # fmt: skip


@pytest.mark.parametrize("degree", [0, 2])
def test_a_ply_of_a_timestep_shows_what_the_renderer_shows(tmp_path, degree):
    """Read by a library, decoded here, and drawn in the world."""
    trimesh = pytest.importorskip("trimesh")
    field = gaussians(40, degree=degree)
    run = trained(field)
    folder = export(run, ExportOptions("gaussians", times="0.25,0.75"), tmp_path / "out")
    files = sorted(path.name for path in folder.iterdir())
    assert files == ["export.json", "gaussians_0000.ply", "gaussians_0001.ply"]
    rest = 3 * ((degree + 1) ** 2 - 1)
    names = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2".split()
    names += [f"f_rest_{n}" for n in range(rest)]
    names += "opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
    camera = ball_views(3, 0.6, size=40).camera(2)
    world = replace(FRAME, scale=1.0, centre=torch.zeros(3))
    for number, time in enumerate((0.25, 0.75)):
        cloud = trimesh.load(folder / f"gaussians_{number:04d}.ply")
        assert len(cloud.vertices) == 40
        data = cloud.metadata["_ply_raw"]["vertex"]["data"]
        assert list(data.dtype.names) == names
        columns = [torch.from_numpy(np.array(data[name]).reshape(40)) for name in names]
        table = torch.stack(columns, dim=1)
        means, _, base, detail, opacity, scales, turns = table.split([3, 3, 3, rest, 1, 3, 4], 1)
        harmonics = torch.cat([base[..., None], detail.view(40, 3, -1)], dim=2).transpose(1, 2)
        eye = camera.camera_to_world[:3, 3]
        colours = (0.5 + spherical_harmonics(degree, harmonics, means - eye)).clamp(min=0)
        posed = (means, turns, scales.exp(), opacity[:, 0].sigmoid(), colours)
        image = rasterise(*posed, camera_in(world, camera), torch.ones(3))
        shown = run.module.renderer.view(field, FRAME, camera, time, torch.ones(3))
        torch.testing.assert_close(image.colour, shown["colour"], atol=2e-4, rtol=0)
        assert float(shown["opacity"].max()) > 0.3


def test_the_points_of_a_page_are_the_more_opaque_gaussians(tmp_path):
    field, run = gaussians(40), trained(gaussians(40))
    with torch.no_grad():
        field.logits.copy_(torch.linspace(-3, 3, 40)[torch.randperm(40)])
    run.module.field, run.path = field, tmp_path / "run"
    points, colours = field.cloud(0.75)
    posed = field.at(0.75)
    kept = posed.opacities >= posed.opacities.max() / 2
    assert 5 < len(points) == kept.sum() < 40
    assert torch.equal(points[0], posed.means[posed.opacities.argmax()])
    assert set(map(tuple, points.tolist())) == set(map(tuple, posed.means[kept].tolist()))
    assert ((colours >= 0) & (colours <= 1)).all()
    folder = export(run, ExportOptions("web", times="3"), tmp_path / "web")
    listed = json.loads((folder / "export.json").read_text())
    assert (listed["vertices"], listed["triangles"]) == (3 * len(points), 0)


def test_what_does_not_fit_is_refused(tmp_path):
    field = gaussians(3)
    with pytest.raises(ConfigError, match=r"--what mesh: .* set --what gaussians"):
        export(trained(field), ExportOptions("mesh", times="2"), tmp_path / "a")
    with pytest.raises(ConfigError, match="frame is rotated"):
        field.exports["gaussians"](tmp_path / "b", 0.0, TURNED)
    with pytest.raises(ConfigError, match=r"--what video: .* has none; set --what .*gaussians"):
        export(trained(field), ExportOptions("video"), tmp_path / "b")
    assert not list(tmp_path.glob("b*"))
    camera = replace(ball_views(1, 0.6).camera(0), lens=Lenses.pinholes(1))
    with pytest.raises(SceneError, match="undistort the images"):
        camera_in(FRAME, camera)


def test_scales_stay_finite_however_far_they_grow():
    field = gaussians(5)
    with torch.no_grad():
        field.log_scales[:] = 300.0
    for scales in (field.at(0.5).scales, field.scales):
        assert (scales > 100).all()
        assert scales.isfinite().all()
