"""A published LRM at full size, with random weights: seconds and memory to load and encode.

    python benchmarks/lrm_sizes.py write|load NAME FILE

Writes a checkpoint under its published names, or loads it strictly and encodes one image. Prints
JSON in its last line; each in a process of its own, so that memory is that of one model.
"""

import os

from xplanes.process import defaults

os.environ.update(defaults(os.environ))

import argparse
import json
import resource
import time
from pathlib import Path

import torch
from safetensors.torch import save_file

from xplanes.lrm.checkpoint import build, load
from xplanes.lrm.config import PUBLISHED, parse_config, published_config
from xplanes.synthetic.pretraining.run import published_state


def write(name: str, path: Path) -> dict[str, object]:
    """Write a checkpoint of the model's published tensors."""
    model = build(parse_config(published_config(name)))
    shapes = {key: value.shape for key, value in published_state(model).items()}  # type: ignore[arg-type]
    generator = torch.Generator().manual_seed(0)
    save_file(
        {key: 0.02 * torch.randn(shape, generator=generator) for key, shape in shapes.items()}, path
    )
    parameters = sum(parameter.numel() for parameter in model.parameters())
    return {"parameters": parameters, "file": path.stat().st_size}


@torch.no_grad()
def try_out(name: str, path: Path) -> dict[str, object]:
    """Load a checkpoint and encode one image."""
    began = time.perf_counter()
    model = load({"architecture": name}, path)
    loaded = time.perf_counter()
    picture = torch.rand(1, 4, 512, 512, generator=torch.Generator().manual_seed(1))
    planes = model.encode(model.prepare(picture))
    done = time.perf_counter()
    if not planes.isfinite().all():
        raise FloatingPointError(f"{name}: the triplane is not finite")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return {
        "load": loaded - began,
        "encode": done - loaded,
        "shape": list(planes.shape[1:]),
        "peak": peak,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("what", choices=("write", "load"))
    parser.add_argument("name", choices=list(PUBLISHED))
    parser.add_argument("file", type=Path)
    args = parser.parse_args()
    print(json.dumps((write if args.what == "write" else try_out)(args.name, args.file)))


if __name__ == "__main__":
    main()
