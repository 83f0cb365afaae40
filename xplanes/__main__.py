"""`python -m xplanes`: everything after training."""

import os
import sys

# Spinning OpenMP threads waste the cores of a shared machine; must be set before torch is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from xplanes.cli import main

sys.exit(main())
