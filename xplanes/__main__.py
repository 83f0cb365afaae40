"""`python -m xplanes`, the same as `xplanes`."""

import sys

from xplanes.cli import main

sys.exit(main())
