"""Planes of every size, and errors as shares of the largest expected value."""

import numpy as np
import torch


def spread(shape, value, generator):
    """Random planes of a size; "mixed" holds zeros and 1e-30 to 1e15 of both signs at once."""
    planes = torch.randn(shape, generator=generator, dtype=torch.float64)
    if value == "mixed":
        exponents = torch.randint(-30, 16, shape, generator=generator).double()
        return planes.sign() * 10.0**exponents * (planes.abs() > 0.1)
    return planes * value


def worst(ours, theirs, least=1e-12):
    """Largest difference, as a share of the largest expected value."""
    ours, theirs = np.asarray(ours, np.float64), np.asarray(theirs, np.float64)
    if not theirs.size:
        return 0.0
    return float(np.abs(ours - theirs).max() / max(np.abs(theirs).max(), least))
