"""Scores on a few held-out objects during training."""

import torch
from torch import Tensor

from xplanes.lrm import LRM
from xplanes.lrm.canonical import canonical_vector
from xplanes.lrm.openlrm import OpenLRM
from xplanes.metrics import psnr
from xplanes.synthetic.demo.render import CAMERA_DISTANCE
from xplanes.synthetic.pretraining.losses import triplane_logits
from xplanes.synthetic.pretraining.pool import Pool
from xplanes.synthetic.pretraining.render import render_view


class QuickLook:
    """Scores of the first objects of a held-out pool, reconstructed from their first view.

    Args:
        pool: The objects, on the model's device.
        count: Number of objects.
    """

    def __init__(self, pool: Pool, count: int) -> None:
        self.pool, self.count = pool, count

    @torch.no_grad()
    def scores(self, model: OpenLRM) -> dict[str, float]:
        """IoU at the stored points, and PSNR (dB) of the input view and of the second view."""
        found: dict[str, list[float]] = {"iou": [], "psnr_input": [], "psnr_novel": []}
        camera = canonical_vector(model.view)[None].to(self.pool.device)
        for number in range(self.count):
            records = self.pool.records(torch.tensor([number]))
            record = {name: values[0] for name, values in records.items()}
            pictures = record["pictures"][..., :3].float() / 255
            planes = model.triplanes(pictures[:1].permute(0, 3, 1, 2), camera)
            turn = world_to_model(record["poses"][0], model)
            points = record["points"].float() @ turn.T
            solid = triplane_logits(planes, model.decoder, points[None])[0, :, 0] > 1
            found["iou"].append(overlap(solid, record["inside"] > 0))
            for name, view in (("psnr_input", 0), ("psnr_novel", 1)):
                pose = model_pose(record["poses"][view], turn)
                rendered = render_view(planes, model.decoder, pose, pictures.shape[1])
                found[name].append(psnr(rendered, pictures[view]))
        return {name: sum(values) / len(values) for name, values in found.items()}


def world_to_model(source: Tensor, model: LRM) -> Tensor:
    """Scale and rotation from world to model frame, for a source camera. [4, 4] -> [3, 3]"""
    scale = model.view.distance / CAMERA_DISTANCE
    turn = scale * model.view.rotation_matrix().to(source.device)
    return (turn @ source[:3, :3].T.double()).float()


def model_pose(pose: Tensor, turn: Tensor) -> Tensor:
    """Camera pose in the model's frame. [4, 4], [3, 3] -> [4, 4]"""
    scale = turn.norm(dim=0).mean()
    moved = pose.clone().float()
    moved[:3, :3] = turn / scale @ moved[:3, :3]
    moved[:3, 3] = turn @ moved[:3, 3]
    return moved


def overlap(found: Tensor, truth: Tensor) -> float:
    """Intersection over union; 1 if both are empty. bool [N], bool [N]"""
    union = int((found | truth).sum())
    return int((found & truth).sum()) / union if union else 1.0
