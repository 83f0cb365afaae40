"""A field that shows nothing is noticed, said and started again; opacity is supervised."""

import math
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch

from tests.balls import ball_scene
from tests.training.runs import UNSCORED, also, metrics, outcome
from xplanes.errors import ConfigError
from xplanes.files import read_rows
from xplanes.models.base import background_opacity, opacity_error, opacity_shortfall
from xplanes.rendering.base import Rendering
from xplanes.training import collapse
from xplanes.training.checkpoints import AtomicCheckpointIO
from xplanes.training.collapse import CollapseWatch, verdict
from xplanes.training.meters import mean_opacities
from xplanes.training.module import RadianceModule
from xplanes.training.scores import blank_psnr, floaters, psnr_foreground

FOGGY = {"foreground": 0.9, "background": 0.8}
QUICK = (
    *("trainer.max_steps=12", *UNSCORED, "callbacks.checkpoints.every=7"),
    "trainer.deterministic=true",
)


def rendered(opacity: torch.Tensor, colour: torch.Tensor) -> Rendering:
    empty = torch.zeros(0)
    return Rendering(colour, opacity, empty, empty, samples=None)  # type: ignore[arg-type]


def test_opacity_is_compared_with_alpha_or_with_what_a_colour_takes():
    opacity = torch.tensor([0.2, 0.9, 0.5], dtype=torch.float64, requires_grad=True)
    rays = {
        "alpha": torch.tensor([0.0, 1.0, 1.0], dtype=torch.float64),
        "target": torch.tensor([[1.0, 1, 1], [1, 0.3, 1], [0.25, 0.5, 1]], dtype=torch.float64),
        "background": torch.ones(3, 3, dtype=torch.float64),
    }
    rendering = rendered(opacity, rays["target"])
    known = opacity_error(rendering, rays)
    assert known.item() == pytest.approx((0.04 + 0.01 + 0.25) / 3)
    least = opacity_shortfall(rendering, rays)
    # White takes none; 0.7 is passed; a red of 0.25 takes 0.75 of black at least.
    assert least.item() == pytest.approx(0.25**2 / 3)
    assert torch.autograd.grad(least, opacity)[0].tolist() == pytest.approx([0, 0, -0.5 / 3])
    air = background_opacity(rendering, rays)
    assert air.item() == pytest.approx(0.2 / 3)
    assert torch.autograd.grad(air, opacity)[0].tolist() == pytest.approx([1 / 3, 0, 0])
    # Before a grey background a colour may lie on either side.
    grey = rays | {"background": torch.full((3, 3), 0.5, dtype=torch.float64)}
    assert opacity_shortfall(rendering, grey).item() == pytest.approx((0.64 + 0.01 + 0.25) / 3)


def test_opacities_of_foreground_and_background():
    rays = {
        "alpha": torch.tensor([0.0, 0.0, 1.0, 1.0, 0.4]),
        "target": torch.tensor([[1.0], [1], [0.2], [0.9], [0.2]]).expand(5, 3),
        "background": torch.ones(5, 3),
    }
    found = mean_opacities(rendered(torch.tensor([0.1, 0.3, 0.7, 0.0, 0.0]), rays["target"]), rays)
    assert found == pytest.approx({"foreground": 0.7, "background": 0.2})
    opaque = rays | {"alpha": torch.ones(5), "target": torch.ones(5, 3)}
    found = mean_opacities(rendered(torch.zeros(5), opaque["target"]), opaque)
    assert all(math.isnan(value) for value in found.values())


def test_a_verdict_needs_rays_that_tell():
    nothing, sound, unknown = (0.01, 0.01), (0.9, 0.02), (math.nan, math.nan)
    assert "is empty where" in verdict([nothing] * 9 + [unknown], fog=False)
    assert verdict([sound] * 9 + [nothing], fog=True) == ""
    assert verdict([unknown] * 9, fog=True) == ""
    assert "fog" in verdict([(0.9, 0.8)], fog=True)
    assert verdict([(0.9, 0.8)], fog=False) == ""
    with pytest.raises(ConfigError, match=r"restarts=-1"):
        CollapseWatch(restarts=-1)


def test_fog_has_time_to_clear_by_itself(monkeypatch):
    monkeypatch.setattr(collapse, "WINDOW", 1)
    watch, module = CollapseWatch(restarts=0), Mock(spec=RadianceModule)
    module.tally, module.between_updates = SimpleNamespace(last=FOGGY), True
    module.restarts = 0
    for step, foggy in ((collapse.FIRST_FOG, False), (collapse.FIRST_FOG + 1, True)):
        trainer = SimpleNamespace(global_step=step, world_size=1)
        watch.on_train_batch_end(trainer, module, None, None, 0)
        assert ("fog" in watch.collapsed) == foggy, step


@pytest.fixture
def dead(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every field is taken for a dead one, and after few steps."""
    monkeypatch.setattr(collapse, "WINDOW", 5)
    monkeypatch.setattr(collapse, "NOTHING", 2.0)


def test_a_dead_field_starts_again_once_and_a_resumed_run_comes_to_the_same_numbers(
    train, monkeypatch, dead, caplog
):
    fields = []
    restart = RadianceModule.restart

    def noted(self: RadianceModule) -> None:
        before = self.field
        restart(self)
        assert self.field is not before
        held = {p for group in self.optimizers().param_groups for p in group["params"]}  # type: ignore[union-attr]
        assert held == set(self.field.parameters())
        fields.append(self)

    monkeypatch.setattr(RadianceModule, "restart", noted)
    whole = outcome(train(*QUICK, name="whole"))
    assert len(fields) == whole["restarts"] == 1
    assert fields[0].model.opacity == 1.0
    words = [r.getMessage() for r in caplog.records if "field is empty" in r.getMessage()]
    assert ["re-initialised" in line for line in words] == [True, False]
    assert "at step 5" in words[0]
    assert "data.half_side" in words[1]

    def cut_off(_, __, path: str, **___) -> None:
        if Path(path).name == "last.ckpt":
            raise OSError("cut off")

    with monkeypatch.context() as patch:
        also(patch, AtomicCheckpointIO, "save_checkpoint", cut_off)
        with pytest.raises(OSError, match="cut off"):
            train(*QUICK)
    assert outcome(train(*QUICK, resume=True)) == whole


def test_floaters_are_background_pixels_that_show_something():
    alpha = torch.tensor([[0, 0, 0, 255], [0, 0, 128, 255]], dtype=torch.uint8)
    opacity = torch.tensor([[0.0, 0.06, 0.04, 1], [1, 0, 1, 1]])
    assert floaters(opacity, alpha) == pytest.approx(2 / 5)
    assert math.isnan(floaters(opacity, torch.full_like(alpha, 255)))


def test_the_thing_is_scored_where_most_of_a_pixel_shows_it():
    truth, colour = torch.zeros(2, 2, 3), torch.zeros(2, 2, 3)
    colour[0], colour[1] = 0.1, 1.0
    mask = torch.tensor([[255, 128], [127, 0]], dtype=torch.uint8)
    assert psnr_foreground(colour, truth, mask) == pytest.approx(20.0)
    assert math.isnan(psnr_foreground(colour, truth, None))
    assert math.isnan(psnr_foreground(colour, truth, torch.zeros_like(mask)))


def test_a_run_that_shows_nothing_says_so(train, capsys):
    """The decoder's density bias leaves the field empty, and there is no step to change it."""
    folder = train("trainer.max_steps=1", "model.decoder.density_bias=-60", "data.seed=0")
    assert "this run has learnt nothing yet" in capsys.readouterr().out
    content = metrics(folder)
    assert content["test"]["psnr"] == pytest.approx(content["blank_psnr"], abs=0.01)
    assert content["test"]["floaters"] == 0
    assert len(read_rows(folder / "curve.csv")) == 2


def test_blank_images_are_the_background():
    views, black = ball_scene().splits["test"], torch.zeros(3)
    errors = [
        float(views.composite(index, black).double().square().mean()) for index in range(len(views))
    ]
    expected = sum(-10 * math.log10(error) for error in errors) / len(errors)
    assert blank_psnr(views, black) == pytest.approx(expected)
