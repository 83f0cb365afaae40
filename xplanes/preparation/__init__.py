"""From a scene or a file to what a field is initialised with, in stages that are kept."""

from xplanes.preparation.sequence import TriplaneSequence, load_triplanes, save_triplanes

__all__ = ["TriplaneSequence", "load_triplanes", "save_triplanes"]
