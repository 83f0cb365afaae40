"""`python -m xplanes`: everything after training."""

import os
import sys

# OpenMP threads wait a moment for more work, then sleep: those that spin on waste the cores of a
# shared machine. Must be set before torch is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "1000")

from xplanes.cli import main

sys.exit(main())
