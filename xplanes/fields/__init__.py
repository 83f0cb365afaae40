"""Planes and decoder: from positions and times to colour and density."""

from xplanes.fields.decoder import Decoder
from xplanes.fields.xplanes import XPlanes

__all__ = ["Decoder", "XPlanes"]
