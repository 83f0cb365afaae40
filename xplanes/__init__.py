"""Dynamic radiance fields initialised from Large Reconstruction Models."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from xplanes.scenes.datamodule import SceneDataModule
    from xplanes.training.module import RadianceModule

__version__ = "0.3.0"
__all__ = ["RadianceModule", "SceneDataModule"]


def __getattr__(name: str) -> Any:
    """Import heavy modules on first use."""
    if name == "SceneDataModule":
        from xplanes.scenes.datamodule import SceneDataModule

        return SceneDataModule
    if name == "RadianceModule":
        from xplanes.training.module import RadianceModule

        return RadianceModule
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
