"""The similarity from a scene to a model's frame."""

from dataclasses import replace
from itertools import product

import pytest
import torch

from tests.lrm.reference import arrays, compare
from xplanes.lrm import LRMError
from xplanes.lrm.alignment import align
from xplanes.lrm.canonical import OPENLRM_VIEW, TRIPOSR_VIEW
from xplanes.lrm.images import Crop
from xplanes.scenes.cameras import cast_rays, focal_length, look_at

VIEWS = {"openlrm": OPENLRM_VIEW, "triposr": TRIPOSR_VIEW}
DNERF_FOCAL = focal_length(0.6911112, 400)


def random_pose(seed, distance=4.03):
    generator = torch.Generator().manual_seed(seed)
    position = torch.nn.functional.normalize(torch.randn(1, 3, generator=generator), dim=-1)
    return look_at(distance * position)[0]


def transformed(frame, pose):
    """A pose in the model's frame, in double precision. [4, 4]"""
    result = torch.eye(4, dtype=torch.float64)
    result[:3, :3] = frame.rotation.double() @ pose[:3, :3].double()
    centre = pose[:3, 3].double() - frame.centre.double()
    result[:3, 3] = frame.scale * frame.rotation.double() @ centre
    return result


def test_source_camera_becomes_the_models_where_focal_lengths_agree():
    for (name, view), seed in product(VIEWS.items(), range(5)):
        case, pose = f"{name}, seed {seed}", random_pose(seed)
        target = pose[:3, 3] - 3.3 * pose[:3, 2]
        focal = view.focal * 400
        alignment = align(pose, focal=focal, height=400, width=400, target=target, view=view)
        compare(transformed(alignment.frame, pose), view.camera_to_world(), atol=2e-6, case=case)
        assert alignment.frame.scale == pytest.approx(view.distance / 3.3, rel=1e-6), case
        assert alignment.mismatch.largest < 1e-3, case
        origin = alignment.field_frame.points(target[None])
        compare(origin, torch.zeros(1, 3), atol=1e-6, case=case)


def test_sizes_agree_at_the_target_where_focal_lengths_differ():
    for name, scale, distance in (("openlrm", 0.9188, 3.704), ("triposr", 0.4765, 1.921)):
        view, pose = VIEWS[name], random_pose(1, 4.03113)
        alignment = align(
            pose, focal=DNERF_FOCAL, height=400, width=400, target=torch.zeros(3), view=view
        )
        assert alignment.frame.scale == pytest.approx(scale, rel=1e-3), name
        centre = transformed(alignment.frame, pose)[:3, 3]
        assert float(centre.norm()) == pytest.approx(distance, rel=1e-3), name
        # A point beside the target is seen at the same place by both cameras.
        point = 0.3 * pose[:3, 0]
        source = DNERF_FOCAL / 400 * 0.3 / 4.03113
        offset = alignment.frame.points(point)
        right = (view.rotation_matrix().float().T @ offset)[0]
        for length in (offset.norm(), right):
            predicted = view.focal * length / view.distance
            assert float(predicted) == pytest.approx(source, rel=1e-4), name
        assert alignment.half_side * alignment.field_frame.scale == pytest.approx(
            alignment.frame.scale, rel=1e-6
        ), name


def test_padding_makes_the_focal_lengths_agree():
    for name, view in VIEWS.items():
        pose = random_pose(2)
        options = {"focal": DNERF_FOCAL, "height": 400, "width": 400, "target": torch.zeros(3)}
        plain = align(pose, view=view, **options)
        padded = align(pose, view=view, matching="pad", **options)
        assert DNERF_FOCAL / padded.crop.side == pytest.approx(view.focal, rel=2e-3), name
        assert padded.crop.top == padded.crop.left == (400 - padded.crop.side) // 2, name
        assert padded.mismatch.largest < 0.3, name
        assert padded.mismatch.largest < plain.mismatch.largest, name
        compare(transformed(padded.frame, pose), view.camera_to_world(), atol=0.01, case=name)


def test_crop_moves_the_centre_to_its_middle():
    pose, crop = random_pose(3), Crop(100, 180, 160)
    alignment = align(
        pose, focal=500, height=400, width=400, target=torch.zeros(3), view=TRIPOSR_VIEW, crop=crop
    )
    local = pose[:3, :3].T @ (alignment.frame.centre - pose[:3, 3])
    column, row = 200 + 500 * local[0] / -local[2], 200 - 500 * local[1] / -local[2]
    assert (float(column), float(row)) == pytest.approx((260, 180), abs=1e-3)
    assert float(-local[2]) == pytest.approx(4.03, rel=1e-5)
    share = 500 / 160
    assert alignment.frame.scale == pytest.approx(1.9 * share / 4.03 / TRIPOSR_VIEW.focal)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"focal": 500, "target": 2 * random_pose(4)[:3, 3]}, "behind the source camera"),
        ({"focal": 100}, "too short"),
        ({"focal": 500, "matching": "pad", "crop": Crop(0, 0, 10)}, "pad"),
    ],
)
def test_wrong_cameras_are_refused(options, words):
    given = {"height": 400, "width": 400, "view": OPENLRM_VIEW, "target": torch.zeros(3)}
    with pytest.raises(LRMError, match=words):
        align(random_pose(4), **given | options)


def test_published_normalisation_of_poses_is_a_special_case():
    truth = arrays("cameras/openlrm.npz")
    poses = torch.eye(4).repeat(4, 1, 1)
    poses[:, :3] = truth["poses"]
    for kind, distance in (("auto", 2.3), ("dist2", 2.0)):
        target = poses[0, :3, 3] - distance * poses[0, :3, 2]
        options = {"target": target, "view": replace(OPENLRM_VIEW, distance=distance)}
        alignment = align(poses[0], focal=300, height=400, width=400, **options)
        assert alignment.frame.scale == pytest.approx(1), kind
        for pose, expected in zip(poses, truth[f"normalized_{kind}"], strict=True):
            compare(transformed(alignment.frame, pose)[:3], expected, atol=2e-6, case=kind)


def rays_of(pose, focal, size):
    """A ray through the middle of each pixel."""
    rows, columns = (
        axis.flatten() for axis in torch.meshgrid(*[torch.arange(size)] * 2, indexing="ij")
    )
    return cast_rays(pose, rows, columns, focal=focal, centre=(0.5 * size, 0.5 * size))


def test_rays_are_those_of_the_published_code():
    truth = arrays("openlrm_1.0_tiny/render.npz")
    cameras = truth["cameras"].flatten(0, 1)
    for camera, origins, directions in zip(cameras, truth["rays_o"], truth["rays_d"], strict=True):
        found = rays_of(camera[:16].view(4, 4), 12 * float(camera[16]), size=12)
        compare(found[0], origins)
        compare(found[1], directions)
    truth = arrays("triposr_tiny/render_canonical.npz")
    size = truth["rays_o"].shape[1]
    pose = TRIPOSR_VIEW.camera_to_world().float()
    found = rays_of(pose, TRIPOSR_VIEW.focal * size, size)
    compare(found[0], truth["rays_o"][0].flatten(0, 1))
    compare(found[1], truth["rays_d"][0].flatten(0, 1))
