"""A suite of procedural scenes for tuning and testing settings.

Each kind has two scenes with different shapes, motions, colours and cameras: ``KIND`` for tuning
and ``KIND_test`` for testing.
"""

import difflib
from collections.abc import Callable
from dataclasses import dataclass, field

from xplanes.errors import SceneError
from xplanes.synthetic.demo import scenes
from xplanes.synthetic.demo.assembly import Assembly
from xplanes.synthetic.demo.capture import Array, Phone, Rig
from xplanes.synthetic.demo.motions import Variation
from xplanes.synthetic.demo.render import CAMERA_DISTANCE
from xplanes.synthetic.demo.suite import captures, materials, motions, places, shapes
from xplanes.synthetic.demo.world import World

__all__ = ["KINDS", "SUITE_SCENES", "SuiteScene", "suite_scene"]


@dataclass(frozen=True)
class SuiteScene:
    """A scene of the suite.

    Attributes:
        build: Builds the assembly with the colours of a variation.
        rig: Cameras and times.
        world: Builds the surroundings with the colours of a variation, for opaque images; None for
            images of the assembly alone, with alpha.
    """

    build: Callable[[Variation], Assembly]
    rig: Rig = field(default_factory=Rig)
    world: Callable[[Assembly, Variation], World] | None = None


SUITE_SCENES: dict[str, SuiteScene] = {
    "white_floor": SuiteScene(
        materials.white_floor, Rig(distance=10.4, elevations=(22.0, 44.0), fixed=12)
    ),
    "white_floor_test": SuiteScene(
        materials.white_floor_test, Rig(distance=10.5, elevations=(27.0, 50.0), fixed=12)
    ),
    "dark": SuiteScene(materials.dark),
    "dark_test": SuiteScene(materials.dark_test),
    "wires": SuiteScene(materials.wires),
    "wires_test": SuiteScene(materials.wires_test),
    "fast_motion": SuiteScene(motions.fast_motion),
    "fast_motion_test": SuiteScene(motions.fast_motion_test),
    "deformation": SuiteScene(shapes.deformation),
    "deformation_test": SuiteScene(shapes.deformation_test),
    "topology": SuiteScene(shapes.topology),
    "topology_test": SuiteScene(shapes.topology_test),
    "scaling": SuiteScene(shapes.scaling),
    "scaling_test": SuiteScene(shapes.scaling_test),
    "occlusion": SuiteScene(motions.occlusion),
    "occlusion_test": SuiteScene(motions.occlusion_test),
    "texture": SuiteScene(materials.texture),
    "texture_test": SuiteScene(materials.texture_test),
    "off_centre": SuiteScene(places.off_centre, Rig(target=places.AWAY)),
    "off_centre_test": SuiteScene(places.off_centre_test, Rig(target=places.AWAY_TEST)),
    "scale": SuiteScene(places.scale, Rig(distance=places.LARGE * CAMERA_DISTANCE)),
    "scale_test": SuiteScene(places.scale_test, Rig(distance=places.SMALL * CAMERA_DISTANCE)),
    "transparent": SuiteScene(materials.transparent),
    "transparent_test": SuiteScene(materials.transparent_test),
    "fixed_cameras": SuiteScene(places.fixed_cameras, Rig(elevations=(8.0, 40.0), fixed=6)),
    "fixed_cameras_test": SuiteScene(
        places.fixed_cameras_test, Rig(distance=4.4, elevations=(12.0, 50.0), fixed=6)
    ),
    "half_circle": SuiteScene(
        places.half_circle, Rig(azimuths=(-180.0, 0.0), elevations=(0.0, 45.0))
    ),
    "half_circle_test": SuiteScene(
        places.half_circle_test, Rig(azimuths=(-90.0, 90.0), elevations=(2.0, 50.0))
    ),
    "short_times": SuiteScene(motions.short_times, Rig(end=0.6)),
    "short_times_test": SuiteScene(motions.short_times_test, Rig(distance=4.3, end=0.4)),
    "static": SuiteScene(shapes.static),
    "static_test": SuiteScene(shapes.static_test),
    "phone": SuiteScene(
        scenes.walker, Phone(azimuths=(-160.0, -20.0), elevations=(8.0, 24.0)), captures.park
    ),
    "phone_test": SuiteScene(
        scenes.excavator,
        Phone(distance=4.3, azimuths=(-30.0, -150.0), elevations=(10.0, 30.0)),
        captures.desert,
    ),
    "rig": SuiteScene(
        scenes.balls, Array(azimuths=(-150.0, -30.0), elevations=(8.0, 26.0)), captures.hall
    ),
    "rig_test": SuiteScene(
        scenes.windmill,
        Array(distance=4.3, azimuths=(-145.0, -35.0), elevations=(6.0, 24.0)),
        captures.square,
    ),
}
"""Scenes by name; the test scene of a kind follows its tuning scene."""

KINDS = tuple(name for name in SUITE_SCENES if not name.endswith("_test"))
"""Names of the kinds, which are the names of the tuning scenes."""


def suite_scene(name: str) -> SuiteScene:
    """The scene called ``name``.

    Raises:
        SceneError: If no scene has that name; the message lists all names.
    """
    if name in SUITE_SCENES:
        return SUITE_SCENES[name]
    close = difflib.get_close_matches(name, SUITE_SCENES, n=1)
    hint = f" Did you mean {close[0]!r}?" if close else ""
    raise SceneError(f"no scene {name!r} in the suite; there are {', '.join(SUITE_SCENES)}.{hint}")
