"""Lenses at their extremes: rays of distorted images against a search in plain Python."""

import math

import numpy as np
import pytest
import torch

from tests.lens_oracle import direction, distort
from xplanes.scenes.cameras import cast_rays, project
from xplanes.scenes.lenses import COEFFICIENTS, Lenses, LensModel

pytestmark = pytest.mark.stress

FOCAL, SIDE = (500.0, 480.0), 1000
EYE = torch.eye(4, dtype=torch.float64)


def lens(model, k):
    known = {"k1": k["omega"]} if model == "fov" else k
    row = [known.get(name, 0.0) for name in COEFFICIENTS]
    return Lenses(
        torch.tensor([LensModel[model.upper()]]),
        torch.tensor([row], dtype=torch.float64),
        torch.zeros(1),
    )


def cast(lenses, rows, columns, focal=FOCAL):
    return cast_rays(
        EYE,
        rows,
        columns,
        focal=torch.tensor(focal, dtype=torch.float64),
        centre=torch.tensor([SIDE / 2, SIDE / 2], dtype=torch.float64),
        lenses=lenses,
    )[1]


EXTREMES = {
    "strong barrel": ("perspective", {"k1": -0.07}),
    "strong pincushion": ("perspective", {"k1": 2.0, "k2": 5.0, "k3": 20.0}),
    "moustache": ("perspective", {"k1": -0.3, "k2": 0.25, "k3": -0.02}),
    "rational": ("perspective", {"k1": 8.0, "k2": 3.0, "k3": 0.2, "k4": 8.2, "k5": 5.0, "k6": 0.8}),
    "decentred": ("perspective", {"k1": 0.1, "p1": 0.06, "p2": -0.06}),
    "prism": ("perspective", {"s1": 0.05, "s2": 0.005, "s3": -0.05, "s4": -0.005}),
    "fisheye": ("fisheye", {"k1": 0.4, "k2": 0.3, "k3": 0.2, "k4": 0.1}),
    "shrinking fisheye": ("fisheye", {"k1": -0.03, "k2": -0.002}),
    "thin prism fisheye": ("fisheye", {"k1": 0.1, "p1": 0.03, "p2": 0.03, "s1": 0.03, "s3": -0.03}),
    "nearly a pinhole": ("fov", {"omega": 1e-7}),
    "nearly a sphere": ("fov", {"omega": 1.05}),
}


@pytest.mark.parametrize("name", EXTREMES)
def test_extreme_lenses(tally, name):
    """Lenses: rays through corners, edges and middles, extreme distortion, both precisions"""
    model, k = EXTREMES[name]
    places = torch.tensor([0.0, 1.0, 250.0, 499.5, 500.0, 731.25, 998.0, 999.0])
    rows, columns = (
        part.flatten().double() for part in torch.meshgrid(places, places, indexing="ij")
    )
    lenses = lens(model, k)
    x, y = (columns + 0.5 - SIDE / 2) / FOCAL[0], (rows + 0.5 - SIDE / 2) / FOCAL[1]
    _, found = lenses.directions(x, y)
    assert found.all()
    exact = cast(lenses, rows, columns)
    single = cast(lenses, rows.float(), columns.float())
    tally.finite(exact, single)
    widest = math.pi if model == "fisheye" else math.pi / 2 - 1e-3
    limit = float(lenses.limit)
    widest = min(widest, limit if model == "fisheye" else math.atan(limit))
    for index in found.nonzero()[:, 0].tolist():
        target = (float(columns[index]) + 0.5, float(rows[index]) + 0.5)
        expected = direction(model, target, k, FOCAL, (SIDE / 2, SIDE / 2), widest=widest)
        tally.error(np.abs(exact[index].numpy() - np.array(expected)).max(), 1e-8)
    tally.error(float((single - exact)[found].abs().max()), 1e-6)


def test_fisheye_lenses_up_to_the_antipole(tally):
    """Lenses: fisheye rays at angles up to 180 degrees from the axis, and back to their pixels"""
    k = {"k1": 0.01, "k2": 0.001}
    lenses = lens("fisheye", k)
    for away in (1e-12, 1e-6, 1e-3, 0.1, 1.0, 2.0, 3.0, math.pi - 1e-3, math.pi - 1e-6):
        for turn in torch.linspace(0, 2 * math.pi, 13, dtype=torch.float64).tolist():
            x, y = distort(
                "fisheye", away * math.cos(turn), away * math.sin(turn), {"k1": 0.01, "k2": 0.001}
            )
            row, column = y * FOCAL[1] + SIDE / 2 - 0.5, x * FOCAL[0] + SIDE / 2 - 0.5
            ray = cast(lenses, *torch.tensor([[row], [column]], dtype=torch.float64))
            flat = math.sin(away)
            expected = [flat * math.cos(turn), -flat * math.sin(turn), -math.cos(away)]
            tally.finite(ray)
            tally.error(np.abs(ray[0].numpy() - np.array(expected)).max(), 1e-9)
            across, down, seen = project(
                EYE,
                3 * ray,
                focal=torch.tensor(FOCAL, dtype=torch.float64),
                centre=torch.tensor([SIDE / 2, SIDE / 2], dtype=torch.float64),
                lenses=lenses,
            )
            assert seen.all()
            # Near the antipole a pixel is wider than a rounding error of the direction.
            tally.error(abs(float(across) - column - 0.5) + abs(float(down) - row - 0.5), 1e-4)


def test_no_lens_gives_rays_that_are_not_finite(tally):
    """Lenses: random coefficients, foldable or not, pixels far inside and outside of images"""
    generator = torch.Generator().manual_seed(0)
    for case in range(300):
        scale = 10 ** (6 * torch.rand(1, generator=generator).item() - 4)
        model = case % 2
        row = scale * torch.randn(1, len(COEFFICIENTS), generator=generator)
        lenses = Lenses(torch.tensor([model]), row, torch.zeros(1))
        x, y = 10 ** (8 * torch.rand(2, 200, generator=generator) - 5)
        local, found = lenses.directions(x, -y)
        tally.finite(local)
        assert float((local.norm(dim=1) - 1).abs().max()) < 1e-9
        back_x, back_y, seen = lenses.image_points(local[found])
        assert seen.all()
        error = torch.hypot(back_x - x[found], back_y + y[found]) / (1 + torch.hypot(x, y)[found])
        if len(error):
            tally.error(float(error.max()), 1e-6)
