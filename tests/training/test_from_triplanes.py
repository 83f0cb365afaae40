"""Runs initialised from a triplane file: outputs, resuming, loading."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from PIL import Image

from tests.preparation.sequences import OPTIONS, moving_sequence
from tests.training.runs import (
    NO_CURVE,
    UNSCORED,
    broken_off,
    checkpoint,
    metrics,
    outcome,
    small_config,
)
from xplanes.decomposition.conversion import frame_profiles
from xplanes.errors import ConfigError
from xplanes.experiment import Experiment
from xplanes.fields import Decoder, XPlanes
from xplanes.fields.regularisers import total_variation
from xplanes.files import read_rows
from xplanes.models.initialisation import STAGES
from xplanes.models.x_planes import XPlanesModel
from xplanes.preparation import TriplaneSequence, save_triplanes
from xplanes.preparation import stages as stages_module
from xplanes.run import run
from xplanes.scenes.frame import Frame
from xplanes.streams import TrainingState
from xplanes.tools.evaluate import evaluate
from xplanes.tools.runs import load_run
from xplanes.training.building import parts_from, site_content
from xplanes.training.module import RadianceModule

AXES = ("xy", "xz", "yz")


def source(folder: Path) -> tuple[str, ...]:
    """Overrides of runs from triplanes.pt in a folder, with a cache beside it."""
    return (
        *("lrm=file", f"lrm.triplanes={folder}/triplanes.pt"),
        *(f"preparation.cache={folder}/cache", "model.loss.sparse_weight=0.5"),
        "trainer.log_every_n_steps=10",
    )


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, ...]:
    """Overrides of runs from triplanes of something that moves."""
    folder = tmp_path_factory.mktemp("given")
    save_triplanes(folder / "triplanes.pt", TriplaneSequence(moving_sequence()))
    return source(folder)


@pytest.fixture
def built(scenes: Path, given: tuple[str, ...]) -> Callable[..., RadianceModule]:
    """Makes a module at its initialisation."""

    def built(*overrides: str) -> RadianceModule:
        start = () if "lrm=none" in overrides else given
        module = RadianceModule(config := small_config(scenes, *start, *overrides))
        module.build(Experiment.read(config).data.read())
        return module

    return built


@pytest.fixture(scope="module")
def trained(scenes: Path, given, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "whole"
    run(small_config(scenes, *given), folder, [], resume=False)
    return folder


def test_the_run_reports_its_initialisation(trained):
    """All that `tests.preparation.test_initialisation` looks at."""
    content = metrics(trained)
    found = content["decomposition"]
    assert set(found) == {*AXES, "unexplained"}
    assert all(set(found[name]) == set(stages_module.REPORTED) for name in AXES)
    assert found["unexplained"]["after"] < 0.3 < 0.9 < found["unexplained"]["before"]
    assert set(content["seconds"]["prepare"]) == set(STAGES)
    ranks = sum(found[name]["rank"] for name in AXES)
    assert content["skipped"]["directions"] == pytest.approx(1 - ranks / (3 * 8))
    assert 0 < content["skipped"]["directions"] < 1
    assert content["skipped"]["frames"] == 0


def test_the_parts_are_logged_as_an_image_and_the_loss_as_a_curve(trained):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    with Image.open(trained / "media" / "decomposition.png") as picture:
        assert picture.size == (8 * 132, 3 * 132)
        assert len(picture.convert("RGB").getcolors(2**20)) > 100
    events = EventAccumulator(str(trained / "tb"))
    events.Reload()
    assert "decomposition" in events.Tags()["images"]
    points = events.Scalars("train/l_r")
    # Of the field that the tenth batch saw, after nine steps.
    assert [point.step for point in points] == [9, 19, 29, 39]
    assert all(point.value > 0 for point in points)


def test_the_sparse_part_is_in_no_checkpoint(trained):
    state = checkpoint(trained)
    elements = 8 * 3 * 8 * 16 * 16
    assert all(value.numel() != elements for value in state["state_dict"].values())
    assert not [key for key in state["state_dict"] if "sparse" in key or "product" in key]
    held = "model frame times bounds positions initialised pixels coherence surrounded cameras"
    assert set(state["site"]) == {*held.split(), "exposed"}
    assert state["site"]["initialised"]


def test_a_resumed_run_equals_an_uninterrupted_one(
    trained, scenes, given, train, tmp_path, monkeypatch
):
    broken_off((13,), small_config(scenes, *given), tmp_path / "run")
    again = lambda *_, **__: pytest.fail("the parts come from the cache")  # noqa: E731
    monkeypatch.setattr(stages_module, "decompose", again)
    folder = train(*given, resume=True)
    assert outcome(folder) == outcome(trained)
    assert metrics(folder)["decomposition"] == metrics(trained)["decomposition"]


def test_an_unconverged_decomposition_warns_once_and_goes_on_in_its_own_frame_alone(
    train, tmp_path, capfd
):
    def trained(scale: float, steps: int) -> bytes:
        """The last checkpoint of the run, which begins or goes on with a file of this scale."""
        frame = Frame(scale, torch.eye(3), torch.zeros(3))
        sequence = TriplaneSequence(moving_sequence(), frame=frame)
        save_triplanes(tmp_path / "triplanes.pt", sequence)
        few = ("decomposition.max_iterations=3", f"trainer.max_steps={steps}", *UNSCORED)
        folder = train(*source(tmp_path), *few, resume=steps > 2)
        return (folder / "checkpoints" / "last.ckpt").read_bytes()

    before, folder = trained(0.5, 2), tmp_path / "run"
    said = capfd.readouterr()
    assert said.err.count("did not converge") == 1
    assert f"from     8 triplanes of {tmp_path}/triplanes.pt" in said.out
    assert "time planes rank1" in said.out
    assert not metrics(folder)["decomposition"]["xy"]["converged"]
    with pytest.raises(
        ConfigError, match=r"frame differs from the checkpoint's \(scale .*0\.5.*0\.6"
    ):
        trained(0.6, 4)
    assert (folder / "checkpoints" / "last.ckpt").read_bytes() == before


def state_at(step: int) -> TrainingState:
    return TrainingState(seed=step, step=step, batch=step, rank=0)


def planes_of(model: XPlanesModel) -> tuple[torch.nn.Parameter, torch.nn.Parameter]:
    assert model.field.time is not None
    return model.field.space, model.field.time


def gradients(model: XPlanesModel, step: int) -> list[torch.Tensor]:
    """What the regularisers of a step add to the gradients of the planes."""
    for plane in planes_of(model):
        plane.grad = torch.zeros_like(plane)
    model.regularise(state_at(step))
    return [plane.grad for plane in planes_of(model) if plane.grad is not None]


def test_regularisers_towards_the_initialisation_fade(built):
    """Without other terms, a gradient is what it would be without fading times what is left."""
    terms = ("total_variation", "time_variation", "time_smoothness", "time_magnitude")

    def moved(fading: str) -> XPlanesModel:
        quiet = [f"model.loss.{term}=0" for term in terms]
        model = built(*quiet, f"model.loss.initial_steps={fading}", "data.views=3").model
        with torch.no_grad():
            for plane in planes_of(model):
                plane.add_(1.0)
        return model

    whole, fading = gradients(moved("null"), 24), moved("288")
    assert all(float(gradient.abs().max()) > 0 for gradient in whole)
    for gradient, all_of_it in zip(gradients(fading, 24), whole, strict=True):
        torch.testing.assert_close(gradient, 0.75 * all_of_it)
    assert not any(gradient.any() for step in (96, 104) for gradient in gradients(fading, step))


def test_a_field_that_starts_again_keeps_l_r_while_it_is_of_use(built):
    module = built("model.loss.initial_steps=288")
    sparse = module.model.sparse
    again = module.parts.stronger()
    assert sparse is not None
    assert again.model.sparse is sparse
    again.model.product = None  # As after fading out.
    assert again.stronger().model.sparse is None


@pytest.mark.parametrize(
    ("overrides", "weight"),
    [
        (["data.views=2", "lrm=none"], 1.2),
        (["data.views=4", "lrm=none"], 0.6),
        (["data.views=2", "lrm=none", "model.loss.variation_views=50"], 3.0),
        (["lrm=none"], 0.3),
        (["data.views=2", "lrm=none", "model.loss.variation_views=null"], 0.3),
        (["data.views=2"], 0.3),
    ],
)
def test_random_planes_are_smoother_where_few_cameras_look(built, overrides, weight):
    smooth = ["model.loss.total_variation=0.3", "model.fine=null", "model.loss.variation_views=8"]
    module = built(*smooth, *overrides)
    assert module.model.total_variation == pytest.approx(weight)
    loaded = parts_from(site_content(module.parts), module.method, (), None).model
    assert isinstance(loaded, XPlanesModel)
    assert loaded.total_variation == pytest.approx(weight)


def test_total_variation_has_a_weight_for_the_planes_of_space_and_one_for_those_of_time(built):
    weights = {"total_variation": 0.3, "time_variation": 0.7}
    off = [f"time_{name}=0" for name in ("smoothness", "magnitude", "identity")]
    off += ["initial_weight=0", "sparse_weight=0", "every=1"]
    weigh = [f"{name}={weight}" for name, weight in weights.items()]
    model = built(*(f"model.loss.{text}" for text in (*off, *weigh))).model
    with torch.no_grad():
        for plane in planes_of(model):
            plane.add_(torch.randn(plane.shape, generator=torch.Generator().manual_seed(5)))
    space, time = (p.detach().double().requires_grad_() for p in planes_of(model))
    terms = 0.3 * total_variation(space, (1, 2)), 0.7 * total_variation(time, (2,))
    values = dict(zip(weights, (term.item() for term in terms), strict=True))
    assert model.regularisers(state_at(1)) == pytest.approx(values, rel=1e-5)
    exact = torch.autograd.grad(sum(terms), (space, time))
    for found, expected in zip(gradients(model, 1), exact, strict=True):
        torch.testing.assert_close(found.double(), expected, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize(
    ("overrides", "weight"),
    [(["data.views=2"], 2.0), (["data.views=4"], 0.5), (["data.views=2", "lrm=none"], 0.0)],
)
def test_the_regulariser_scales_with_the_inverse_square_of_the_views(built, overrides, weight):
    assert built("model.loss.initial_weight=8", *overrides).model.initial_weight == weight


def test_a_run_is_loaded_without_its_source(train, tmp_path):
    """Planes, decoder, frame and channels are the file's; the file is gone afterwards."""
    decoder = Decoder(4, **OPTIONS)
    frame = Frame(0.55, torch.tensor([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]), torch.zeros(3))
    planes = moving_sequence(channels=4)
    sequence = TriplaneSequence(planes, decoder.state_dict(), dict(OPTIONS), frame)
    save_triplanes(tmp_path / "triplanes.pt", sequence)
    overrides = (*source(tmp_path), "model=nine_planes", "trainer.max_steps=2", *UNSCORED)
    folder = train(*overrides)
    (tmp_path / "triplanes.pt").unlink()
    shutil.rmtree(tmp_path / "cache")
    loaded = load_run(folder)
    assert loaded.frame.scale == 0.55
    assert loaded.module.model is not None
    assert loaded.module.model.settings.channels == 4
    assert loaded.module.field.decoder.density == "exp"
    scores = evaluate(loaded, network="none")
    assert scores["test"]["psnr"] == pytest.approx(metrics(folder)["test"]["psnr"], abs=1e-6)
    with pytest.raises(ConfigError, match="there is no such file"):
        train(*overrides, resume=True)


def test_triplanes_of_a_trained_field_initialise_a_field_with_equal_renders(train, tmp_path):
    """Checks end to end that orientation, time, decoder and frame of a file match the field's."""
    common = ("model=nine_planes", "model.precision=32")
    trained = train(*common, "trainer.max_steps=30", NO_CURVE, name="first")
    first = load_run(trained)
    field, options = first.module.field, first.experiment.method.model.decoder
    with torch.no_grad():
        sequence = TriplaneSequence(
            triplanes_of(field, frames=10),
            field.decoder.state_dict(),
            {name: getattr(options, name) for name in OPTIONS},
            first.frame,
        )
    save_triplanes(tmp_path / "triplanes.pt", sequence)
    second = train(
        *(*source(tmp_path), *common, "trainer.max_steps=1", "callbacks.evaluation.at=[0]"),
        "data.half_side=9",  # The file's frame prevails.
        *("decomposition.tolerance=1e-5", "decomposition.noise=0"),
        name="second",
    )
    row = read_rows(second / "curve.csv")[0]
    assert row["step"] == "0"
    assert float(row["psnr"]) > metrics(trained)["test"]["psnr"] - 0.5


def triplanes_of(field: XPlanes, frames: int) -> torch.Tensor:
    """What the field's features are at each timestep, as triplanes. [T, 3, C, H, H]"""
    size = field.space.shape[1]
    ticks = torch.arange(frames)
    profiles = frame_profiles(field.time, ticks, frames, size)
    timesteps = []
    for frame in range(frames):
        products = [
            torch.einsum("wc,hc->chw", profiles[first, frame], profiles[second, frame])
            for first, second in field.rows
        ]
        timesteps.append(field.space.permute(0, 3, 1, 2) + torch.stack(products))
    return torch.stack(timesteps)
