"""From a triplane sequence to planes, parts and reports."""

import logging
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch

from tests.balls import ball_scene
from tests.preparation.sequences import OPTIONS, blob, moving_sequence, static_features
from tests.refusals import assert_refused, interrupt
from tests.training.runs import NO_CURVE, same_state, small_config
from xplanes import run
from xplanes.decomposition import unexplained_energy
from xplanes.errors import ConfigError
from xplanes.evaluation import render
from xplanes.fields import Decoder
from xplanes.fields.xplanes import PLANE_SETS
from xplanes.models.initialisation import STAGES, Initialisation, Method, Place
from xplanes.preparation import TriplaneSequence, save_triplanes
from xplanes.preparation import stages as stages_module
from xplanes.preparation.cache import StageCache
from xplanes.preparation.sources import from_sequence
from xplanes.scenes.frame import Frame, cube_frame
from xplanes.training.module import RadianceModule

FRAME = cube_frame(1.5, torch.zeros(3))


def settings(folder: Path, *overrides: str) -> Method:
    cache = f"preparation.cache={folder}/cache"
    return Method.read(small_config(folder, "lrm=file", cache, *overrides))


def built(method: Method, *, moving: bool = True, devices: int = 1) -> RadianceModule:
    """A field for a scene whose frame is known."""
    module = RadianceModule(method)
    module.build(ball_scene(moving=moving), FRAME, devices=devices)
    return module


def initialised(
    folder: Path, sequence: TriplaneSequence, *overrides: str, moving: bool = True, devices: int = 1
) -> tuple[Initialisation, RadianceModule]:
    """An initialisation from a file, and the field that it builds."""
    path = folder / "triplanes.pt"
    save_triplanes(path, sequence)
    method = settings(folder, f"lrm.triplanes={path}", *overrides)
    module = built(method, moving=moving, devices=devices)
    return module.initialisation, module


SEQUENCE = TriplaneSequence(moving_sequence())


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> tuple[Path, Initialisation, RadianceModule]:
    """An initialisation whose stages are kept: its folder, itself, and the field that it built."""
    folder = tmp_path_factory.mktemp("initialised")
    return folder, *initialised(folder, SEQUENCE)


def test_no_source_is_a_random_initialisation_that_touches_nothing(tmp_path):
    method = Method.read(small_config(tmp_path, f"preparation.cache={tmp_path}/cache"))
    assert method.lrm.load() is None
    module = built(method)
    found = module.initialisation
    assert found == Initialisation(method.model, FRAME)
    assert (found.values, found.report) == (None, {})
    assert found.seconds == dict.fromkeys(STAGES, 0.0)
    assert not (tmp_path / "cache").exists()
    assert (module.model.product, module.site.initialised) == (None, False)


@pytest.mark.parametrize(
    ("model", "resolution", "rows"),
    [("six_planes", 16, 8), ("nine_planes", 24, 8), ("six_planes", 9, 5), ("nine_planes", 9, 5)],
)
def test_a_rank_one_initialisation_explains_what_moves(finished, model, resolution, rows):
    folder, *_ = finished
    sizes = (f"model.resolution={resolution}", f"model.time_resolution={rows}")
    found, module = initialised(folder, SEQUENCE, f"model={model}", *sizes)
    field = module.field
    count = len(PLANE_SETS[field.plane_set][-1]) * 3 if model == "nine_planes" else 3
    assert field.space.shape == (3, resolution, resolution, 8)
    assert field.time.shape == (count, rows, resolution, 8)
    unexplained = found.report["unexplained"]
    assert unexplained["before"] == pytest.approx(1, abs=0.05)
    # With fewer texels and rows than the blob needs, less of it can be held.
    assert unexplained["after"] < (0.3 if resolution >= 16 else 0.8)
    again = unexplained_energy(field.time, module.model.sparse, rows=field.rows)
    assert again == pytest.approx(unexplained["after"], rel=1e-5)


def test_the_initial_field_shows_the_static_part_where_nothing_moves(tmp_path):
    # With few frames the automatic weight takes peaks of static content for motion.
    sequence = TriplaneSequence(moving_sequence(frames=40))
    found, module = initialised(tmp_path, sequence, "model.resolution=16")
    truth, moved = static_features(), blob().abs().amax(dim=0)
    for index, name in enumerate(("xy", "xz", "yz")):
        untouched = moved[index] < 1e-3
        assert untouched.float().mean() > 0.1
        error = (found.values.planes[name] - truth[index])[untouched]
        assert error.norm() < 0.01 * truth[index][untouched].norm()
        assert torch.equal(module.field.planes[name], found.values.planes[name])


def test_reports_and_seconds_are_whole(finished):
    _, found, module = finished
    assert set(found.report) == {"xy", "xz", "yz", "unexplained"}
    for name in ("xy", "xz", "yz"):
        report = found.report[name]
        assert set(report) == set(stages_module.REPORTED)
        assert report["converged"]
        assert 1 <= report["rank"] <= 8
        assert 0 < report["sparsity"] < 1
        assert report["residual"] <= 0.003
    assert set(found.seconds) == set(STAGES)
    assert found.seconds["fixed_view"] == 0
    assert all(found.seconds[name] > 0 for name in STAGES[1:])
    picture = found.pictures["decomposition"]
    assert picture.shape == (3 * 132, 8 * 132, 3)
    assert 0 <= picture.min() < picture.max() <= 1
    # Seeds change the noise only.
    other, _ = initialised(finished[0], SEQUENCE, "seed=1")
    assert torch.equal(found.values.planes["xy"], other.values.planes["xy"])
    gap = (found.values.planes["xt"] - other.values.planes["xt"]).std()
    assert float(gap) == pytest.approx(0.01 * 2**0.5, rel=0.1)
    # No weight needs no sparse part.
    _, module = initialised(finished[0], SEQUENCE, "model.loss.sparse_weight=0")
    assert (module.model.sparse, module.model.product) == (None, None)
    assert module.field.time is not None


def test_a_second_initialisation_comes_from_the_cache(finished, monkeypatch):
    folder, first, module = finished
    monkeypatch.setattr(stages_module, "decompose", interrupt)
    monkeypatch.setattr(stages_module, "time_planes", interrupt)
    again, other = initialised(folder, SEQUENCE)
    assert again.report == first.report
    for stage in ("decomposition", "convert"):
        assert again.seconds[stage] == first.seconds[stage]
    assert torch.equal(other.model.sparse, module.model.sparse)
    same_state(again.values.planes, first.values.planes)
    assert "cached" in again.description
    with pytest.raises(KeyboardInterrupt):
        initialised(folder, SEQUENCE, "decomposition.tolerance=0.001")
    # A user's own plane set is corrected under its old name.
    monkeypatch.setitem(PLANE_SETS, "six", ((0, 2), (0, 1), (1, 2)))
    with pytest.raises(KeyboardInterrupt):
        initialised(folder, SEQUENCE)


def test_the_cache_can_be_switched_off(tmp_path, monkeypatch):
    calls = []
    original = stages_module.decompose
    monkeypatch.setattr(
        stages_module, "decompose", lambda *a, **o: calls.append(1) or original(*a, **o)
    )
    for count, override in enumerate(("preparation.cache=null", "decomposition.cache=false"), 1):
        for _ in range(2):
            initialised(tmp_path, SEQUENCE, override)
        assert not list(tmp_path.glob("cache/decomposition-*")), override
        assert len(calls) == 2 * count, override


def test_channels_decoder_and_frame_of_the_file_prevail(tmp_path):
    decoder = Decoder(4, **OPTIONS)
    frame = Frame(0.5, torch.eye(3), torch.tensor([0.1, 0.2, 0.3]))
    planes, state = moving_sequence(channels=4), decoder.state_dict()
    sequence = TriplaneSequence(planes, state, dict(OPTIONS), frame)
    found, module = initialised(tmp_path, sequence, "model.precision=32")
    assert found.model.channels == 4
    assert "4 channels (not model.channels=8)" in found.description
    assert found.frame.scale == 0.5
    points, times = torch.rand(20, 3) * 2 - 1, torch.rand(20)
    features = module.field.features(points, times)
    for ours, theirs in zip(module.field.decoder(features), decoder(features), strict=True):
        assert torch.equal(ours, theirs)
    sequence = replace(sequence, decoder_config=OPTIONS | {"activation": "sine"})
    with pytest.raises(ConfigError, match=r"triplanes\.pt: decoder_config\.activation=sine"):
        initialised(tmp_path, sequence)


def test_a_scene_of_one_timestep_uses_the_low_rank_part_only(tmp_path):
    found, module = initialised(tmp_path, SEQUENCE, moving=False)
    assert set(found.values.planes) == {"xy", "xz", "yz"}
    assert module.field.time is None
    assert (module.model.sparse, module.model.product) == (None, None)
    assert "no time planes" in found.description
    assert set(found.report) == {"xy", "xz", "yz"}


def test_one_triplane_is_the_space_planes(tmp_path, caplog):
    sequence = TriplaneSequence(moving_sequence(frames=1))
    for moving in (True, False):
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            found, module = initialised(tmp_path, sequence, "model.resolution=16", moving=moving)
        assert ("is trained as static" in caplog.text) == moving
        assert module.field.time is None
        assert (found.report, found.pictures, module.model.sparse) == ({}, {}, None)
        for index, name in enumerate(("xy", "xz", "yz")):
            assert torch.equal(found.values.planes[name], sequence.triplanes[0, index]), name


def test_a_sequence_of_ones_own_source_is_checked(tmp_path):
    place = Place(scene=ball_scene(), frame=FRAME, device=torch.device("cpu"))
    wrong = TriplaneSequence(torch.full((1, 3, 4, 8, 8), torch.nan))
    with pytest.raises(ConfigError, match="mine: triplane 0 of 1 holds NaN"):
        from_sequence(wrong, settings(tmp_path), place, StageCache(None), source="mine", seconds={})


def test_a_source_that_is_not_there_is_refused_first(tmp_path):
    for overrides, words in (
        ((), "lrm=file needs lrm.triplanes=FILE"),
        (("lrm.triplanes=nowhere.pt",), "lrm.triplanes=nowhere.pt: there is no such file"),
    ):
        lrm = settings(tmp_path, *overrides).lrm
        assert_refused(ConfigError, words, lrm.load, overrides)


def test_processes_share_an_initialisation_through_a_folder_that_takes_files(tmp_path):
    (tmp_path / "file").write_text("")
    for cache, words in (
        (tmp_path / "file" / "cache", r"cannot be written, and the 2 processes share"),
        ("null", r"preparation\.cache=null with lrm=file and trainer\.devices=2"),
    ):
        override = f"preparation.cache={cache}"
        call = partial(initialised, tmp_path, SEQUENCE, override, devices=2)
        assert_refused(ConfigError, words, call, override)
    initialised(tmp_path, SEQUENCE, devices=2)


def test_the_video_of_a_run_shows_the_field_in_its_own_frame(scenes, tmp_path, monkeypatch):
    frame = Frame(0.4, torch.eye(3), torch.tensor([0.1, 0.2, 0.3]))
    save_triplanes(tmp_path / "a.pt", TriplaneSequence(moving_sequence(2), frame=frame))
    shown, original = [], render.render_path

    def note(field, renderer, frame, *others, **options):
        shown.append(frame)
        return original(field, renderer, frame, *others, **options)

    monkeypatch.setattr(render, "render_path", note)
    monkeypatch.setattr(render, "FRAMES", 2)
    source = ("lrm=file", f"lrm.triplanes={tmp_path}/a.pt", "preparation.cache=null", NO_CURVE)
    plain = small_config(scenes, *source, "trainer.max_steps=1", "media=true", "logger=none")
    run.run(plain, tmp_path / "run", [], resume=False)
    (found,) = shown
    assert found.scale == frame.scale
    assert torch.equal(found.centre, frame.centre)
