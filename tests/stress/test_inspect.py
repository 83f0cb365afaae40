"""Every procedural scene, inspected: white on white is the only thing wrong with any of them."""

from pathlib import Path

import pytest

from xplanes.evaluation.inspect import choose, inspect
from xplanes.synthetic.demo.scenes import DEMO_SCENES
from xplanes.synthetic.demo.suite import SUITE_SCENES

pytestmark = pytest.mark.stress

SCENES = [
    *(("demo", name) for name in DEMO_SCENES),
    *(("suite", name) for name in SUITE_SCENES),
]


@pytest.mark.parametrize(("data", "name"), SCENES)
def test_procedural_scenes_are_in_order(data: str, name: str, tmp_path: Path) -> None:
    # Wires are fainter than silhouettes in smaller images, of which `stray` tells.
    small = ["data.resolution=64", "data.train_views=16", "data.val_views=4", "data.test_views=4"]
    scene = [f"data={data}", f"data.root={tmp_path}", f"data.scene={name}"]
    kinds = [each.kind for each in inspect(choose([*scene, *small])).findings]
    assert kinds == (["white"] if name.startswith("white_floor") else [])
