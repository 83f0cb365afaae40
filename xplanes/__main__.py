"""`python -m xplanes`: everything after training."""

import os
import sys

from xplanes.threads import waiting

os.environ.update(waiting(os.environ))  # before torch is loaded

from xplanes.cli import main

sys.exit(main())
