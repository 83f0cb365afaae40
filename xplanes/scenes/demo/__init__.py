"""Procedural scenes that move, rendered exactly by ray casting."""

from xplanes.scenes.demo.assembly import Assembly, Joint, Part
from xplanes.scenes.demo.posed import Hits, Posed, PosedPart
from xplanes.scenes.demo.scenes import DEMO_SCENES, build_demo_scene
from xplanes.scenes.demo.write import ensure_demo_scene

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
