"""Procedural dynamic scenes, rendered by exact ray casting."""

from xplanes.synthetic.demo.assembly import Assembly, Joint, Part
from xplanes.synthetic.demo.posed import Hits, Posed, PosedPart
from xplanes.synthetic.demo.scenes import DEMO_SCENES, build_demo_scene
from xplanes.synthetic.demo.write import ensure_demo_scene

__all__ = [
    "DEMO_SCENES",
    "Assembly",
    "Hits",
    "Joint",
    "Part",
    "Posed",
    "PosedPart",
    "build_demo_scene",
    "ensure_demo_scene",
]
