"""From a scene or a file to the initialisation of a field, in cached stages."""

from xplanes.preparation.sequence import TriplaneSequence, load_triplanes, save_triplanes

__all__ = ["TriplaneSequence", "load_triplanes", "save_triplanes"]
