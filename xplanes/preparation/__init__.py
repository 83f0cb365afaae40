"""What happens before training: from a triplane sequence to a field that has begun."""

from xplanes.preparation.cache import StageCache
from xplanes.preparation.sequence import TriplaneSequence, load_triplanes, save_triplanes
from xplanes.preparation.start import Start, find_source, prepare

__all__ = [
    "StageCache",
    "Start",
    "TriplaneSequence",
    "find_source",
    "load_triplanes",
    "prepare",
    "save_triplanes",
]
