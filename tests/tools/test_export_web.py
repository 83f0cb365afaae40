"""The web page: it shows what the field holds, needs nothing else, and fits."""

import base64
import hashlib
import importlib
import json
import re
import zlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from tests.tools.browser import browser, canvas_of, needs_browser, until
from tests.tools.test_export import FRAME, Ball, set_up
from xplanes.cli import main
from xplanes.errors import ConfigError
from xplanes.scenes.frame import Frame
from xplanes.tools import export_web as module
from xplanes.tools.export import ExportOptions, export
from xplanes.tools.runs import TrainedRun

trimesh: Any = pytest.importorskip("trimesh")
pytest.importorskip("skimage")


def page_of(trained: TrainedRun, out: Path | None = None, **options: Any) -> Path:
    wanted = ExportOptions("web", **{"times": "0,1", "resolution": 24, **options})
    return export(trained, wanted, out) / "index.html"


def content_of(page: Path) -> dict[str, Any]:
    text = page.read_text(encoding="utf-8").split('type="application/json">')[1]
    return json.loads(text.split("</script>")[0])


def unpacked(content: bytes, columns: int, form: str) -> np.ndarray:
    """The inverse of `packed`, as the page has it."""
    width = np.dtype(form).itemsize
    split = np.frombuffer(content, np.uint8).reshape(columns, width, -1).transpose(0, 2, 1)
    steps = np.ascontiguousarray(split).view(form)[..., 0]
    return np.cumsum(steps, axis=1, dtype=form).T


def read(shape: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices in the world, their colours and the triangles of a shape in a page."""
    content, count = zlib.decompress(base64.b64decode(shape["data"])), shape["vertices"]
    cells = unpacked(content[: 6 * count], 3, "<u2")
    colours = unpacked(content[6 * count : 9 * count], 3, "u1")
    places = np.array(shape["low"]) + cells / 65535 * np.array(shape["size"])
    return places, colours, unpacked(content[9 * count :], 3, "<u4")


def test_a_page_holds_the_meshes_that_are_exported_as_files(tmp_path):
    trained = set_up(tmp_path, Ball())
    content = content_of(page_of(trained))
    wanted = ExportOptions("mesh", times="0,1", resolution=24)
    folder = export(trained, wanted, tmp_path / "mesh")
    assert content["times"] == [0, 1]
    for number, shape in enumerate(content["shapes"]):
        mesh = trimesh.load(folder / f"mesh_{number:04d}.ply", process=False)
        places, colours, faces = read(shape)
        assert np.abs(places - mesh.vertices).max() < 1e-4 / FRAME.scale
        assert np.array_equal(colours, mesh.visual.vertex_colors[:, :3])
        assert np.array_equal(faces, mesh.faces)
        assert shape["faces"] == len(faces) > 100


def test_the_page_needs_no_other_file(tmp_path):
    trained = set_up(tmp_path, Ball())
    page = page_of(trained)
    text = page.read_text(encoding="utf-8")
    assert "default-src 'none'" in text
    assert re.findall(r"\b(?:src|href)=\"(?!data:)", text) == []
    assert re.findall(r"\b(?:fetch|XMLHttpRequest|import)\(", text.split("</script>")[-2]) == []
    assert "{{" not in text.replace(module.PARTS.joinpath("three.min.js").read_text("utf-8"), "")
    listed = json.loads((trained.path / "export" / "web" / "export.json").read_text())
    assert listed["files"] == ["index.html"]
    assert listed["bytes"] == len(text.encode())
    assert listed["triangles"] == sum(shape["faces"] for shape in content_of(page)["shapes"])


def test_the_copy_of_three_is_the_one_that_is_stated(tmp_path):
    stated = json.loads((module.PARTS / "three.json").read_text(encoding="utf-8"))
    script = (module.PARTS / stated["file"]).read_bytes()
    assert hashlib.sha256(script).hexdigest() == stated["sha256"]
    licence = (module.PARTS / stated["licence_file"]).read_text(encoding="utf-8")
    text = page_of(set_up(tmp_path, Ball())).read_text(encoding="utf-8")
    assert licence in text
    assert f"three.js {stated['version']}" in text
    assert f"three@{stated['version']}" in stated["build"]


def test_names_are_text_and_fill_nothing(tmp_path):
    trained = set_up(tmp_path, Ball())
    named = replace(trained, path=tmp_path / "a<b>{{run}}")
    text = page_of(named).read_text(encoding="utf-8")
    assert "<title>a&lt;b&gt;{{run}}</title>" in text


def test_triangles_are_left_out_until_the_page_fits(tmp_path, monkeypatch, capsys):
    trained = set_up(tmp_path, Ball())
    options = ExportOptions("web", times="3", resolution=64)
    whole = export(trained, options, tmp_path / "whole") / "index.html"
    assert "reduced" not in capsys.readouterr().out
    scripts = sum(len((module.PARTS / name).read_bytes()) for name in ("page.html", "three.min.js"))
    limit = scripts + module.SPARE + (whole.stat().st_size - scripts) // 3
    monkeypatch.setattr(module, "LIMIT", limit)
    small = export(trained, options, tmp_path / "small") / "index.html"
    assert small.stat().st_size < limit < whole.stat().st_size
    listed = json.loads((tmp_path / "small" / "export.json").read_text())
    assert 16 < listed["resolution"] < 64
    assert f"resolution {listed['resolution']}; reduced to" in capsys.readouterr().out
    monkeypatch.setattr(module, "LIMIT", scripts + module.SPARE + 100)
    with pytest.raises(ConfigError, match="--times 3: these timesteps do not fit"):
        export(trained, options, tmp_path / "none")


def test_points_are_shown_where_their_number_is_given(tmp_path):
    content = content_of(page_of(set_up(tmp_path, Ball(500.0, 0.002)), count=700))
    for shape, time in zip(content["shapes"], (0.0, 1.0), strict=True):
        places, _, faces = read(shape)
        assert (len(places), len(faces)) == (700, 0)
        distance = np.linalg.norm(places - FRAME.to_world(Ball.centre(time)).numpy(), axis=1)
        assert np.abs(distance - Ball.RADIUS / FRAME.scale).max() < 2 / 24 / FRAME.scale
    # About as large as it takes to cover the ball.
    spacing = (4 * np.pi * (Ball.RADIUS / FRAME.scale) ** 2 / 700) ** 0.5
    assert 0.8 * spacing < content["point"] < 2.5 * spacing


class Swarm(Ball):
    """A field that has points of its own and no density."""

    def cloud(self, time: float) -> tuple[torch.Tensor, torch.Tensor]:
        points = torch.tensor([[0.5, 0.0, time], [0.0, 0.5, 0.0], [0.0, 0.0, 0.5]])
        return points, torch.eye(3)


def test_a_field_without_a_density_shows_its_own_points(tmp_path):
    trained = set_up(tmp_path, Swarm(), SimpleNamespace())  # type: ignore[arg-type]
    places, colours, _ = read(content_of(page_of(trained, tmp_path / "all"))["shapes"][1])
    expected, _ = Swarm().cloud(1.0)
    order = colours.argmax(axis=1)
    assert np.abs(places - FRAME.to_world(expected).numpy()[order]).max() < 1e-4
    (two, _) = content_of(page_of(trained, tmp_path / "two", count=2))["shapes"]
    assert two["vertices"] == 2
    with pytest.raises(ConfigError, match="--threshold 3: this field has points of its own"):
        page_of(trained, tmp_path / "none", threshold=3.0)


def test_the_command_writes_a_page(trained_run, tmp_path, capsys):
    arguments = ["--what", "web", "--times", "2", "--resolution", "32"]
    assert main(["export", str(trained_run), *arguments, "--out", str(tmp_path / "web")]) == 0
    assert re.search(r"page        2 timesteps, [\d,]+ triangles", capsys.readouterr().out)
    assert content_of(tmp_path / "web" / "index.html")["background"] == [1, 1, 1]


def ball_on(page: Any) -> tuple[float, float, np.ndarray]:
    """Row and column of the middle of what is drawn, and its mean colour above and below."""
    picture = canvas_of(page)[:-90]  # Above the controls.
    drawn = (picture < 250).any(axis=-1)
    rows, columns = drawn.nonzero()
    upper = rows < rows.mean()
    halves = [picture[rows[half], columns[half]].mean(axis=0) for half in (upper, ~upper)]
    return rows.mean(), columns.mean(), halves[0] - halves[1]


@pytest.mark.slow
@needs_browser
def test_a_browser_plays_the_page(tmp_path):
    """The ball moves along y, here to the right, and is bluer above: its colour tells z."""
    frame = Frame(0.5, torch.eye(3), torch.tensor([1.0, -2.0, 0.5]))
    trained = set_up(tmp_path, Ball(), frame=frame)
    pose = trained.scene.splits["train"].camera_to_world
    pose[0, :3, 3] = frame.centre + torch.tensor([6.0, 0.0, 0.0])
    path = page_of(trained, times="5", resolution=40)
    webdriver: Any = importlib.import_module("selenium.webdriver")
    with browser() as page:
        page.get(path.as_uri())
        until(lambda: not page.find_elements("id", "message"))
        time = page.find_element("id", "time")
        until(lambda: time.get_attribute("value") not in ("0", "1"))  # It plays.
        page.find_element("id", "play").click()

        time.send_keys("\ue011")  # Home
        first = ball_on(page)
        assert page.find_element("id", "label").text == "time 0.00"
        time.send_keys("\ue010")  # End
        last = ball_on(page)
        assert page.find_element("id", "label").text == "time 1.00"
        assert abs(last[0] - first[0]) < 5
        # The camera sees 40 degrees of height, from where the radius just fits.
        content, canvas = content_of(path), page.find_element("css selector", "canvas")
        pixels = canvas.size["height"] / 2 * np.cos(np.radians(20)) / content["radius"]
        moved = float((Ball.centre(1) - Ball.centre(0)).norm()) / frame.scale
        assert last[1] - first[1] == pytest.approx(moved * pixels, rel=0.1)
        for _, _, difference in (first, last):
            assert difference[2] > 20
            assert np.abs(difference[:2]).max() < 15

        # Dragged by half a turn, what was on the right is on the left.
        turn = canvas.size["height"] // 2
        actions = webdriver.ActionChains(page).move_to_element_with_offset(canvas, -turn // 2, -50)
        actions.click_and_hold().move_by_offset(turn, 0).release().perform()
        middle = canvas.size["width"] / 2
        assert ball_on(page)[1] - middle == pytest.approx(middle - last[1], abs=20)
        assert page.get_log("browser") == []
