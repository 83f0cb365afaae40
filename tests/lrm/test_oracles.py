"""The volume renderers used for comparison reproduce those of the published code."""

import torch

from tests.lrm import openlrm_oracle, triposr_oracle
from tests.lrm.reference import (
    OPENLRM_AXES,
    TRIPOSR_AXES,
    VERSIONS,
    arrays,
    compare,
    load_reduced,
    own_features,
)

FILL = {"1.0": -openlrm_oracle.LOWEST / 3, "1.1": -openlrm_oracle.LOWEST / 8}


def openlrm_query(model, planes):
    """Points of views [B, Q, S, 3] to colour and raw density; planes [B, 3, C, H, W]."""

    def query(points):
        parts = []
        for own, of_view in zip(planes, points, strict=True):
            features = own_features(own, of_view.reshape(-1, 3), OPENLRM_AXES)
            logits = model.decoder.logits(features)
            parts.append(torch.cat([model.decoder.activate(logits)[0], logits[:, :1]], dim=1))
        values = torch.stack(parts).view(*points.shape[:3], 4)
        return values[..., :3], values[..., 3:]

    return query


def test_openlrm_renderer():
    for version, folder in VERSIONS.items():
        case = f"OpenLRM {version}"
        model, truth = load_reduced(folder), arrays(f"{folder}/render.npz")
        cameras = truth["cameras"].flatten(0, 1)
        if version == "1.0":
            anchors, resolutions = torch.zeros(4, 2), torch.full((4,), 12.0)
            background = torch.ones(4, 1, 1)
        else:
            anchors, resolutions = truth["anchors"].flatten(0, 1), truth["resolutions"].flatten()
            background = truth["bg_colors"].view(4, 1, 1)
        origins, directions = openlrm_oracle.window_rays(cameras, anchors, resolutions, 12)
        compare(origins, truth["rays_o"], case=case)
        compare(directions, truth["rays_d"], case=case)
        planes = truth["planes"].repeat_interleave(2, dim=0)
        found = openlrm_oracle.render(
            openlrm_query(model, planes),
            origins,
            directions,
            u_coarse=truth["u_coarse"],
            u_fine=truth["u_fine"],
            background=background,
            fill=FILL[version],
        )
        for key in ("ray_start", "ray_end", "depths_coarse", "weights_coarse", "depths_fine"):
            compare(found[key], truth[key], rtol=1e-3, atol=1e-3, case=f"{case}: {key}")

        def image(values):
            return values.transpose(1, 2).view(2, 2, -1, 12, 12)

        compare(image(found["rgb"]), truth["images_rgb"], case=case)
        compare(image(found["weight"]), truth["images_weight"], case=case)
        compare(image(found["depth"]), truth["images_depth"], rtol=1e-3, atol=1e-3, case=case)


def triposr_query(model, planes):
    """Points [R, S, 3] to colour and density per share of the ray's way; planes [3, C, H, W]."""

    def query(points):
        features = own_features(planes, points.reshape(-1, 3) / 0.87, TRIPOSR_AXES)
        logits = model.decoder.logits(features)
        colour, _ = model.decoder.activate(logits)
        density = (logits[:, :1] - 1).exp()
        return colour.view(points.shape), density.view(*points.shape[:2], 1)

    return query


def test_triposr_renderer():
    model = load_reduced("triposr_tiny")
    for file, elevation, fovy in (("render.npz", 12, 55), ("render_canonical.npz", 0, 40)):
        truth = arrays(f"triposr_tiny/{file}")
        views, height, width, _ = truth["images"].shape
        origins, directions = triposr_oracle.orbit_rays(views, elevation, 1.9, fovy, height, width)
        compare(origins, truth["rays_o"], case=file)
        compare(directions, truth["rays_d"], case=file)
        if "t_near" in truth:
            near, far, valid = triposr_oracle.box_interval(origins, directions)
            compare(near, truth["t_near"], case=file)
            compare(far, truth["t_far"], case=file)
            assert torch.equal(valid, truth["rays_valid"]), file
        query = triposr_query(model, truth["scene_code"])
        rays = origins.view(-1, 3), directions.view(-1, 3)
        found = triposr_oracle.render(query, *rays, samples=24)
        compare(found.view(truth["images"].shape), truth["images"], case=file)
