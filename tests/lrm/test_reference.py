"""The models reproduce the recorded outputs of the published code."""

import torch

from tests.lrm.reference import (
    OPENLRM_AXES,
    TRIPOSR_AXES,
    VERSIONS,
    arrays,
    compare,
    load_reduced,
    own_features,
)
from xplanes.fields.lookup import plane_features
from xplanes.lrm import images
from xplanes.lrm.canonical import OPENLRM_VIEW, TRIPOSR_VIEW, camera_vector, canonical_vector
from xplanes.lrm.vit import interpolate_positions


def field_points(triplane, decoder, points):
    """Colour and density from planes [3, C, H, H] in our layout, read by the product's lookup."""
    space = triplane.permute(0, 2, 3, 1).contiguous()
    features = plane_features(space, None, points, torch.zeros(len(points)), ())
    return decoder(features.flatten(1))


def test_openlrm_encodes_images_to_triplanes():
    for version, size in (("1.0", 96), ("1.1", 56), ("1.1", 70)):
        folder, case = VERSIONS[version], f"OpenLRM {version} at {size} pixels"
        model, truth = load_reduced(folder), arrays(f"{folder}/encode_{size}.npz")
        with torch.no_grad():
            tokens, camera = model.encoder(truth["image"]), model.camera(truth["camera"])
            compare(tokens, truth["encoder_tokens"], case=case)
            compare(camera, truth["camera_embedding"], case=case)
            if "transformer_tokens" in truth:
                transformed = model.transform(tokens, camera)
                compare(transformed, truth["transformer_tokens"], atol=1e-3, case=case)
        planes = model.encode(truth["image"], truth["camera"])
        expected = truth["planes"].clone()
        expected[:, 2] = truth["planes"][:, 2].transpose(-2, -1)
        compare(planes, expected, case=case)
        # The file's first camera is the canonical one.
        compare(model.encode(truth["image"][:1]), expected[:1], case=case)


def test_openlrm_decodes_points():
    for version, folder in VERSIONS.items():
        model, truth = load_reduced(folder), arrays(f"{folder}/points.npz")
        for scene in range(2):
            case = f"OpenLRM {version}, scene {scene}"
            own, points = truth["planes"][scene], truth["points"][scene]
            features = own_features(own, points, OPENLRM_AXES)
            compare(features, truth["features"][scene].transpose(0, 1).flatten(1), case=case)
            logits = model.decoder.logits(features)
            compare(logits[:, :1], truth["sigma_raw"][scene], case=case)
            triplane = torch.stack([own[0], own[1], own[2].transpose(-2, -1)])
            rgb, density = field_points(triplane, model.decoder, points)
            compare(rgb, truth["rgb"][scene], case=case)
            compare(density[:, None], truth["sigma"][scene], rtol=1e-3, case=case)


def test_triposr_encodes_images_to_triplanes():
    model, truth = load_reduced("triposr_tiny"), arrays("triposr_tiny/encode_native.npz")
    pictures = truth["image"].permute(2, 0, 1)[None]
    with torch.no_grad():
        tokens = model.encoder(pictures)
        compare(tokens, truth["encoder_tokens"])
        compare(model.transform(tokens).transpose(1, 2), truth["triplane_tokens_out"], atol=1e-3)
    compare(model.encode(pictures), truth["scene_codes"], atol=1e-3)


def test_triposr_decodes_points():
    model, truth = load_reduced("triposr_tiny"), arrays("triposr_tiny/points.npz")
    points = truth["points"] / model.half_side
    logits = model.decoder.logits(own_features(truth["scene_code"], points, TRIPOSR_AXES))
    compare(logits[:, :1], truth["density"])
    compare(logits[:, 1:], truth["features"], atol=1e-3)
    rgb, density = field_points(truth["scene_code"], model.decoder, points)
    compare(rgb, truth["color"])
    compare(density[:, None] * 1.738, truth["density_act"], rtol=1e-3)


def test_position_embeddings_are_interpolated():
    truth = arrays("pos_interp.npz")
    for kind, patch, sizes in (
        ("dinov2", 14, (224, 336, 448, 518)),
        ("dino", 16, (224, 256, 384, 512)),
    ):
        embedding = truth[f"{kind}_pos_embed"]
        for size in sizes:
            found = interpolate_positions(embedding, size // patch, antialias=kind == "dinov2")
            compare(found, truth[f"{kind}_{size}"], case=f"{kind} at {size} pixels")


def test_openlrm_preprocessing():
    truth = arrays("preprocess/openlrm.npz")
    rgba = truth["rgba"].permute(2, 0, 1)[None]
    compare(images.prepare(rgba, "openlrm-1.1", 56), truth["image_56"])
    compare(images.prepare(0 * rgba, "openlrm-1.0", 3), torch.ones(1, 3, 3, 3))


def test_triposr_preprocessing():
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


def test_canonical_cameras():
    truth = arrays("cameras/openlrm.npz")
    compare(canonical_vector()[None], truth["canonical16"], atol=1e-6)
    pose = OPENLRM_VIEW.camera_to_world()
    compare(pose.flatten()[None].float(), truth["canonical25"][:, :16], atol=1e-6)
    found = camera_vector(truth["normalized_auto"], (0.75, 0.75))
    compare(found, truth["principle16"], atol=1e-6)
    pose = TRIPOSR_VIEW.camera_to_world()
    compare(pose[:3, 3].float(), arrays("cameras/triposr.npz")["rays_o"][0, 0, 0], atol=1e-6)
