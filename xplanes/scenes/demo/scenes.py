"""The demo scenes by name."""

import difflib
from collections.abc import Callable
from dataclasses import dataclass

from xplanes.scenes.demo.assembly import Assembly
from xplanes.scenes.demo.balls import balls
from xplanes.scenes.demo.excavator import excavator
from xplanes.scenes.demo.still import still
from xplanes.scenes.demo.variation import Variation
from xplanes.scenes.demo.walker import walker
from xplanes.scenes.demo.windmill import windmill
from xplanes.scenes.errors import SceneError


@dataclass(frozen=True)
class DemoScene:
    """A scene and where its fixed camera stands.

    Attributes:
        build: Makes the scene in the colours of a variation.
        azimuth: Direction of the fixed camera in degrees, from +x towards +y. The camera stands
            level, on an axis of the world along which the scene is built.
    """

    build: Callable[[Variation], Assembly]
    azimuth: float = -90.0


DEMO_SCENES: dict[str, DemoScene] = {
    "excavator": DemoScene(excavator),
    "walker": DemoScene(walker),
    "balls": DemoScene(balls),
    "windmill": DemoScene(windmill, azimuth=0.0),
    "still": DemoScene(still),
}


def demo_scene(name: str) -> DemoScene:
    """The scene called ``name``.

    Raises:
        SceneError: No scene has that name; the message lists those there are.
    """
    if name in DEMO_SCENES:
        return DEMO_SCENES[name]
    close = difflib.get_close_matches(name, DEMO_SCENES, n=1)
    hint = f" Did you mean {close[0]!r}?" if close else ""
    raise SceneError(
        f"no demo scene {name!r}; there are {', '.join(DEMO_SCENES)}.{hint} Scenes on disk need "
        "data=dnerf."
    )


def build_demo_scene(name: str, seed: int = 0) -> Assembly:
    """The assembly of a named scene, with the colours and phases of ``seed``."""
    return demo_scene(name).build(Variation(name, seed))
