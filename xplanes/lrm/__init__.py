"""Large Reconstruction Models: from one image to a triplane."""

from xplanes.errors import LRMError
from xplanes.lrm.checkpoint import load
from xplanes.lrm.config import LRMConfig
from xplanes.lrm.model import LRM

__all__ = ["LRM", "LRMConfig", "LRMError", "load"]
