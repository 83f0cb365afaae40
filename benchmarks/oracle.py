"""The oracle of an LRM: triplanes fitted to true views of each timestep, its decoder frozen.

    python benchmarks/oracle.py SCENE FILE [--lrm tiny] [--views 24] [--resolution 100]
        [--first-steps 400] [--steps 120]

Writes a file for ``lrm=file lrm.triplanes=FILE``: what an LRM with this decoder could predict at
best. SCENE is a demo scene. The triplane of the first timestep begins at the LRM's, each further
one at the one before, so that features change no more than the scene does.
"""

import argparse
import random
import tempfile
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from xplanes.fields.xplanes import XPlanes
from xplanes.models.initialisation import Method, Place
from xplanes.models.x_planes import XPlanesSettings
from xplanes.preparation.cache import StageCache
from xplanes.preparation.reconstruct import reconstruct
from xplanes.preparation.sequence import TriplaneSequence, save_triplanes
from xplanes.preparation.sources import BundledLRMSettings, from_sequence
from xplanes.scenes.cameras import focal_length
from xplanes.scenes.datamodule import SceneDataModule
from xplanes.scenes.views import Scene, Views
from xplanes.synthetic.demo.render import CAMERA_ANGLE_X, hemisphere_cameras, render_image
from xplanes.synthetic.demo.scenes import build_demo_scene
from xplanes.training.fit import fit_quietly
from xplanes.training.module import RadianceModule


def true_views(name: str, time: float, cameras: Tensor, side: int) -> Views:
    """Images of a demo scene at one timestep, all at time 0: a static scene."""
    posed = build_demo_scene(name).pose(time)
    images = torch.stack([torch.from_numpy(render_image(posed, c, side)) for c in cameras])
    alpha = images[..., 3:].float() / 255
    images[..., :3] = (images[..., :3] * alpha).round().to(torch.uint8)
    return Views(
        images,
        cameras.float(),
        torch.zeros(len(cameras)),
        focal_length(CAMERA_ANGLE_X, side),  # type: ignore[arg-type]
        tuple(f"{number}.png" for number in range(len(cameras))),
    )


def fitted(
    start: TriplaneSequence, views: Views, method: Method, steps: int, folder: Path
) -> TriplaneSequence:
    """A single triplane after training on the views of its timestep."""
    scene = Scene("oracle", {"train": views, "val": views.subset(torch.tensor([0]))})
    device = torch.device("cpu")
    assert start.frame is not None
    place = Place(scene, start.frame, device)
    found = from_sequence(start, method, place, StageCache(None), source="the oracle", seconds={})
    module = RadianceModule(method)
    module.build(scene, start.frame, initialisation=found)
    fit_quietly(module, scene, folder, device=device, max_steps=steps, max_seconds=None)
    assert isinstance(module.field, XPlanes)
    planes = torch.stack(list(module.field.planes.values())).detach()
    print(
        f"PSNR of the last batch {module.tally.last.get('psnr', float('nan')):.2f} dB", flush=True
    )
    return replace(start, triplanes=planes[None].cpu())


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("scene")
    parser.add_argument("file", type=Path)
    parser.add_argument("--lrm", default="tiny")
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--resolution", type=int, default=100)
    parser.add_argument("--first-steps", type=int, default=400)
    parser.add_argument("--steps", type=int, default=120)
    args = parser.parse_args()
    module = RadianceModule.compose(
        f"lrm={args.lrm}", "model.decoder.freeze=true", "model.fine=null", "preparation.cache=null"
    )
    method = module.method
    assert isinstance(method.lrm, BundledLRMSettings)
    assert isinstance(method.model, XPlanesSettings)
    data = SceneDataModule.compose(f"data.scene={args.scene}", f"data.resolution={args.resolution}")
    data.setup("fit")
    scene = data.scene
    place = Place(scene, method.model.frame(scene.splits["train"]), torch.device("cpu"))
    made = reconstruct(method, method.lrm, place, method.lrm.load_model(print), StageCache(None))
    own, found = made.sequence, []
    cameras = hemisphere_cameras(args.views, random.Random("oracle"))
    latest = replace(own, triplanes=own.triplanes[:1])
    with tempfile.TemporaryDirectory() as folder:
        for number, time in enumerate(torch.linspace(0, 1, len(own.triplanes)).tolist()):
            views = true_views(args.scene, time, cameras, args.resolution)
            steps = args.steps if found else args.first_steps
            latest = fitted(latest, views, method, steps, Path(folder) / f"{number}")
            found.append(latest.triplanes)
    save_triplanes(args.file, replace(own, triplanes=torch.cat(found)))


if __name__ == "__main__":
    main()
