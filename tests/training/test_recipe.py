"""recipe=paper: its settings, and that what it computes is what its sources print."""

import itertools
from dataclasses import replace

import pytest
import torch

from tests.balls import ball_scene
from tests.baselines.runs import KPLANES, PROPOSAL
from tests.preparation.sequences import moving_sequence
from tests.training.runs import SMALL, changed, metrics
from xplanes.baselines.products import PlaneProducts, PlaneTerms
from xplanes.baselines.tensor4d.model import FeatureSmoothness
from xplanes.config import compose_plain
from xplanes.decomposition import decompose, sparse_product_loss
from xplanes.errors import ConfigError
from xplanes.experiment import Experiment
from xplanes.fields.xplanes import PLANE_SETS, TIME_PLANES
from xplanes.files import read_rows
from xplanes.models.base import InitialValues
from xplanes.models.initialisation import Initialisation
from xplanes.preparation import TriplaneSequence, fixed_view, save_triplanes
from xplanes.preparation.cache import StageCache
from xplanes.preparation.stages import convert_stage, decompose_stage, named_planes
from xplanes.run import run
from xplanes.streams import TrainingState
from xplanes.training.module import RadianceModule

LRMS = ("tiny", "mini", "small", "base", "large", "xlarge")

METHOD = {
    **{"static": "middle", "dynamic": "ones", "method": "admm", "scale": "none"},
    **{"sparsity_weight": 0.009, "penalty": 0.05},
}
FIXED_VIEW = {
    **{"fixed_view": "train", "fixed_view_model": "kplanes", "fixed_view_steps": 30000},
    **{"fixed_view_seconds": None, "frames": None},
}
LOSS = {
    **{"opacity": 0.0, "floaters": 0.0, "variation": "coded", "time_magnitude": 0.0, "every": 1},
    **{"sparse_weight": 1.0, "sparse_reduction": "sum", "sparse_frames": None},
    **{"initial_weight": 0.0, "initial_steps": None},
}
TERMS = ("total_variation", "time_variation", "time_smoothness", "time_identity")
OWN = {
    "six_planes": {
        "loss": dict(zip(TERMS, (1e-4, 1e-4, 3e-2, 3e-4), strict=True)),
        "rates": (0.01, 0.01, 0.01),
        "schedule": (512, 0.0),
        "rays": (4096, "one"),
        "losses": {},
    },
    "nine_planes": {
        "loss": dict.fromkeys(TERMS, 0.0),
        "rates": (0.0025, 0.0025, 0.0005),
        "schedule": (2000, 0.1),
        "rays": (512, "white"),
        "losses": {"smoothness": (FeatureSmoothness, 0.01)},
    },
}


def test_every_setting_is_the_papers_or_its_references():
    for (name, own), lrm in zip(itertools.cycle(OWN.items()), LRMS, strict=False):
        case = f"model={name}", f"lrm={lrm}"
        experiment = Experiment.read(compose_plain("train", ["recipe=paper", *case]))
        method, model = experiment.method, experiment.method.model
        assert (model.name, method.lrm.name) == (name, lrm)
        for settings, wanted in (
            (method.decomposition, METHOD),
            (method.preparation, FIXED_VIEW),
            (model.loss, LOSS | own["loss"]),
        ):
            assert {key: getattr(settings, key) for key in wanted} == wanted, case
        assert (model.resolution, model.time_resolution) == (64, "half")
        assert (model.plane_lr, model.time_lr, model.decoder_lr) == own["rates"], case
        assert (model.warmup_steps, model.final_lr) == own["schedule"], case
        assert (model.rays.per_batch, model.rays.background) == own["rays"], case
        assert not model.rays.skip_background
        assert not model.decoder.freeze
        # The sampler has neither silhouettes nor an occupancy grid, and lies in the LRM's cube.
        sampler = model.sampler
        assert (sampler.name, sampler.near, sampler.far) == ("proposal", None, None)
        assert (sampler.proposal_samples, sampler.samples) == ([256, 128], 48)
        assert experiment.trainer["max_steps"] == 30000
        assert experiment.trainer["max_seconds"] is None
        assert experiment.callbacks["collapse"]["restarts"] == 0
        found = {key: (type(term), term.weight) for key, term in method.losses.items()}
        assert found == own["losses"], case


def test_the_largest_lrm_is_its_own_and_others_can_be_chosen():
    assert changed(("recipe=paper",))["lrm"]["name"] == "xlarge"
    plain = compose_plain("train", ["recipe=paper", "model=nine_planes", "lrm=tiny", "seed=3"])
    assert (plain["lrm"]["name"], plain["model"]["plane_lr"]) == ("tiny", 0.0025)
    plain = compose_plain("train", ["recipe=paper", "lrm=none", "model.plane_lr=0.5"])
    assert (plain["lrm"]["name"], plain["model"]["plane_lr"]) == ("none", 0.5)


def test_baselines_refuse_it():
    for name in ("kplanes", "tensor4d"):
        plain = compose_plain("train", ["recipe=paper", f"model={name}", "lrm=none"])
        with pytest.raises(ConfigError, match=r"model\.\S+: there is no such setting"):
            Experiment.read(plain)


# What it computes

STATE = TrainingState(seed=0, step=3, batch=3, rank=0)

TINY = (
    *(text for text in SMALL if "sampler" not in text and "per_batch" not in text),
    *PROPOSAL,
    "model.rays.per_batch=64",
    "model.resolution=8",
)


def small(*overrides: str) -> dict:
    return changed(("recipe=paper", *TINY), *overrides)


def module_of(*overrides: str) -> tuple[RadianceModule, torch.Tensor]:
    """A field of the recipe with random initial planes, and the sparse part that L_r gets."""
    generator = torch.Generator().manual_seed(1)
    sparse = torch.randn(4, 3, 8, 6, 6, generator=generator)

    module, scene = RadianceModule(small(*overrides)), ball_scene()
    model = module.method.model
    planes = {name: torch.randn(8, 8, 8, generator=generator) for name in ("xy", "xz", "yz")}
    for name in TIME_PLANES[model.plane_set]:
        planes[name] = torch.randn(8, 3, 8, generator=generator)
    frame = model.frame(scene.splits["train"])
    values = InitialValues(planes, sparse=sparse)
    module.build(scene, frame, initialisation=Initialisation(model, frame, values=values))
    return module, sparse


def test_k_planes_terms_are_those_of_k_planes_on_the_same_planes():
    module, _ = module_of("model=six_planes", "model.loss.sparse_weight=0")
    field = module.field
    products = PlaneProducts(8, 8, [1], 3, low=0.0, high=1.0)
    named = dict(products.planes())
    with torch.no_grad():
        for name, plane in field.planes.items():
            named[name][0].copy_(plane)
    terms = PlaneTerms(1e-4, "coded", 1e-2, 1e-4)
    wanted = {key: float(value.detach()) for key, value in terms.values(products).items()}
    weights = {"total_variation": 1e-4, "time_smoothness": 1e-2, "time_identity": 1e-4}
    found = module.model.regularisers(STATE)
    found["total_variation"] += found.pop("time_variation")
    assert found == pytest.approx({key: weights[key] * wanted[key] for key in weights}, rel=1e-5)

    # Their gradients, against those of K-Planes' own code here.
    for parameter in field.parameters():
        parameter.grad = torch.zeros_like(parameter)
    module.model.regularise(STATE)
    terms.add_gradients(products)
    stacks = {"space": field.space.grad, "time": field.time.grad}
    names = {"space": ("xy", "xz", "yz"), "time": TIME_PLANES["six"]}
    for stack, gradients in stacks.items():
        for name, gradient in zip(names[stack], gradients, strict=True):
            expected = named[name].grad[0].permute(1, 2, 0)
            torch.testing.assert_close(gradient, expected, rtol=1e-4, atol=1e-9, msg=name)


@pytest.mark.parametrize("name", OWN)
def test_l_r_is_the_sum_over_all_entries_in_every_step(name):
    module, sparse = module_of(f"model={name}", *(f"model.loss.{term}=0" for term in TERMS))
    planes = module.field.time.detach().clone().requires_grad_()
    rows = PLANE_SETS[module.field.plane_set]
    mean = sparse_product_loss(planes, sparse, torch.arange(len(sparse)), rows=rows)
    (total := mean * sparse.numel()).backward()
    assert module.model.regularisers(STATE) == pytest.approx({"l_r": total.item()}, rel=1e-5)
    for step in range(3):
        for parameter in module.field.parameters():
            parameter.grad = torch.zeros_like(parameter)
        module.model.regularise(TrainingState(seed=0, step=step, batch=step, rank=0))
        torch.testing.assert_close(module.field.time.grad, planes.grad, rtol=1e-4, atol=1e-4)
        assert not module.field.space.grad.any()


def test_the_features_may_not_change_over_a_small_distance():
    module, _ = module_of("model=nine_planes")
    batch = {
        "origins": torch.tensor([[0.0, 0.0, 2.0]]).expand(64, 3),
        "directions": torch.nn.functional.normalize(
            torch.cat([torch.linspace(-0.2, 0.2, 128).view(64, 2), -torch.ones(64, 1)], 1), dim=1
        ),
        "times": torch.linspace(0, 1, 64),
        "background": torch.ones(64, 3),
    }
    rendering = module.sampler.render(module.field, batch, STATE)

    def change(distance: float) -> float:
        term = FeatureSmoothness(weight=1.0, distance=distance)
        return float(term.value(module.field, rendering, batch, STATE).detach())

    near, far = change(0.001), change(0.002)
    assert far == pytest.approx(4 * near, rel=0.05)  # Squared, and linear over a texel.
    with torch.no_grad():
        module.field.space.fill_(0.3)
        module.field.time.fill_(0.5)
    # Planes fade to zero at the faces of the cube.
    inner = replace(rendering.samples, points=0.5 * rendering.samples.points)
    rendering = replace(rendering, samples=inner)
    assert change(0.001) < 1e-9 * near
    term = FeatureSmoothness(weight=1.0, distance=0.001)
    with pytest.raises(ConfigError, match=r"model/sampler=proposal; leave it out"):
        term.value(module.field, object(), batch, STATE)


@pytest.mark.parametrize(
    "model", ["six_planes", pytest.param("nine_planes", marks=pytest.mark.slow)]
)
def test_a_run_logs_every_term_in_its_loss(model, scenes, tmp_path):
    sequence = moving_sequence()
    save_triplanes(tmp_path / "triplanes.pt", TriplaneSequence(sequence))
    config = small(
        *(f"model={model}", "lrm=file", f"lrm.triplanes={tmp_path}/triplanes.pt"),
        *(f"data.root={scenes}", "preparation.cache=null", "callbacks.evaluation.at=[]"),
        *("trainer.max_steps=3", "trainer.log_every_n_steps=1", "logger=csv"),
    )
    run(config, tmp_path / "run", [], resume=False)
    (path,) = (tmp_path / "run").rglob("metrics.csv")
    rows = [row for row in read_rows(path) if row["train/loss"]]
    assert len(rows) == 3
    own = {"six_planes": "time_identity", "nine_planes": "smoothness"}[model]
    others = ("train/loss", "train/psnr", "train/steps_skipped")
    for row in rows:
        terms = {
            key.partition("/")[2]: float(value)
            for key, value in row.items()
            if key.startswith("train/") and value and key not in others
        }
        assert {"colour", "histogram", "l_r", own} <= set(terms)
        assert float(row["train/loss"]) == pytest.approx(sum(terms.values()), rel=1e-6)
    parts = decompose(sequence, method="admm", sparsity_weight=0.009, penalty=0.05)
    assert float(rows[0]["train/l_r"]) > 1e-3 * parts.sparse.square().sum().item()


@pytest.mark.slow
def test_it_runs_on_a_scene_off_centre(scenes, tmp_path, monkeypatch):
    """A few steps, of the small K-Planes that render the fixed view too."""

    def composed(name, lines):
        return compose_plain(name, [*lines, *KPLANES, *PROPOSAL])

    monkeypatch.setattr(fixed_view, "compose_plain", composed)
    sizes = (text for text in TINY if text != "lrm=none")
    scene = f"data.root={scenes}", "data=suite", "data.scene=off_centre"
    config = changed(("recipe=paper", *sizes), "lrm=tiny", *scene)
    config["preparation"] |= {"cache": None, "frames": 3, "fixed_view_steps": 2}
    config["trainer"]["max_steps"] = 2
    run(config, tmp_path / "run", [], resume=False)
    told = metrics(tmp_path / "run")
    assert told["lrm"]["fixed_view"] == "3 frames rendered by kplanes trained for 2 steps"
    assert told["step"] == 2
    assert 0 < told["test"]["psnr"] < 60


def test_half_the_timesteps_are_rows_whatever_the_lrm_has():
    model = Experiment.read(small("model=six_planes")).method.model
    times = torch.linspace(0, 1, 10)
    assert model.rows_of_time(times, frames=10) == 5
    default = Experiment.read(changed(())).method.model
    assert (default.rows_of_time(times, frames=16), default.rows_of_time(times)) == (16, 5)


@pytest.mark.parametrize("plane_set", ["six", "nine"])
def test_its_conversion_keeps_the_middle_frame_and_time_planes_begin_as_k_planes_do(
    tmp_path, plane_set
):
    method = Experiment.read(small(f"model={plane_set}_planes", "model.time_resolution=4")).method
    sequence, device, cache = moving_sequence(), torch.device("cpu"), StageCache(tmp_path)
    parts = decompose_stage(sequence, method.decomposition, cache, device)
    channels, size = sequence.shape[2], sequence.shape[-1]
    settings = replace(method.model, resolution=size)
    stage = convert_stage(parts, settings, method.decomposition, 0, cache, device)
    planes = named_planes(stage, plane_set)
    middle = parts.content["low_rank"][len(sequence) // 2]
    for index, name in enumerate(("xy", "xz", "yz")):
        torch.testing.assert_close(planes[name], middle[index], rtol=0, atol=0)
    for name in TIME_PLANES[plane_set]:
        assert planes[name].shape == (channels, 4, size)
        assert (planes[name] == 1).all()
