"""From a triplane sequence to planes, parts and reports."""

import logging
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path

import pytest
import torch

from tests.preparation.sequences import blob, moving_sequence, still_features
from tests.refusals import assert_refused
from tests.synthetic import ball_scene
from tests.training.runs import small_config
from xplanes import decomposition
from xplanes.checks import _CHOICES as CHOICES
from xplanes.checks import parse
from xplanes.config import ConfigError
from xplanes.decomposition import TIME_ROWS, unexplained_energy
from xplanes.decomposition.conversion import DYNAMIC, STATIC
from xplanes.decomposition.rpca import METHODS, SCALES
from xplanes.fields import Decoder
from xplanes.preparation import Start, TriplaneSequence, find_source, prepare, save_triplanes
from xplanes.preparation import stages as stages_module
from xplanes.preparation.start import STAGES
from xplanes.scenes.frame import Frame, cube_frame
from xplanes.training.builder import build_module
from xplanes.training.module import RadianceModule

FRAME = cube_frame(1.5, torch.zeros(3))
OPTIONS = {
    "width": 12,
    "hidden": 1,
    "activation": "silu",
    "density": "exp",
    "density_scale": 2.0,
    "colour_margin": 0.0,
}


def settings(folder: Path, *overrides: str):
    return parse(small_config(folder, "lrm=file", f"preparation.cache={folder}/cache", *overrides))


def start(
    folder: Path, sequence: TriplaneSequence, *overrides: str, moving: bool = True
) -> tuple[Start, list]:
    """A start from a file, and the field that it builds."""
    path = folder / "triplanes.pt"
    save_triplanes(path, sequence)
    config = settings(folder, f"lrm.triplanes={path}", *overrides)
    scene = ball_scene(moving=moving)
    begun = prepare(config, scene, FRAME, find_source(config.lrm))
    module = build_module(
        replace(config, model=begun.model),
        scene,
        begun.frame,
        planes=begun.planes,
        decoder_state=begun.decoder,
        sparse=begun.sparse,
    )
    return begun, module


SEQUENCE = TriplaneSequence(moving_sequence())


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> tuple[Path, Start, RadianceModule]:
    """A start whose stages are kept: its folder, itself, and the field that it built."""
    folder = tmp_path_factory.mktemp("start")
    return folder, *start(folder, SEQUENCE)


def test_no_source_is_a_random_start_that_touches_nothing(tmp_path: Path):
    config = parse(small_config(tmp_path, f"preparation.cache={tmp_path}/cache"))
    begun = prepare(config, ball_scene(), FRAME, find_source(config.lrm))
    assert begun == Start(config.model, FRAME)
    assert (begun.planes, begun.sparse, begun.report) == (None, None, {})
    assert begun.seconds == dict.fromkeys(STAGES, 0.0)
    assert not (tmp_path / "cache").exists()
    module = build_module(config, ball_scene(), FRAME)
    assert (module.method.product, module.origin) == (None, None)


def test_a_rank_one_start_explains_what_moves(finished):
    folder, *_ = finished
    for model, (resolution, rows) in product(
        ("six_planes", "nine_planes"), ((16, 8), (24, 8), (9, 5))
    ):
        case = f"{model} of {resolution} texels, {rows} rows"
        begun, module = start(
            folder,
            SEQUENCE,
            f"model={model}",
            f"model.resolution={resolution}",
            f"model.time_resolution={rows}",
        )
        field = module.field
        count = len(TIME_ROWS[field.plane_set][-1]) * 3 if model == "nine_planes" else 3
        assert field.space.shape == (3, resolution, resolution, 8), case
        assert field.time.shape == (count, rows, resolution, 8), case
        unexplained = begun.report["unexplained"]
        assert unexplained["before"] == pytest.approx(1, abs=0.05), case
        # With fewer texels and rows than the blob needs, less of it can be held.
        assert unexplained["after"] < (0.3 if resolution >= 16 else 0.8), case
        again = unexplained_energy(field.time, begun.sparse, rows=field.rows)
        assert again == pytest.approx(unexplained["after"], rel=1e-5), case


def test_left_open_rows_of_time_frame_and_decoder_are_those_of_a_random_start(
    finished, tmp_path: Path
):
    _, begun, module = finished
    random = build_module(parse(small_config(tmp_path)), ball_scene(), FRAME)
    assert module.field.time.shape[1] == random.field.time.shape[1] == 3
    assert begun.frame is FRAME
    assert begun.decoder is None
    assert len(module.field.decoder.layers) == 4


def test_the_field_shows_what_stands_still_where_nothing_moves(tmp_path: Path):
    # With few frames the automatic weight takes peaks of what stands still for motion.
    sequence = TriplaneSequence(moving_sequence(frames=40))
    begun, module = start(tmp_path, sequence, "model.resolution=16")
    truth, moved = still_features(), blob().abs().amax(dim=0)
    for index, name in enumerate(("xy", "xz", "yz")):
        untouched = moved[index] < 1e-3
        assert untouched.float().mean() > 0.1
        error = (begun.planes[name] - truth[index])[untouched]
        assert error.norm() < 0.01 * truth[index][untouched].norm()
        assert torch.equal(module.field.planes[name], begun.planes[name])


def test_reports_and_seconds_are_whole(finished):
    _, begun, _ = finished
    assert set(begun.report) == {"xy", "xz", "yz", "unexplained"}
    for name in ("xy", "xz", "yz"):
        report = begun.report[name]
        assert set(report) == set(stages_module.REPORTED)
        assert report["converged"]
        assert 1 <= report["rank"] <= 8
        assert 0 < report["sparsity"] < 1
        assert report["residual"] <= 0.003
    assert set(begun.seconds) == set(STAGES)
    assert begun.seconds["fixed_view"] == 0
    assert all(begun.seconds[name] > 0 for name in STAGES[1:])
    assert begun.pictures["decomposition"].shape == (3 * 132, 8 * 132, 3)
    assert begun.pictures["decomposition"].min() >= 0
    assert begun.pictures["decomposition"].max() <= 1


def test_a_second_start_comes_from_the_cache(finished, monkeypatch):
    folder, first, _ = finished

    def refuse(*_args, **_options):
        raise AssertionError("computed again")

    monkeypatch.setattr(stages_module, "decompose", refuse)
    monkeypatch.setattr(stages_module, "time_planes", refuse)
    again, _ = start(folder, SEQUENCE)
    assert again.report == first.report
    for stage in ("decomposition", "convert"):
        assert again.seconds[stage] == first.seconds[stage]
    assert torch.equal(again.sparse, first.sparse)
    assert all(torch.equal(again.planes[name], plane) for name, plane in first.planes.items())
    assert "cached" in again.words
    with pytest.raises(AssertionError, match="computed again"):
        start(folder, SEQUENCE, "decomposition.tolerance=0.001")


def test_the_cache_can_be_switched_off(tmp_path: Path, monkeypatch):
    calls = []
    original = stages_module.decompose
    monkeypatch.setattr(
        stages_module, "decompose", lambda *a, **o: calls.append(1) or original(*a, **o)
    )
    for count, override in enumerate(("preparation.cache=null", "decomposition.cache=false"), 1):
        for _ in range(2):
            start(tmp_path, SEQUENCE, override)
        assert not list(tmp_path.glob("cache/decomposition-*")), override
        assert len(calls) == 2 * count, override


def test_channels_decoder_and_frame_of_the_file_prevail(tmp_path: Path):
    decoder = Decoder(4, **OPTIONS)
    frame = Frame(0.5, torch.eye(3), torch.tensor([0.1, 0.2, 0.3]))
    sequence = TriplaneSequence(
        moving_sequence(channels=4), decoder.state_dict(), dict(OPTIONS), frame
    )
    begun, module = start(tmp_path, sequence, "trainer.precision=32")
    assert begun.model.channels == 4
    assert "4 channels (not model.channels=8)" in begun.words
    assert begun.frame.scale == 0.5
    points, times = torch.rand(20, 3) * 2 - 1, torch.rand(20)
    features = module.field.features(points, times)
    for ours, theirs in zip(module.field.decoder(features), decoder(features), strict=True):
        assert torch.equal(ours, theirs)


def test_options_that_no_decoder_has_are_refused(tmp_path: Path):
    options = OPTIONS | {"activation": "sine"}
    decoder = Decoder(8, **OPTIONS).state_dict()
    with pytest.raises(ConfigError, match=r"triplanes\.pt does not fit.*activation=sine"):
        start(tmp_path, TriplaneSequence(SEQUENCE.triplanes, decoder, options))


def test_a_scene_of_one_moment_takes_the_low_rank_part_alone(tmp_path: Path):
    begun, module = start(tmp_path, SEQUENCE, moving=False)
    assert set(begun.planes) == {"xy", "xz", "yz"}
    assert module.field.time is None
    assert (begun.sparse, module.method.product) == (None, None)
    assert "no planes of time" in begun.words
    assert set(begun.report) == {"xy", "xz", "yz"}


def test_one_triplane_is_the_space_planes(tmp_path: Path, caplog):
    sequence = TriplaneSequence(moving_sequence(frames=1))
    for moving in (True, False):
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            begun, module = start(tmp_path, sequence, "model.resolution=16", moving=moving)
        assert ("trains as a still one" in caplog.text) == moving
        assert module.field.time is None
        assert (begun.report, begun.pictures, begun.sparse) == ({}, {}, None)
        for index, name in enumerate(("xy", "xz", "yz")):
            assert torch.equal(begun.planes[name], sequence.triplanes[0, index]), name


def test_a_sequence_that_stands_still_starts_with_noise_in_time(tmp_path: Path):
    still = still_features().expand(40, -1, -1, -1, -1).contiguous()
    begun, module = start(tmp_path, TriplaneSequence(still), "model.resolution=16")
    assert float(module.field.time.detach().std()) == pytest.approx(0.01, rel=0.1)
    assert begun.planes["xy"].sub(still[0, 0]).norm() < 0.1 * still[0, 0].norm()


def test_every_floating_type_gives_single_precision_planes(tmp_path: Path):
    for kind in (torch.float16, torch.bfloat16, torch.float64):
        begun, module = start(tmp_path, TriplaneSequence(SEQUENCE.triplanes.to(kind)))
        assert module.field.space.dtype == torch.float32, kind
        assert begun.report["xy"]["converged"], kind


def test_seeds_change_the_noise_alone(finished):
    folder, first, _ = finished
    other, _ = start(folder, SEQUENCE, "seed=1")
    assert torch.equal(first.planes["xy"], other.planes["xy"])
    gap = (first.planes["xt"] - other.planes["xt"]).std()
    assert float(gap) == pytest.approx(0.01 * 2**0.5, rel=0.1)


def test_an_open_decomposition_is_said_once_also_from_the_cache(tmp_path: Path, caplog, recwarn):
    for _ in range(2):
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            start(tmp_path, SEQUENCE, "decomposition.max_iterations=3")
        said = [r.getMessage() for r in caplog.records if "converge" in r.getMessage()]
        assert len(said) == 1
        assert "xy (residual" in said[0]
        assert "decomposition.max_iterations=3" in said[0]
    assert not [w for w in recwarn if "robust PCA" in str(w.message)]


def test_no_weight_needs_no_sparse_part(finished):
    folder, *_ = finished
    begun, module = start(folder, SEQUENCE, "loss.sparse_weight=0")
    assert (begun.sparse, module.method.product) == (None, None)
    assert module.field.time is not None


def test_the_papers_choices_run(tmp_path: Path):
    begun, _ = start(tmp_path, SEQUENCE, "decomposition=paper", "decomposition.max_iterations=50")
    assert begun.report["unexplained"]["before"] == begun.report["unexplained"]["after"]


def test_a_source_that_is_not_there_is_refused_first(tmp_path: Path):
    for overrides, words in (
        ((), "lrm=file needs lrm.triplanes=FILE"),
        (("lrm.triplanes=nowhere.pt",), "lrm.triplanes=nowhere.pt: there is no such file"),
    ):
        lrm = settings(tmp_path, *overrides).lrm
        assert_refused(ConfigError, words, partial(find_source, lrm), overrides)


def test_settings_of_the_decomposition_are_checked(tmp_path: Path):
    for override, words in (
        ("decomposition.sparsity_weight=often", "sparsity_weight=often: must be auto or a number"),
        ("decomposition.sparsity_weight=0", "sparsity_weight=0: must be auto or a number"),
        ("decomposition.sparsity_weight=-0.1", "sparsity_weight=-0.1: must be auto or a number"),
        ("decomposition={dynamic: random, noise: 0}", "products of two zeros have no gradient"),
    ):
        assert_refused(ConfigError, words, partial(settings, tmp_path, override), override)
    for weight in ("auto", "0.009", "1"):
        config = settings(tmp_path, f"decomposition.sparsity_weight={weight}")
        assert str(config.decomposition.sparsity_weight) == weight


def test_choices_are_those_of_the_decomposition():
    assert set(CHOICES["decomposition.method"]) == set(METHODS)
    assert set(CHOICES["decomposition.scale"]) == set(SCALES)
    assert set(CHOICES["decomposition.static"]) == set(STATIC)
    assert set(CHOICES["decomposition.dynamic"]) == set(DYNAMIC)
    assert decomposition.ORIENTATIONS == ("xy", "xz", "yz")


def test_processes_do_not_share_a_start_through_a_folder_that_takes_no_files(
    tmp_path: Path,
) -> None:
    (tmp_path / "file").write_text("")
    overrides = ["trainer=ddp", f"preparation.cache={tmp_path / 'file' / 'cache'}"]
    with pytest.raises(ConfigError, match=r"cannot be written, and the 2 processes share"):
        start(tmp_path, SEQUENCE, *overrides)
