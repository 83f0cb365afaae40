"""First calls of the inner loops are told apart from what they are part of."""

import time

import torch

from xplanes.backend import warm_up
from xplanes.rendering import warming
from xplanes.rendering.grid_renderer import DIAGONAL, GridRenderer
from xplanes.rendering.occupancy import OccupancyGrid


def test_the_first_ray_asks_the_field_and_is_counted(monkeypatch, capsys):
    asked = []

    def field(points, times):
        asked.append(points)
        time.sleep(0.05)
        return torch.rand(len(points), 3), torch.rand(len(points))

    monkeypatch.setattr(warming, "PATIENCE", 0.02)
    warming.say_why.cache_clear()
    before = warm_up.seconds
    for _ in range(2):
        warming.render_one_ray(field, GridRenderer(OccupancyGrid(4, 1, step=DIAGONAL / 8), 8))
    assert sum(map(len, asked)) > 0
    assert warm_up.seconds - before >= 0.1
    assert capsys.readouterr().out.count("loading the inner loops") == 1
