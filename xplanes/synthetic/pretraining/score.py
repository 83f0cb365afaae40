"""Reconstruction quality on held-out procedural objects and on the demo scenes."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

from xplanes.files import replacing, write_json
from xplanes.lrm import LRM
from xplanes.metrics import psnr, ssim
from xplanes.synthetic.demo.posed import Posed
from xplanes.synthetic.demo.render import camera_at, render_image
from xplanes.synthetic.demo.scenes import DEMO_SCENES, build_demo_scene
from xplanes.synthetic.pretraining.losses import triplane_logits
from xplanes.synthetic.pretraining.objects import HELD_OUT_SEEDS, procedural_object
from xplanes.synthetic.pretraining.pool import inside, render_solids, view_cameras
from xplanes.synthetic.pretraining.quick import model_pose, overlap, world_to_model
from xplanes.synthetic.pretraining.render import render_view

GRID = 48
"""Points along each side of the box on which IoU is computed."""

TURNS = (40.0, 180.0, -90.0)
"""Azimuths of the novel cameras of the demo scenes relative to the fixed camera, in degrees."""


RISE = 20.0
"""Elevation of these cameras in degrees."""


@dataclass(frozen=True)
class Subject:
    """An object or scene to reconstruct.

    Attributes:
        name: Name in tables.
        cameras: Pose of the input camera, then of novel cameras. [V, 4, 4]
        picture: Renders RGB on white for a pose and a side in pixels. [S, S, 3]
        inside: Whether world points [N, 3] are occupied. [N]
    """

    name: str
    cameras: Tensor
    picture: Callable[[Tensor, int], Tensor]
    inside: Callable[[Tensor], Tensor]


def held_out(count: int) -> Iterator[Subject]:
    """The first held-out objects, each with the cameras of its seed."""
    for seed in HELD_OUT_SEEDS[:count]:
        solids = procedural_object(seed)
        yield Subject(
            f"object {seed - HELD_OUT_SEEDS.start}",
            torch.stack([camera_at(*at) for at in view_cameras(seed, 4)]),
            lambda pose, side, s=solids: torch.from_numpy(render_solids(s, pose.numpy(), side)[0]),
            lambda points, s=solids: torch.from_numpy(inside(s, points.double().numpy())),
        )


def demo_subjects(time: float = 0.4) -> Iterator[Subject]:
    """The demo scenes at one timestep, from their fixed camera and from one above it.

    Novel cameras have an elevation of `RISE` degrees.
    """
    for name, scene in DEMO_SCENES.items():
        posed = build_demo_scene(name).pose(time)

        def picture(pose: Tensor, side: int, posed: Posed = posed) -> Tensor:
            rgba = torch.from_numpy(render_image(posed, pose, side)).float() / 255
            return rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]

        for rise in (0.0, RISE):
            cameras = [camera_at(scene.azimuth, rise)]
            cameras += [camera_at(scene.azimuth + turn, RISE) for turn in TURNS]
            yield Subject(
                name if rise == 0 else f"{name} from {RISE:g} degrees",
                torch.stack(cameras),
                picture,
                lambda points, posed=posed: posed.inside(points.float()),
            )


@dataclass(frozen=True)
class Score:
    """Scores of one subject, and a strip of images.

    Attributes:
        name: The subject.
        values: IoU, PSNR (dB) and SSIM of the input view, and their means over novel views.
        strip: Input, its reconstruction, a novel view, its reconstruction. [S, 4 S, 3]
    """

    name: str
    values: dict[str, float]
    strip: Tensor


@torch.no_grad()
def score(model: LRM, subject: Subject) -> Score:
    """Reconstruct a subject from its first view and score it."""
    side = model.image_size
    pictures = [subject.picture(pose, side).float() for pose in subject.cameras]
    planes = model.encode(pictures[0].permute(2, 0, 1)[None])
    turn = world_to_model(subject.cameras[0], model)
    line = model.half_side * (2 * (torch.arange(GRID) + 0.5) / GRID - 1)
    grid = torch.stack(torch.meshgrid(line, line, line, indexing="ij"), dim=-1).flatten(0, 2)
    solid = torch.cat(
        [
            triplane_logits(planes, model.decoder, part[None])[0, :, 0] > 1
            for part in grid.split(2**14)
        ]
    )
    world = grid @ torch.linalg.inv(turn).T
    rendered = [
        render_view(planes, model.decoder, model_pose(pose, turn), side) for pose in subject.cameras
    ]
    quality = [(psnr(a, b), ssim(a, b)) for a, b in zip(rendered, pictures, strict=True)]
    novel = quality[1:]
    values = {
        "iou": overlap(solid, subject.inside(world)),
        "psnr_input": quality[0][0],
        "ssim_input": quality[0][1],
        "psnr_novel": sum(p for p, _ in novel) / len(novel),
        "ssim_novel": sum(s for _, s in novel) / len(novel),
    }
    strip = torch.cat([pictures[0], rendered[0], pictures[1], rendered[1]], dim=1)
    return Score(subject.name, values, strip)


def score_all(
    model: LRM, folder: Path, *, objects: int, announce: Callable[[str], None]
) -> dict[str, dict[str, float]]:
    """Score held-out objects and demo scenes; write scores.json and PNG sheets.

    Args:
        model: The model.
        folder: Output folder.
        objects: Number of held-out objects.
        announce: Receives the lines of the table.

    Returns:
        Mean scores of the objects, and those of each demo scene, by name.
    """
    found = [score(model, subject) for subject in held_out(objects)]
    scenes = [score(model, subject) for subject in demo_subjects()]
    means = {key: sum(s.values[key] for s in found) / len(found) for key in found[0].values}
    table = {f"{objects} held-out objects": means, **{s.name: s.values for s in scenes}}
    announce(f"{'':28}" + "".join(f"{key:>12}" for key in means))
    for name, values in table.items():
        announce(f"{name:28}" + "".join(f"{value:12.3f}" for value in values.values()))
    write_json(
        folder / "scores.json", {"mean": table, "objects": {s.name: s.values for s in found}}
    )
    by_overlap = sorted(found, key=lambda s: s.values["iou"])
    for name, shown in (
        ("objects", found[:16]),
        ("demo", scenes),
        ("failures", by_overlap[:6]),
    ):
        _write_sheet(folder / f"{name}.png", [s.strip for s in shown])
    return table


def _write_sheet(path: Path, strips: list[Tensor]) -> None:
    """Write strips of images as a PNG sheet of two columns."""
    rows = [torch.cat(strips[i : i + 2], dim=1) for i in range(0, len(strips), 2)]
    width = max(row.shape[1] for row in rows)
    filled = [torch.nn.functional.pad(r, (0, 0, 0, width - r.shape[1]), value=1.0) for r in rows]
    pixels = (torch.cat(filled).clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    with replacing(path) as temporary:
        Image.fromarray(pixels).save(temporary, format="PNG")
