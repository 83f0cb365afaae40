"""Runs initialised from a triplane file: outputs, resuming, loading."""

from pathlib import Path

import pytest
import torch
from PIL import Image

from tests.preparation.sequences import OPTIONS, moving_sequence
from tests.training.runs import broken_off, checkpoint, metrics, same_state, small_config
from xplanes.decomposition import decompose, unexplained_energy
from xplanes.decomposition.conversion import frame_profiles
from xplanes.errors import ConfigError
from xplanes.experiment import Experiment
from xplanes.fields import Decoder, XPlanes
from xplanes.fields.xplanes import PLANE_SETS
from xplanes.files import read_rows
from xplanes.models.x_planes import XPlanesModel
from xplanes.preparation import TriplaneSequence, save_triplanes
from xplanes.preparation import stages as stages_module
from xplanes.run import run
from xplanes.scenes.frame import Frame
from xplanes.streams import TrainingState
from xplanes.tools.evaluate import evaluate
from xplanes.tools.runs import load_run
from xplanes.training.module import RadianceModule


@pytest.fixture(scope="module")
def place(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with scenes, a cache and triplanes.pt."""
    folder = made(tmp_path_factory.mktemp("place"), scenes)
    save_triplanes(folder / "triplanes.pt", TriplaneSequence(moving_sequence()))
    return folder


@pytest.fixture
def empty_place(scenes: Path, tmp_path: Path) -> Path:
    """A folder with scenes alone."""
    return made(tmp_path / "place", scenes)


def made(folder: Path, scenes: Path) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "scenes").symlink_to(scenes)
    return folder


def settings(place: Path, *overrides: str) -> dict:
    return small_config(
        place / "scenes",
        "lrm=file",
        f"lrm.triplanes={place}/triplanes.pt",
        f"preparation.cache={place}/cache",
        "model.loss.sparse_weight=0.5",
        "trainer.log_every_n_steps=10",
        *overrides,
    )


UNSCORED = "callbacks.evaluation.at=[]"
"""Training alone is looked at."""


def weights(folder: Path) -> dict[str, torch.Tensor]:
    state = checkpoint(folder)
    return state["state_dict"]


@pytest.fixture(scope="module")
def trained(place: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "whole"
    run(settings(place), folder, [], resume=False)
    return folder


def test_the_run_reports_its_initialisation(trained, place):
    content = metrics(trained)
    assert set(content["decomposition"]) == {"xy", "xz", "yz", "unexplained"}
    wanted = "rank iterations residual converged sparsity drift low_rank_energy sparse_energy"
    for name in ("xy", "xz", "yz"):
        assert set(content["decomposition"][name]) >= set(wanted.split())
    unexplained = content["decomposition"]["unexplained"]
    assert unexplained["after"] < 0.3 < 0.9 < unexplained["before"]
    prepare = content["seconds"]["prepare"]
    assert set(prepare) == {"fixed_view", "lrm", "decomposition", "convert", "fill"}
    assert prepare["decomposition"] > 0
    assert prepare["convert"] > 0
    ranks = [content["decomposition"][name]["rank"] for name in ("xy", "xz", "yz")]
    assert content["skipped"]["directions"] == pytest.approx(1 - sum(ranks) / (3 * 8))
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


def test_the_sparse_part_is_in_no_checkpoint(trained, place):
    state = checkpoint(trained)
    elements = 8 * 3 * 8 * 16 * 16
    assert all(value.numel() != elements for value in state["state_dict"].values())
    assert not [key for key in state["state_dict"] if "sparse" in key or "product" in key]
    held = {
        "model",
        "frame",
        "times",
        "bounds",
        "initialised",
        "pixels",
        "surrounded",
        "cameras",
        "exposed",
    }
    assert set(state["site"]) == held
    assert state["site"]["initialised"]


def test_a_resumed_run_equals_an_uninterrupted_one(trained, place, tmp_path, monkeypatch):
    config, whole, folder = settings(place), trained, tmp_path / "broken"
    broken_off((13,), config, folder)

    def refuse(*_args, **_options):
        raise AssertionError("decomposed again")

    # The parts come from the cache.
    monkeypatch.setattr(stages_module, "decompose", refuse)
    run(config, folder, [], resume=True)
    same_state(weights(folder), weights(whole))
    for key in ("test", "views", "step", "skipped", "samples_per_ray", "decomposition"):
        assert metrics(folder)[key] == metrics(whole)[key]


def test_planes_are_not_resumed_in_another_frame(empty_place, tmp_path):
    def save(scale: float) -> None:
        frame = Frame(scale, torch.eye(3), torch.zeros(3))
        sequence = TriplaneSequence(moving_sequence(), frame=frame)
        save_triplanes(empty_place / "triplanes.pt", sequence)

    def config(steps: int) -> dict:
        return settings(empty_place, UNSCORED, f"trainer.max_steps={steps}")

    save(0.5)
    run(config(2), tmp_path / "run", [], resume=False)
    before = (tmp_path / "run" / "checkpoints" / "last.ckpt").read_bytes()
    save(0.6)
    with pytest.raises(ConfigError, match=r"frame is not the checkpoint's \(scale .*0\.5.*0\.6"):
        run(config(4), tmp_path / "run", [], resume=True)
    assert (tmp_path / "run" / "checkpoints" / "last.ckpt").read_bytes() == before


def built(config: dict) -> XPlanesModel:
    """The model of a configuration at its initialisation."""
    module = RadianceModule(config)
    module.build(Experiment.read(config).data.read())
    assert isinstance(module.model, XPlanesModel)
    return module.model


def planes_of(model: XPlanesModel) -> tuple[torch.nn.Parameter, torch.nn.Parameter]:
    assert model.field.time is not None
    return model.field.space, model.field.time


def test_regularisers_towards_the_initialisation_fade(place):
    """Without other terms, a gradient is what it would be without fading times what is left."""
    quiet = [
        "model.loss.total_variation=0",
        "model.loss.time_variation=0",
        "model.loss.time_smoothness=0",
        "model.loss.time_magnitude=0",
    ]

    def moved(fading: str) -> XPlanesModel:
        steps = f"model.loss.initial_steps={fading}"
        model = built(settings(place, *quiet, steps, "data.views=3"))
        with torch.no_grad():
            for plane in planes_of(model):
                plane.add_(1.0)
        return model

    def gradients(model: XPlanesModel, step: int) -> list[torch.Tensor]:
        for plane in planes_of(model):
            plane.grad = torch.zeros_like(plane)
        model.regularise(TrainingState(seed=step, step=step, batch=step, rank=0))
        return [plane.grad for plane in planes_of(model) if plane.grad is not None]

    whole, fading = gradients(moved("null"), 24), moved("288")
    assert all(float(gradient.abs().max()) > 0 for gradient in whole)
    for gradient, all_of_it in zip(gradients(fading, 24), whole, strict=True):
        torch.testing.assert_close(gradient, 0.75 * all_of_it)
    assert not any(gradient.any() for step in (96, 104) for gradient in gradients(fading, step))


def test_a_field_that_starts_again_keeps_l_r_while_it_is_of_use(place):
    module = RadianceModule(config := settings(place, "model.loss.initial_steps=288"))
    module.build(Experiment.read(config).data.read())
    sparse = module.model.sparse
    again = module.parts.stronger()
    assert sparse is not None
    assert again.model.sparse is sparse
    again.model.product = None  # As after fading out.
    assert again.stronger().model.sparse is None


def test_total_variation_has_a_weight_for_the_planes_of_space_and_one_for_those_of_time(place):
    """Values and gradients, against the formula in float64."""
    weights = {"total_variation": 0.3, "time_variation": 0.7}
    off = [f"model.loss.time_{name}=0" for name in ("smoothness", "magnitude", "identity")]
    off += ["model.loss.initial_weight=0", "model.loss.sparse_weight=0", "model.loss.every=1"]
    weigh = [f"model.loss.{name}={weight}" for name, weight in weights.items()]
    model = built(settings(place, *off, *weigh))
    state = TrainingState(seed=0, step=1, batch=1, rank=0)
    with torch.no_grad():
        for plane in planes_of(model):
            plane.add_(torch.randn(plane.shape, generator=torch.Generator().manual_seed(5)))
    space, time = (p.detach().double().requires_grad_() for p in planes_of(model))
    columns, rows = space[:, :, 1:] - space[:, :, :-1], space[:, 1:] - space[:, :-1]
    along = time[:, :, 1:] - time[:, :, :-1]
    expected = {
        "total_variation": 0.3 * (columns.square().mean() + rows.square().mean()),
        "time_variation": 0.7 * along.square().mean(),
    }
    values = {name: value.item() for name, value in expected.items()}
    assert model.regularisers(state) == pytest.approx(values, rel=1e-5)

    torch.stack(list(expected.values())).sum().backward()
    for plane in planes_of(model):
        plane.grad = torch.zeros_like(plane)
    model.regularise(state)
    for plane, exact in zip(planes_of(model), (space, time), strict=True):
        assert plane.grad is not None
        assert exact.grad is not None
        torch.testing.assert_close(plane.grad.double(), exact.grad, rtol=1e-4, atol=1e-9)


def test_the_regulariser_scales_with_the_inverse_square_of_the_views(place):
    def hold(lrm: str, views: int) -> float:
        overrides = [f"data.views={views}", "model.loss.initial_weight=8"]
        return built(settings(place, *overrides) | ({} if lrm == "file" else none)).initial_weight

    none = {"lrm": small_config(place / "scenes", "lrm=none")["lrm"]}
    assert [hold("file", 2), hold("file", 4)] == [2.0, 0.5]
    assert hold("none", 2) == 0.0


@pytest.mark.slow
def test_l_r_moves_random_planes_towards_the_sparse_part(place, tmp_path):
    """Colours are taken out of the loss as far as they go, so that L_r alone is seen."""
    left = {}
    sparse = decompose(moving_sequence(), sparsity_weight="auto").sparse
    for weight in (0, 100):
        folder = tmp_path / f"{weight}"
        overrides = (
            "model=nine_planes",
            "decomposition.dynamic=random",
            "decomposition.noise=0.1",
            f"model.loss.sparse_weight={weight}",
            "model.loss.every=1",
            "model.loss.initial_weight=0",
            "model.time_lr=0.1",
            "trainer.max_steps=40",
            UNSCORED,
            "model.warmup_steps=1",
        )
        run(settings(place, *overrides), folder, [], resume=False)
        left[weight] = unexplained_energy(
            weights(folder)["field.time"], sparse, rows=PLANE_SETS["nine"]
        )
    initial = metrics(tmp_path / "100")["decomposition"]["unexplained"]["after"]
    assert initial == pytest.approx(1, abs=0.1)
    assert left[100] < 0.5 * initial
    assert left[100] < 0.5 * left[0]


def test_a_run_is_loaded_without_its_source(empty_place):
    """Planes, decoder, frame and channels are the file's; the file is gone afterwards."""
    decoder = Decoder(4, **OPTIONS)
    frame = Frame(0.55, torch.tensor([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]), torch.zeros(3))
    sequence = TriplaneSequence(
        moving_sequence(channels=4), decoder.state_dict(), dict(OPTIONS), frame
    )
    save_triplanes(empty_place / "triplanes.pt", sequence)
    folder = empty_place / "run"
    config = settings(empty_place, "model=nine_planes", "trainer.max_steps=12", UNSCORED)
    run(config, folder, [], resume=False)
    (empty_place / "triplanes.pt").unlink()
    for path in (empty_place / "cache").iterdir():
        path.unlink()
    loaded = load_run(folder)
    assert loaded.frame.scale == 0.55
    assert loaded.module.model is not None
    assert loaded.module.model.settings.channels == 4
    assert loaded.module.field.decoder.density_activation == "exp"
    scores = evaluate(loaded, network="none")
    assert scores["test"]["psnr"] == pytest.approx(metrics(folder)["test"]["psnr"], abs=1e-6)
    with pytest.raises(ConfigError, match="there is no such file"):
        run(config, folder, [], resume=True)


def test_a_run_from_one_triplane_is_loaded_too(place, tmp_path):
    sequence = TriplaneSequence(moving_sequence(frames=1))
    save_triplanes(tmp_path / "one.pt", sequence)
    config = settings(place, f"lrm.triplanes={tmp_path}/one.pt", "trainer.max_steps=2", UNSCORED)
    run(config, tmp_path / "run", [], resume=False)
    assert metrics(tmp_path / "run")["decomposition"] == {}
    assert not (tmp_path / "run" / "media" / "decomposition.png").exists()
    assert not load_run(tmp_path / "run").module.field.moves


def test_an_unconverged_decomposition_warns_once(place, tmp_path, capfd):
    config = settings(place, "decomposition.max_iterations=3", "trainer.max_steps=2", UNSCORED)
    run(config, tmp_path / "run", [], resume=False)
    said = capfd.readouterr()
    assert said.err.count("did not converge") == 1
    assert f"from     8 triplanes of {place}/triplanes.pt" in said.out
    assert "time planes rank1" in said.out
    assert not metrics(tmp_path / "run")["decomposition"]["xy"]["converged"]


def test_triplanes_of_a_trained_field_initialise_a_field_with_equal_renders(place, tmp_path):
    """Checks end to end that orientation, time, decoder and frame of a file match the field's."""
    common = ("model=nine_planes", "model.precision=32")
    config = small_config(place / "scenes", *common, "trainer.max_steps=30", UNSCORED)
    run(config, tmp_path / "first", [], resume=False)
    first = load_run(tmp_path / "first")
    field, options = first.module.field, first.experiment.method.model.decoder
    with torch.no_grad():
        sequence = TriplaneSequence(
            triplanes_of(field, frames=20),
            field.decoder.state_dict(),
            {name: getattr(options, name) for name in OPTIONS},
            first.frame,
        )
    save_triplanes(tmp_path / "own.pt", sequence)
    overrides = (
        *common,
        f"lrm.triplanes={tmp_path}/own.pt",
        "data.half_side=9",  # The file's frame prevails.
        "trainer.max_steps=1",
        "callbacks.evaluation.at=[0]",
        "decomposition.tolerance=1e-5",
        "decomposition.noise=0",
    )
    run(settings(place, *overrides), tmp_path / "second", [], resume=False)
    rows = read_rows(tmp_path / "second" / "curve.csv")
    trained, begun = metrics(tmp_path / "first")["test"]["psnr"], float(rows[0]["psnr"])
    assert rows[0]["step"] == "0"
    assert begun > trained - 0.5


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
