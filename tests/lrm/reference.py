"""Reference outputs of the published code at reduced size, and readers for them."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

from xplanes.lrm import load

FOLDER = Path(__file__).parents[1] / "data" / "lrm"

VERSIONS = {"1.0": "openlrm_1.0_tiny", "1.1": "openlrm_1.1_tiny"}

WEIGHTS = {
    "openlrm_1.0_tiny": "model.pth",
    "openlrm_1.1_tiny": "model.safetensors",
    "triposr_tiny": "model.ckpt",
}
"""The weights in the form in which each model is published."""


@cache
def arrays(name):
    """Arrays of one .npz file as tensors."""
    with np.load(FOLDER / name) as content:
        return {key: torch.as_tensor(content[key]) for key in content.files}


def config(folder):
    return json.loads((FOLDER / folder / "config.json").read_text())


def load_reduced(folder):
    """The model whose weights were recorded in a folder."""
    return load(config(folder), FOLDER / folder / WEIGHTS[folder])


def compare(found, expected, rtol=1e-4, atol=1e-4, case=""):
    torch.testing.assert_close(
        found,
        expected.to(found.dtype),
        rtol=rtol,
        atol=atol,
        msg=lambda words: f"{case}: {words}" if case else words,
    )


def sample(plane, columns, rows):
    """One plane [C, H, W] at coordinates from -1 to 1. [N], [N] -> [N, C]"""
    grid = torch.stack([columns, rows], dim=-1)[None, None]
    return F.grid_sample(plane[None], grid, align_corners=False)[0, :, 0].T


def own_features(planes, points, axes):
    """Features of planes in a model's own layout. [3, C, H, W], [N, 3] -> [N, 3 C]"""
    parts = [sample(p, points[:, a], points[:, b]) for p, (a, b) in zip(planes, axes, strict=True)]
    return torch.cat(parts, dim=1)


OPENLRM_AXES = ((0, 1), (0, 2), (2, 1))
TRIPOSR_AXES = ((0, 1), (0, 2), (1, 2))
