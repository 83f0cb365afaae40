"""Large Reconstruction Models: from one image to a triplane."""

from xplanes.lrm.checkpoint import load
from xplanes.lrm.config import LRMConfig
from xplanes.lrm.errors import LRMError
from xplanes.lrm.model import LRM

__all__ = ["LRM", "LRMConfig", "LRMError", "load"]
