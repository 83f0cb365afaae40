"""Training at the edges: scenes without content, few rays, views and timesteps, high rates."""

from pathlib import Path

import pytest

from tests.stress.models import MODELS, faster, settings, trained
from tests.stress.scenes import SCENES, write_scene

pytestmark = pytest.mark.stress


@pytest.fixture(scope="session")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("scenes")


@pytest.mark.parametrize("kind", SCENES)
@pytest.mark.parametrize("model", MODELS)
def test_scenes_without_content(tally, root, tmp_path, model, kind):
    """Black, white, transparent and constant scenes, all models"""
    config = settings(model, write_scene(root, kind))
    assert tally.trained(lambda: trained(config, tmp_path / "run")) is not None


@pytest.mark.parametrize("crop", ["true", "false"])
@pytest.mark.parametrize("precision", ["32", "bf16"])
@pytest.mark.parametrize("kind", SCENES)
def test_initialisation_from_scenes_without_content(tally, root, tmp_path, kind, precision, crop):
    """The same scenes initialised from lrm=tiny, decoder in float32 and bfloat16"""
    changed = (
        f"model.precision={precision}",
        f"lrm.crop={crop}",
        "preparation.frames=4",
        "preparation.fixed_view_steps=30",
    )
    config = settings("six_planes", write_scene(root, kind), *changed, lrm="tiny")
    tally.trained(lambda: trained(config, tmp_path / "run"))


@pytest.mark.parametrize("factor", [3, 10])
@pytest.mark.parametrize("model", MODELS)
def test_high_learning_rates(tally, root, tmp_path, model, factor):
    """Learning rates of 3 and 10 times the default, all models"""
    config = settings(model, write_scene(root, "ball"), *faster(model, factor))
    tally.trained(lambda: trained(config, tmp_path / "run"))


@pytest.mark.parametrize("factor", [1e3, 1e30])
@pytest.mark.parametrize("model", ["six_planes", "kplanes", "tineuvox_s"])
def test_absurd_learning_rates(tally, root, tmp_path, model, factor):
    """Learning rates of 1e3 and 1e30 times the default"""
    config = settings(model, write_scene(root, "ball"), *faster(model, factor))
    tally.trained(lambda: trained(config, tmp_path / "run"))


FEW = {
    "one ray": ((6, 6), ("model.rays.per_batch=1",)),
    "one view of many": ((6, 6), ("data.views=1",)),
    "one view": ((1, 1), ()),
    "one timestep": ((6, 1), ()),
}


@pytest.mark.parametrize("what", FEW)
@pytest.mark.parametrize("model", MODELS)
def test_as_little_as_there_can_be(tally, root, tmp_path, model, what):
    """One ray a batch, one view, one timestep, all models"""
    (views, times), overrides = FEW[what]
    config = settings(model, write_scene(root, "ball", views=views, times=times), *overrides)
    assert tally.trained(lambda: trained(config, tmp_path / "run")) is not None


@pytest.mark.parametrize("precision", ["32", "bf16"])
@pytest.mark.parametrize("rows", [1, 300])
@pytest.mark.parametrize("model", ["six_planes", "nine_planes"])
def test_rows_of_time(tally, root, tmp_path, model, rows, precision):
    """1 and 300 rows of time, 300 timesteps, decoder in float32 and bfloat16"""
    scene = write_scene(root, "ball", views=300, times=300, size=12)
    changed = (f"model.time_resolution={rows}", f"model.precision={precision}")
    config = settings(model, scene, *changed)
    assert tally.trained(lambda: trained(config, tmp_path / "run")) is not None


@pytest.mark.parametrize("samples", [1, 2, 1024])
@pytest.mark.parametrize("step", [1e-3, 1e3])
def test_samples_and_sizes(tally, root, tmp_path, samples, step):
    """1 to 1024 samples a ray, cubes 1e3 times too small and too large"""
    scene = write_scene(root, "ball")
    changed = (f"model.sampler.samples={samples}", f"data.half_side={step}")
    config = settings("six_planes", scene, *changed)
    assert tally.trained(lambda: trained(config, tmp_path / "run")) is not None


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1.0, 1e8, 1e30])
@pytest.mark.parametrize("density", ["softplus", "exp"])
def test_density_scales(tally, root, tmp_path, density, scale):
    """Densities from nearly 0 to 1e8 and beyond, softplus and exp"""
    changed = (f"model.decoder.density={density}", f"model.decoder.density_scale={scale or 1e-38}")
    config = settings("six_planes", write_scene(root, "ball"), *changed)
    tally.trained(lambda: trained(config, tmp_path / "run"))
