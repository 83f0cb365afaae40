"""What a model's code must reproduce, as functions of that code.

Each check takes the package, so that altered copies of it can be put to the same test.
"""

import importlib
from types import ModuleType

import torch

from tests.lrm.reference import (
    FOLDER,
    OPENLRM_AXES,
    TRIPOSR_AXES,
    VERSIONS,
    WEIGHTS,
    arrays,
    compare,
    config,
    own_features,
)
from xplanes.fields.lookup import plane_features


def load(package: ModuleType, folder: str):
    return package.load(config(folder), FOLDER / folder / WEIGHTS[folder])


def field_points(triplane, decoder, points):
    """Colour and density from planes [3, C, H, H] in our layout, read by the product's lookup."""
    space = triplane.permute(0, 2, 3, 1).contiguous()
    features = plane_features(space, None, points, torch.zeros(len(points)), ())
    return decoder(features.flatten(1))


def openlrm_encode(package: ModuleType, version: str, size: int) -> None:
    folder = VERSIONS[version]
    model, truth = load(package, folder), arrays(f"{folder}/encode_{size}.npz")
    with torch.no_grad():
        tokens, camera = model.encoder(truth["image"]), model.camera(truth["camera"])
        compare(tokens, truth["encoder_tokens"])
        compare(camera, truth["camera_embedding"])
        if "transformer_tokens" in truth:
            compare(model.transform(tokens, camera), truth["transformer_tokens"], atol=1e-3)
    planes = model.encode(truth["image"], truth["camera"])
    expected = truth["planes"].clone()
    expected[:, 2] = truth["planes"][:, 2].transpose(-2, -1)
    compare(planes, expected)
    # The file's first camera is the canonical one.
    compare(model.encode(truth["image"][:1]), expected[:1])


def openlrm_points(package: ModuleType, version: str) -> None:
    folder = VERSIONS[version]
    model, truth = load(package, folder), arrays(f"{folder}/points.npz")
    for scene in range(2):
        own, points = truth["planes"][scene], truth["points"][scene]
        features = own_features(own, points, OPENLRM_AXES)
        compare(features, truth["features"][scene].transpose(0, 1).flatten(1))
        compare(model.decoder.logits(features)[:, :1], truth["sigma_raw"][scene])
        triplane = torch.stack([own[0], own[1], own[2].transpose(-2, -1)])
        rgb, density = field_points(triplane, model.decoder, points)
        compare(rgb, truth["rgb"][scene])
        compare(density[:, None], truth["sigma"][scene], rtol=1e-3)


def openlrm_grid(package: ModuleType, version: str) -> None:
    """From an image to densities on a grid: layout, decoder and encoder together."""
    folder = VERSIONS[version]
    model, truth = load(package, folder), arrays(f"{folder}/grid.npz")
    size = 56 if version == "1.1" else 96
    encoded = arrays(f"{folder}/encode_{size}.npz")
    triplanes = model.encode(encoded["image"], encoded["camera"])
    line = torch.linspace(-1, 1, int(truth["grid_size"]))
    points = torch.stack(torch.meshgrid(line, line, line, indexing="ij"), dim=-1).view(-1, 3)
    for scene in range(2):
        rgb, density = field_points(triplanes[scene], model.decoder, points)
        compare(rgb, truth["rgb"][scene].view(-1, 3))
        compare(density, truth["sigma"][scene].flatten(), rtol=1e-3)


def triposr_encode(package: ModuleType) -> None:
    model, truth = load(package, "triposr_tiny"), arrays("triposr_tiny/encode_native.npz")
    images = truth["image"].permute(2, 0, 1)[None]
    with torch.no_grad():
        tokens = model.encoder(images)
        compare(tokens, truth["encoder_tokens"])
        compare(model.transform(tokens).transpose(1, 2), truth["triplane_tokens_out"], atol=1e-3)
    compare(model.encode(images), truth["scene_codes"], atol=1e-3)


def triposr_points(package: ModuleType) -> None:
    model, truth = load(package, "triposr_tiny"), arrays("triposr_tiny/points.npz")
    points = truth["points"] / model.half_side
    logits = model.decoder.logits(own_features(truth["scene_code"], points, TRIPOSR_AXES))
    compare(logits[:, :1], truth["density"])
    compare(logits[:, 1:], truth["features"], atol=1e-3)
    rgb, density = field_points(truth["scene_code"], model.decoder, points)
    compare(rgb, truth["color"])
    compare(density[:, None] * 1.738, truth["density_act"], rtol=1e-3)


def positions(package: ModuleType) -> None:
    interpolate = package.vit.interpolate_positions
    truth = arrays("pos_interp.npz")
    for kind, patch, sizes in (
        ("dinov2", 14, (224, 336, 448, 518)),
        ("dino", 16, (224, 256, 384, 512)),
    ):
        for size in sizes:
            found = interpolate(
                truth[f"{kind}_pos_embed"], size // patch, antialias=kind == "dinov2"
            )
            compare(found, truth[f"{kind}_{size}"])


def preprocessing(package: ModuleType) -> None:
    images = package.images
    truth = arrays("preprocess/openlrm.npz")
    rgba = truth["rgba"].permute(2, 0, 1)[None]
    compare(images.prepare(rgba, "openlrm-1.1", 56), truth["image_56"])
    truth = arrays("preprocess/triposr.npz")
    rgba = truth["rgba"].permute(2, 0, 1)[None]
    crop = images.foreground_crop(rgba[0, 3])
    cropped = crop.apply(rgba)
    assert torch.equal(cropped[0].permute(1, 2, 0), truth["resized_foreground_rgba"])
    side = cropped.shape[-1]
    composited = images.prepare(cropped, "triposr", side)[0].permute(1, 2, 0) * 255
    assert torch.equal(composited.round().to(torch.uint8), truth["composited_uint8"])
    found = images.prepare(cropped, "triposr", 96).permute(0, 2, 3, 1)
    compare(found, truth["cond_image_96"])
    # The recorded picture is enlarged; made smaller, stripes must blend into grey.
    stripes = torch.tensor([0.0, 1.0, 1.0, 0.0]).repeat(16).expand(1, 3, 64, 64)
    compare(images.resize_triposr(stripes, 16), torch.full((1, 3, 16, 16), 0.5), atol=0.1)


def cameras(package: ModuleType) -> None:
    canonical, truth = package.canonical, arrays("cameras/openlrm.npz")
    compare(canonical.canonical_vector()[None], truth["canonical16"], atol=1e-6)
    pose = canonical.OPENLRM_VIEW.camera_to_world()
    compare(pose.flatten()[None].float(), truth["canonical25"][:, :16], atol=1e-6)
    found = canonical.camera_vector(truth["normalized_auto"], (0.75, 0.75))
    compare(found, truth["principle16"], atol=1e-6)
    pose = canonical.TRIPOSR_VIEW.camera_to_world()
    compare(pose[:3, 3].float(), arrays("cameras/triposr.npz")["rays_o"][0, 0, 0], atol=1e-6)


def alignment(package: ModuleType) -> None:
    """Normalised poses of the published code, and sizes at the target's depth."""
    align = importlib.import_module(f"{package.__name__}.alignment").align
    truth = arrays("cameras/openlrm.npz")
    view = package.canonical.OPENLRM_VIEW
    poses = torch.eye(4).repeat(4, 1, 1)
    poses[:, :3] = truth["poses"]
    target = poses[0, :3, 3] - view.distance * poses[0, :3, 2]
    options = {"height": 400, "width": 400, "target": target}
    found = align(poses[0], focal=300, view=view, **options)
    moved = found.frame.points(poses[:, :3, 3])
    compare(moved, truth["normalized_dist2"][:, :, 3], atol=1e-5)
    turned = found.frame.rotation @ poses[:, :3, :3]
    compare(turned, truth["normalized_dist2"][:, :, :3], atol=1e-5)
    for view in (package.canonical.OPENLRM_VIEW, package.canonical.TRIPOSR_VIEW):
        found = align(poses[0], focal=600, view=view, **options)
        # A point beside the target, as both cameras see it, in shares of the picture's width.
        offset = found.frame.points(target + 0.2 * poses[0, :3, 0])
        right = (view.rotation_matrix().float().T @ offset)[0]
        compare(right * view.focal / view.distance, torch.tensor(0.2 * 1.5 / 2.0))
        optical_depth = found.field_density_factor * 2.0 * found.field_frame.scale
        assert abs(optical_depth / (2.0 * found.density_factor) - 1) < 1e-6


CHECKS = [
    *(
        (f"openlrm {v} encode {s}", lambda p, v=v, s=s: openlrm_encode(p, v, s))
        for v, s in (("1.0", 96), ("1.1", 56), ("1.1", 70))
    ),
    *((f"openlrm {v} points", lambda p, v=v: openlrm_points(p, v)) for v in VERSIONS),
    *((f"openlrm {v} grid", lambda p, v=v: openlrm_grid(p, v)) for v in VERSIONS),
    ("triposr encode", triposr_encode),
    ("triposr points", triposr_points),
    ("positions", positions),
    ("preprocessing", preprocessing),
    ("cameras", cameras),
    ("alignment", alignment),
]
