"""Every published LRM at full size, with random weights: seconds and memory to load and encode.

    python benchmarks/lrm_sizes.py

Writes results/lrm_sizes.md beside this file. Each model is written as a checkpoint under its
published names, then loaded strictly and shown one picture, in a process of its own.
"""

import os

from xplanes.process import defaults

os.environ.update(defaults(os.environ))

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch
from runner import RESULTS, command, machine, markdown
from safetensors.torch import save_file

from xplanes.files import write_text
from xplanes.lrm.checkpoint import build, load
from xplanes.lrm.config import PUBLISHED, parse_config, published_config
from xplanes.synthetic.pretraining.run import published_state

COLUMNS = (
    "model",
    "parameters",
    "file, GB",
    "load s",
    "encode s",
    "triplane",
    "peak GB",
)


def write_random(name: str, path: Path) -> int:
    """A checkpoint of the model's published tensors; returns how many parameters it has."""
    model = build(parse_config(published_config(name)))
    shapes = {key: value.shape for key, value in published_state(model).items()}  # type: ignore[arg-type]
    generator = torch.Generator().manual_seed(0)
    save_file(
        {key: 0.02 * torch.randn(shape, generator=generator) for key, shape in shapes.items()}, path
    )
    return sum(parameter.numel() for parameter in model.parameters())


@torch.no_grad()
def try_out(name: str, path: Path) -> dict[str, object]:
    """Load a checkpoint and show it one picture."""
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
    if len(sys.argv) == 3:
        print(json.dumps(try_out(sys.argv[1], Path(sys.argv[2]))))
        return
    argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0]).parse_args()
    rows = []
    for name in PUBLISHED:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "model.safetensors"
            count = write_random(name, path)
            size = path.stat().st_size
            child = [sys.executable, __file__, name, str(path)]
            told = subprocess.run(child, check=True, capture_output=True, text=True).stdout
        found = json.loads(told)
        rows.append(
            (
                name,
                f"{count / 1e6:.0f} M",
                f"{size / 1e9:.2f}",
                f"{found['load']:.1f}",
                f"{found['encode']:.1f}",
                " x ".join(map(str, found["shape"])),
                f"{found['peak'] / 1e9:.1f}",
            )
        )
        print(*rows[-1], flush=True)
    page = f"""# Published LRMs at full size

Random weights in float32, saved as safetensors without unused tensors
(OpenLRM 1.0 and TripoSR are published as pickles), one image of 512 pixels;
{machine()}. The file is memory-mapped, so part of it
is read while the image is encoded. `{command()}`

{markdown(COLUMNS, rows)}
"""
    write_text(RESULTS / "lrm_sizes.md", page)


if __name__ == "__main__":
    main()
