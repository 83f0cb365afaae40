"""Writes Gaussians at one time as a PLY file in the format of 3D Gaussian splatting."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F

from xplanes.errors import ConfigError
from xplanes.files import replacing
from xplanes.scenes.frame import Frame

if TYPE_CHECKING:
    from xplanes.baselines.gaussians.field import PosedGaussians


@torch.no_grad()
def write_gaussians(path: Path, posed: "PosedGaussians", frame: Frame) -> Path:
    """Write Gaussians in world coordinates as a PLY file for 3DGS and its viewers.

    Opacities are written as logits, scales as logarithms, colours as coefficients of spherical
    harmonics, those of degree 1 and higher channel by channel.

    Args:
        path: The file without its suffix.
        posed: The Gaussians at one time.
        frame: The field's frame.

    Returns:
        The file.

    Raises:
        ConfigError: If the frame is rotated against the world.

    Source: Kerbl et al. 2023, released code.
    """
    if not torch.equal(frame.rotation, torch.eye(3)):
        raise ConfigError(
            "--what gaussians: the field's frame is rotated against the world; train without a "
            "custom frame"
        )
    means, harmonics = frame.to_world(posed.means.cpu()), posed.harmonics
    columns = {
        "x y z": means,
        "nx ny nz": torch.zeros_like(means),
        "f_dc_0 f_dc_1 f_dc_2": harmonics[:, 0],
        " ".join(f"f_rest_{n}" for n in range(3 * (harmonics.shape[1] - 1))): harmonics[:, 1:]
        .transpose(1, 2)
        .flatten(1),
        # The logits of 0 and 1 would be infinite.
        "opacity": posed.opacities.logit(eps=1e-6)[:, None],
        "scale_0 scale_1 scale_2": posed.scales.log() - math.log(frame.scale),
        "rot_0 rot_1 rot_2 rot_3": F.normalize(posed.quaternions, dim=1),
    }
    names = " ".join(columns).split()
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(means)}"]
    header += [*(f"property float {name}" for name in names), "end_header", ""]
    table = torch.cat([part.cpu().float() for part in columns.values()], dim=1).numpy()
    path = path.with_name(f"{path.name}.ply")
    with replacing(path) as temporary:
        temporary.write_bytes("\n".join(header).encode() + table.astype("<f4").tobytes())
    return path
