"""Procedural dynamic scenes, rendered by exact ray casting."""

from xplanes.synthetic.demo.write import ensure_demo_scene

__all__ = ["ensure_demo_scene"]
