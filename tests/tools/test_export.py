"""Exports: what other programs read is what the field shows."""

import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from tests.baselines.test_tineuvox_field import BOX
from tests.tools.test_drawing import FLAT, FRAME, every_renderer
from tests.warm import ROOT
from xplanes.cli import main
from xplanes.errors import ConfigError
from xplanes.fields import Decoder, XPlanes
from xplanes.fields.background import Background
from xplanes.fields.base import ViewDependentField
from xplanes.fields.xplanes import FINE_PLANES, random_planes
from xplanes.rendering.base import RayRenderer
from xplanes.rendering.behind import background_colour
from xplanes.rendering.grid_renderer import GridRenderer
from xplanes.rendering.occupancy import OccupancyGrid
from xplanes.rendering.pictures import to_bytes
from xplanes.scenes.cameras import PosedCamera, orbit
from xplanes.scenes.frame import Frame
from xplanes.scenes.views import Views
from xplanes.tools import export as module
from xplanes.tools.camera_path import read_camera_path
from xplanes.tools.export import ExportOptions, export, export_times
from xplanes.tools.runs import TrainedRun, load_run
from xplanes.training.scores import score_view

trimesh: Any = pytest.importorskip("trimesh")
pytest.importorskip("skimage")

SIZE = 40


WHOLE = GridRenderer(OccupancyGrid(16, 2, step=0.02), 192)


class Ball(ViewDependentField):
    """A ball with a soft border that moves along y; its colour tells place and direction."""

    RADIUS = 0.45

    def __init__(self, density: float = 60.0, softness: float = 0.02) -> None:
        super().__init__()
        self.density, self.softness = density, softness

    planes = {}  # noqa: RUF012
    moves = True
    precision = "32"
    outline = "a ball"

    @staticmethod
    def centre(time: float) -> Tensor:
        return torch.tensor([0.2, 0.4 * time - 0.3, -0.1])

    def geometry(self, points: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
        centre = self.centre(0) + times[:, None] * (self.centre(1) - self.centre(0))
        inside = self.RADIUS - (points - centre).norm(dim=1)
        return self.density * (inside / self.softness).sigmoid(), points

    def colour(self, features: Tensor, directions: Tensor) -> Tensor:
        return 0.5 + 0.2 * features - 0.2 * directions


def set_up(
    tmp_path: Path, field: Any, renderer: RayRenderer | None = None, frame: Frame = FRAME
) -> TrainedRun:
    """A run of a field that was set, not trained, with cameras all around it."""
    poses = orbit(6, radius=3 / frame.scale, elevation=20, target=frame.centre)
    images = torch.zeros(6, SIZE, SIZE, 4, dtype=torch.uint8)
    views = Views(images, poses, torch.zeros(6), 1.2 * SIZE, tuple("abcdef"))  # type: ignore[arg-type]
    parts = SimpleNamespace(field=field, renderer=renderer or WHOLE)
    method = SimpleNamespace(method=SimpleNamespace(model=SimpleNamespace(name="some model")))
    scene = SimpleNamespace(splits={"train": views}, background=torch.ones(3))
    content: Any = (tmp_path / "run", method, scene, "train", frame, parts, "last", 7)
    return TrainedRun(*content)


def exported(trained: TrainedRun, what: str = "mesh", **options: Any) -> tuple[Any, Tensor]:
    """What another program reads of an export, and its points in the field's frame. [N, 3]"""
    wanted = ExportOptions(what, **{"times": "0.5", "resolution": 32, **options})
    read = trimesh.load(export(trained, wanted) / f"{what}_0000.ply")
    return read, trained.frame.points(torch.tensor(np.asarray(read.vertices)).float())


def from_outside(points: Tensor, depth: float) -> tuple[np.ndarray, Tensor]:
    """Colours that a `Ball` shows along normals from below its surface, and distances to it."""
    outward = points - Ball.centre(0.5)
    distance = outward.norm(dim=1, keepdim=True)
    outward = outward / distance
    colours = 0.5 + 0.2 * (points - depth * outward) + 0.2 * outward
    return colours.numpy(), (distance - Ball.RADIUS).abs()


@pytest.mark.parametrize("form", ["ply", "glb"])
def test_a_ball_comes_out_where_it_is_in_the_world(tmp_path, form):
    trained, resolution = set_up(tmp_path, Ball(500.0, 0.002)), 40
    options = ExportOptions(times="0,1", resolution=resolution, form=form)
    folder = export(trained, options)
    assert folder == trained.path / "export" / "mesh"
    texel = 2 / resolution / FRAME.scale
    listed = json.loads((folder / "export.json").read_text())
    assert listed["files"] == [f"mesh_0000.{form}", f"mesh_0001.{form}"]
    for name, time in zip(listed["files"], listed["times"], strict=True):
        mesh = trimesh.load(folder / name, force="mesh")
        mesh.merge_vertices()
        centre = FRAME.to_world(Ball.centre(time)).numpy()
        if form == "glb":  # Whose y axis points up.
            centre = centre[[0, 2, 1]] * [1, 1, -1]
        distance = np.linalg.norm(mesh.vertices - centre, axis=1)
        assert np.abs(mesh.bounds.mean(axis=0) - centre).max() < 0.5 * texel
        assert np.abs(distance - Ball.RADIUS / FRAME.scale).max() < texel
        assert mesh.is_watertight
        assert mesh.volume > 0


@pytest.mark.parametrize("what", ["mesh", "points"])
def test_glb_files_are_matt_and_leave_the_world_to_a_node(tmp_path, what):
    options = ExportOptions(what, times="0,1", resolution=24, form="glb")
    folder = export(set_up(tmp_path, Ball(500.0, 0.002)), options)
    content = (folder / f"{what}_0000.glb").read_bytes()
    tree = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    (primitive,) = (each for mesh in tree["meshes"] for each in mesh["primitives"])
    surface = tree["materials"][primitive["material"]]["pbrMetallicRoughness"]
    assert (surface["metallicFactor"], surface["roughnessFactor"]) == (0, 1)
    colours = tree["accessors"][primitive["attributes"]["COLOR_0"]]
    assert colours["componentType"] == (5126 if what == "mesh" else 5121)  # Floats, or bytes.
    assert "_EXACT" not in primitive["attributes"]
    (node,) = (node for node in tree["nodes"] if "mesh" in node)
    turn = np.array(node["matrix"]).reshape(4, 4).T
    assert (turn[:3, :3] @ [0, 0, 1]).round(6).tolist() == [0, 1, 0]


def test_the_silhouette_of_a_mesh_is_that_of_the_field(tmp_path):
    trained, centre = set_up(tmp_path, Ball(6.0, 0.05)), Ball.centre(0.5)
    pose = orbit(5, radius=7, elevation=-35, target=FRAME.centre)[2]
    origins, directions = FRAME.rays(*PosedCamera(pose, 1.2 * SIZE, SIZE, SIZE).rays())
    image = trained.module.renderer.image(
        trained.module.field, origins, directions, 0.5, torch.ones(3)
    )
    shown = image["opacity"] >= 0.5
    assert shown.sum() > 100
    away = torch.linalg.cross(origins - centre, directions).norm(dim=1)
    covered = away < (exported(trained)[1] - centre).norm(dim=1).mean()
    assert (covered & shown).sum() > 0.95 * (covered | shown).sum()


def test_colours_of_vertices_are_those_that_the_field_shows_along_normals(tmp_path):
    mesh, points = exported(set_up(tmp_path, Ball()))
    expected, _ = from_outside(points, 1 / 16)
    found = np.asarray(mesh.visual.vertex_colors)[:, :3] / 255
    assert np.abs(found - expected).max() < 0.05
    assert np.ptp(expected, axis=0).min() > 0.4


def test_a_point_cloud_lies_on_the_surface(tmp_path):
    cloud, points = exported(set_up(tmp_path, Ball()), "points", resolution=40, count=500)
    assert cloud.vertices.shape == (500, 3)
    expected, away = from_outside(points, 1 / 20)
    assert float(away.max()) < 0.07
    assert np.abs(cloud.colors[:, :3] / 255 - expected).max() < 0.08


def test_what_lies_in_empty_cells_is_left_out_and_not_asked_for(tmp_path):
    grid = OccupancyGrid(16, 2, step=0.02)
    allowed = torch.ones(2, 16, 16, 16, dtype=torch.bool)
    allowed[:, :, :, 9:] = False  # x
    grid.allow(allowed)
    asked = []

    class Watched(Ball):
        def geometry(self, points: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
            asked.append(float(points[:, 0].max()))
            return super().geometry(points, times)

    trained = set_up(tmp_path, Watched(), GridRenderer(grid, 192))
    mesh = module._surface(trained, 0.5, 32, 10.0)
    border = 9 / 8 - 1
    assert max(asked) < border
    assert mesh.vertices[:, 0].max() < border + 1 / 16
    assert mesh.is_watertight


@pytest.mark.parametrize("name", ["occupancy", "fixed step"])
def test_the_threshold_is_the_density_of_the_surface(tmp_path, name):
    field, renderer = every_renderer()[name]
    if name == "fixed step":
        torch.nn.init.normal_(field.grid, std=3)
    trained, resolution = set_up(tmp_path, field, renderer, FLAT), 48
    volume, _ = module._solidity(trained, 0.5, resolution)
    threshold = float(-torch.log1p(-volume[volume > 0]).median()) * resolution / 2
    _, points = exported(trained, resolution=resolution, threshold=threshold)
    low, high = BOX if name == "fixed step" else torch.tensor([[-1.0] * 3, [1.0] * 3])
    points = points[((points > low + 0.05) & (points < high - 0.05)).all(dim=1)]
    assert len(points) > 100
    with torch.no_grad():
        density = trained.module.field(points, torch.full_like(points[:, 0], 0.5))[1]
    assert density.median() == pytest.approx(threshold, rel=0.05)


def test_a_field_of_signed_distances_gives_its_own_surface(tmp_path):
    field, renderer = every_renderer()["neus"]
    trained = set_up(tmp_path, field, renderer)
    _, points = exported(trained, times="0.0")
    with torch.no_grad():
        distance = field.distance(field.canonical(points, torch.zeros(len(points))))[0]
    assert float(distance.abs().max()) < 0.03
    assert len(points) > 500
    with pytest.raises(ConfigError, match="--threshold 3: this field has a surface"):
        export(trained, ExportOptions(threshold=3), tmp_path / "other")


def written_reader(name: str = "Planes") -> Any:
    """A class that docs/recipes.md prints."""
    page = (ROOT / "docs" / "recipes.md").read_text(encoding="utf-8")
    names: dict[str, Any] = {}
    for first in (r"import json\n.*?^    class Planes:", r"class World\(Planes\):"):
        found = re.search(rf"^    {first}.*?(?=^\S)", page, re.M | re.S)
        assert found
        code = re.sub(r"^    ", "", found[0], flags=re.M)
        assert len(code.splitlines()) < 60
        exec(code, names)
    return names[name]


def x_planes(plane_set: str, *, fine: bool = False, **parts: Any) -> XPlanes:
    """A small field with random planes."""
    size = {"channels": 5, "resolution": 9, "time_resolution": 4}
    random = {"space_scale": 1, "time_scale": 1, "generator": torch.Generator().manual_seed(0)}
    made = random_planes(plane_set, **size, **random)
    if fine:
        made |= {name: torch.randn(3, 17, 17) for name in FINE_PLANES}
    return XPlanes(planes=made, plane_set=plane_set, **parts)


@pytest.mark.parametrize("plane_set", ["three", "six", "nine", "six, fine"])
def test_the_documented_reader_gives_the_values_of_the_field(tmp_path, monkeypatch, plane_set):
    monkeypatch.setitem(sys.modules, "skimage.measure", None)  # Planes need no extra.
    options: dict[str, Any] = {"activation": "silu", "density": "exp", "density_scale": 3.0}
    options = {} if plane_set == "six" else options | {"colour_margin": 0.0}
    plane_set, _, fine = plane_set.partition(", ")
    field = x_planes(plane_set, fine=bool(fine), decoder=Decoder(5, width=16, **options))
    trained = set_up(tmp_path, field)
    folder = export(trained, ExportOptions(what="planes"))
    world = FRAME.to_world(torch.rand(200, 3) * 2.2 - 1.1)
    times = torch.rand(200)
    colour, density = written_reader()(folder / "planes.safetensors")(world, times)
    with torch.no_grad():
        expected = field(FRAME.points(world), times)
    torch.testing.assert_close(colour, expected[0], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(density, expected[1], atol=1e-5, rtol=1e-5)
    assert float(expected[0].std()) > 0.01


@pytest.mark.parametrize("samples", [0, 7])
def test_the_documented_reader_sees_the_background_of_the_field(tmp_path, samples):
    torch.manual_seed(0)
    background = Background(4, 12, width=8, samples=samples)
    with torch.no_grad():
        background.planes.mul_(3000)
    field = x_planes("six", decoder=Decoder(5), background=background)
    trained = set_up(tmp_path, field)
    folder = export(trained, ExportOptions(what="planes"))
    origins, aims = FRAME.to_world(torch.randn(2, 300, 3))
    directions = torch.nn.functional.normalize(aims - origins, dim=1)
    found = written_reader("World")(folder / "planes.safetensors").behind(origins, directions)
    with torch.no_grad():
        expected = background_colour(background, *FRAME.rays(origins, directions))
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=0)
    assert float(expected.std()) > 0.05


def test_the_training_cameras_are_a_path_that_is_rendered_again(trained_run, tmp_path):
    out = tmp_path / "path"
    assert main(["export", str(trained_run), "--what", "path", "--out", str(out)]) == 0
    trained = load_run(trained_run)
    views = trained.scene.splits["train"]
    order = views.times.argsort(stable=True)
    names = ["camera_path.json", "transforms.json"]
    assert json.loads((out / "export.json").read_text())["files"] == names
    for name in names:
        path = read_camera_path(out / name)
        assert torch.equal(path.poses, views.camera_to_world[order])
        assert torch.equal(path.times, views.times[order])
        assert (path.height, path.width, path.fps) == (views.height, views.width, 16)
        focal = views.intrinsics.focal[order, 1].float()
        torch.testing.assert_close(path.focal(views.height, views.width), focal)
        arguments = ["--path", str(out / name), "--out", f"{tmp_path}/{name}/"]
        assert main(["render", str(trained_run), *arguments]) == 0
        for number in (0, len(views) - 1):
            parts = (trained.module.field, trained.module.renderer, trained.frame)
            index, white = int(order[number]), trained.scene.background
            expected = score_view(*parts, views, index, white)[1]
            with Image.open(tmp_path / name / f"frame_{number:04d}.png") as frame:
                found = torch.tensor(np.asarray(frame)).int()
            assert (found - to_bytes(expected["colour"]).int()).abs().max() <= 1


def test_the_command_exports_a_run(trained_run, tmp_path, capsys):
    out = tmp_path / "meshes"
    arguments = ["--times", "2", "--resolution", "32", "--out", str(out)]
    assert main(["export", str(trained_run), *arguments]) == 0
    assert f"wrote {out}" in capsys.readouterr().out
    mesh = trimesh.load(out / "mesh_0001.ply")
    corners = load_run(trained_run).frame.points(torch.tensor(mesh.vertices).float())
    assert float(corners.abs().max()) <= 1.001
    assert len(mesh.faces) > 100
    assert mesh.is_watertight
    assert main(["export", str(trained_run), "--what", "planes", "--out", str(out)]) == 1
    assert "already contains files" in capsys.readouterr().err


def test_times():
    times = {"3": [0, 0.5, 1], "1": [0], "0.5": [0.5], "0,0.25, 1": [0, 0.25, 1]}
    assert {text: export_times(text) for text in times} == times


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"resolution": 4}, "--resolution 4: must lie between 8 and"),
        ({"count": 0}, "--points 0"),
        ({"threshold": -1.0}, "--threshold -1"),
        ({"threshold": float("nan")}, "--threshold nan"),
        ({"times": "2.5"}, "--times 2.5"),
        *(
            ({"times": text}, f"--times {text}")
            for text in ("0", "", "soon", "0,2", "nan,", "-0.5")
        ),
        ({"what": "gaussians", "form": "glb"}, "--format glb: --what gaussians does not use"),
        ({"what": "path", "times": "3"}, "--times 3: --what path does not use"),
        ({"what": "mesh", "count": 9}, "--points 9: --what mesh does not use"),
    ],
)
def test_bad_options_are_refused(options, words):
    with pytest.raises(ConfigError, match=words):
        ExportOptions(**options).check()


def test_exports_that_cannot_be_are_refused(tmp_path):
    trained, out = set_up(tmp_path, Ball(density=0.1)), tmp_path / "out"
    with pytest.raises(ConfigError, match="no pixel of the training cameras has an opacity"):
        export(trained, ExportOptions(resolution=16), out)
    with pytest.raises(ConfigError, match=r"nowhere above the threshold 5; the largest is 0\.1"):
        export(trained, ExportOptions(resolution=16, threshold=5.0), out)
    if out.is_dir():  # The way out, another threshold, finds room there.
        assert not list(out.iterdir())
    with pytest.raises(ConfigError, match="--what planes: some model has no planes"):
        export(trained, ExportOptions(what="planes"), out)
    out.write_text("in the way")
    with pytest.raises(ConfigError, match="is a file"):
        export(trained, ExportOptions(), out)
