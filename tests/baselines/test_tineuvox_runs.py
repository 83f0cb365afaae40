"""What runs of TiNeuVox promise."""

import pytest
import torch

from tests.balls import ball_views
from tests.baselines.checks import check_learns, check_refused, check_reload, check_resume
from tests.baselines.runs import TINEUVOX, baseline_config
from xplanes.baselines.tineuvox.model import frusta_box
from xplanes.models.initialisation import Method
from xplanes.rendering.sampler import Site

FAST = ("model.network_learning_rate=0.004", "trainer.max_steps=34")


@pytest.mark.slow
def test_run_learns_grows_resumes_and_is_loaded(scenes, tmp_path):
    config = baseline_config(scenes, "model=tineuvox_s", *TINEUVOX, *FAST)
    folder = check_learns(config, tmp_path / "whole", gain=3)
    # Between two growths, so that the grid and the moments of another size are loaded.
    check_resume(config, folder, tmp_path / "broken", stop=23)
    trained = check_reload(folder)
    assert int(trained.module.field.voxels) == 20**3


def test_box_holds_what_cameras_see_between_the_bounds(scenes):
    views = ball_views(5, 0.6)
    box = frusta_box(views, 2.0, 6.0, 1.0)
    larger = frusta_box(views, 2.0, 6.0, 1.05)
    origins, directions = views.image_rays(3)
    for distance in (2.0, 3.7, 6.0):
        points = origins + distance * directions
        assert ((points >= box[0]) & (points <= box[1])).all()
    torch.testing.assert_close(larger[1] - larger[0], 1.05 * (box[1] - box[0]))
    torch.testing.assert_close(larger.sum(dim=0), box.sum(dim=0))


def test_learning_rates_and_cells_follow_the_published_schedule(scenes):
    settings = Method.read(baseline_config(scenes, "model=tineuvox_s")).model
    views = ball_views(4, 0.6)
    frame, bounds = settings.frame(views), settings.bounds(views)
    model = settings.build(Site(frame, views.times, 0, "32", bounds))
    steps = (0, 1999, 2000, 4000, 6000, 19999)
    assert [model.voxels(s) for s in steps] == [125000, 125000, 250000, 500000, 1000000, 1000000]
    for step, since in zip(steps, (0, 1999, 0, 0, 0, 13999), strict=True):
        assert model.rate(step, 0.5) == pytest.approx(0.1 ** (since / 20000))
    rates = {group["name"]: group["lr"] for group in model.groups()}
    assert (rates["grid"], rates["deformation"], rates["trunk"]) == (0.08, 0.0006, 0.0008)


def test_settings_that_cannot_work_are_refused(scenes):
    for override, words in (
        ("model.near=7", r"model\.near=7\.0: must be below far=6\.0"),
        ("model.sampler.near=7", r"model\.sampler\.near=7\.0: must be below far=6\.0"),
        ("model.sampler.threshold=1", "must lie between 0 and 1"),
        ("model.alpha_start=1", "must lie between 0 and 1"),
        ("model.alpha_start=0", "must lie between 0 and 1"),
        ("lrm=file", "the initialisation is planes, and the model takes none; set lrm=none"),
        ("model.sampler.step=0", "must be above 0"),
    ):
        check_refused(scenes, words, "model=tineuvox_s", override)
    # Samplers that need two stages refuse other models.
    words = r"model\.sampler\.name=fixed_step: needs a feature grid.* model/sampler=occupancy"
    check_refused(scenes, words, "model/sampler=fixed_step")
    words = r"model\.sampler\.name=neus: needs a field with a surface.* model/sampler=occupancy"
    for model in ("six_planes", "tineuvox_s"):
        check_refused(scenes, words, f"model={model}", "model/sampler=neus")
