"""Articulated assemblies: parts on a tree of moving joints."""

import math
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import normalize

from xplanes.synthetic.demo.geometry import Primitive, Surface
from xplanes.synthetic.demo.motions import Motion, Steady
from xplanes.synthetic.demo.posed import Posed, PosedPart
from xplanes.synthetic.demo.shading import Light

Vector = tuple[float, float, float]
Kind = Literal["fixed", "hinge", "slide", "scale"]

WORLD = "world"
"""The root of every tree of joints."""


@dataclass(frozen=True)
class Joint:
    """A frame that moves relative to its parent frame.

    Attributes:
        name: Name by which parts and other joints refer to it.
        parent: Joint that carries it; must come earlier in the assembly.
        position: Its origin in the parent's frame.
        rotation: Angles about the parent's x, y and z, applied in this order, in degrees.
        kind: A hinge rotates about ``axis`` (degrees), a slide translates along it (world units), a
            scale multiplies the size of everything that the joint carries.
        axis: Axis in the joint's own frame; any length.
        motion: State of the joint over time; required unless it is fixed.
    """

    name: str
    parent: str = WORLD
    position: Vector = (0.0, 0.0, 0.0)
    rotation: Vector = (0.0, 0.0, 0.0)
    kind: Kind = "fixed"
    axis: Vector = (0.0, 0.0, 1.0)
    motion: Motion | None = None


@dataclass(frozen=True)
class Part:
    """A shape with a surface, attached to a joint (position and angles as for a joint)."""

    shape: Primitive
    surface: Surface
    joint: str = WORLD
    position: Vector = (0.0, 0.0, 0.0)
    rotation: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Assembly:
    """Parts carried by a tree of joints.

    Attributes:
        parts: The parts; each names the joint that carries it.
        joints: The joints, parents before children.
        light: Light of the scene; None for unlit colours.
    """

    parts: tuple[Part, ...]
    joints: tuple[Joint, ...] = ()
    light: Light | None = field(default_factory=Light)

    def __post_init__(self) -> None:
        known = {WORLD}
        for joint in self.joints:
            _require(joint.parent, known, f"parent of joint {joint.name!r}")
            if joint.name in known:
                raise ValueError(f"two joints are named {joint.name!r}; names must be unique")
            if (joint.motion is None) != (joint.kind == "fixed"):
                raise ValueError(
                    f"joint {joint.name!r}: hinges and slides need a motion, fixed joints have none"
                )
            known.add(joint.name)
        for part in self.parts:
            _require(part.joint, known, f"joint of a part ({part.shape})")

    def placed(
        self, position: Vector, rotation: Vector = (0.0, 0.0, 0.0), scale: float = 1.0
    ) -> "Assembly":
        """The whole assembly, moved and scaled (position and angles as for a joint)."""
        site = Joint("site", WORLD, position, rotation)
        if scale != 1:
            site = replace(site, kind="scale", motion=Steady(scale, 0.0))
        joints = [replace(j, parent="site") if j.parent == WORLD else j for j in self.joints]
        parts = [replace(p, joint="site") if p.joint == WORLD else p for p in self.parts]
        return Assembly(tuple(parts), (site, *joints), self.light)

    def pose(self, time: float, dtype: torch.dtype = torch.float32) -> Posed:
        """The assembly at ``time`` in [0, 1], with poses in ``dtype``."""
        frames = {WORLD: torch.eye(4, dtype=torch.float64)}
        scales = {WORLD: 1.0}
        for joint in self.joints:
            scale = scales[joint.parent]
            frame = frames[joint.parent] @ _frame(joint.position, joint.rotation, scale)
            if joint.kind == "scale" and joint.motion is not None:
                scale *= joint.motion.at(time)
            elif joint.motion is not None:
                frame = frame @ _moved(joint, joint.motion.at(time), scale)
            frames[joint.name], scales[joint.name] = frame, scale
        posed = []
        for part in self.parts:
            scale = scales[part.joint]
            frame = (frames[part.joint] @ _frame(part.position, part.rotation, scale)).to(dtype)
            shape, surface = part.shape.at(time), part.surface.at(time)
            posed.append(PosedPart(shape, surface, frame[:3, :3], frame[:3, 3], scale))
        return Posed(tuple(posed), self.light)


def _require(name: str, known: set[str], role: str) -> None:
    if name not in known:
        raise ValueError(f"{role}: no joint {name!r} before it; known are {sorted(known)}")


def _frame(position: Vector, rotation: Vector, scale: float = 1.0) -> Tensor:
    """A rigid frame from a scaled position and angles about x, y and z in degrees. [4, 4]"""
    frame = torch.eye(4, dtype=torch.float64)
    for axis, angle in zip(torch.eye(3, dtype=torch.float64), rotation, strict=True):
        if angle:
            frame[:3, :3] = _turn(axis, angle) @ frame[:3, :3]
    frame[:3, 3] = scale * torch.tensor(position, dtype=torch.float64)
    return frame


def _moved(joint: Joint, state: float, scale: float) -> Tensor:
    """Movement of a hinge or slide in its own frame. [4, 4]"""
    axis = normalize(torch.tensor(joint.axis, dtype=torch.float64), dim=0)
    frame = torch.eye(4, dtype=torch.float64)
    if joint.kind == "hinge":
        frame[:3, :3] = _turn(axis, state)
    else:
        frame[:3, 3] = axis * state * scale
    return frame


def _turn(axis: Tensor, degrees: float) -> Tensor:
    """Rotation about a unit axis, by Rodrigues' formula. [3, 3]"""
    angle = math.radians(degrees)
    x, y, z = axis.tolist()
    cross = axis.new_tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    eye = torch.eye(3, dtype=axis.dtype)
    return eye + math.sin(angle) * cross + (1 - math.cos(angle)) * (cross @ cross)
