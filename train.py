"""Reconstruct a dynamic scene: `python train.py key=value ...`, the same as `xplanes train`."""

import sys

from xplanes.cli import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
