"""Pictures of what preparation did: the frames shown to a model, the parts of its triplanes."""

import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.lrm.images import Crop
from xplanes.lrm.model import LRM
from xplanes.preparation.encode import straight_alpha
from xplanes.training.scoring import spread


def parts_sheet(low_rank: Tensor, sparse: Tensor, moments: int = 4, side: int = 128) -> Tensor:
    """Low-rank and sparse part side by side at a few moments, three channels as colours.

    Rows are xy, xz, yz; a column is a moment, its left half the low-rank part, its right half the
    sparse one, in which grey is zero. Colours have one scale per orientation and part, so that
    moments compare.

    Args:
        low_rank: What stands still. [T, 3, C, H, W]
        sparse: What moves. [T, 3, C, H, W]
        moments: Columns, spread evenly over time.
        side: Pixels per plane.

    Returns:
        Colours from 0 to 1. [3 (side + 4), M 2 (side + 4), 3]
    """
    chosen = spread(moments, len(low_rank))
    still, moving = (_colours(part[chosen]) for part in (low_rank, sparse))
    still = still - still.mean(dim=(0, 3, 4), keepdim=True)
    spread_of = 5 * still.std(dim=(0, 3, 4), correction=0, keepdim=True).clamp_min(1e-8)
    peak = 2 * moving.abs().amax(dim=(0, 2, 3, 4), keepdim=True).clamp_min(1e-8)
    both = torch.stack([still / spread_of, moving / peak], dim=1) + 0.5  # [M, 2, 3, 3, H, W]
    tiles = F.interpolate(both.clamp(0, 1).flatten(0, 2), size=(side, side), mode="nearest")
    tiles = F.pad(tiles, (2, 2, 2, 2), value=1.0)
    size = side + 4
    # [moment, part, orientation, colour, row, column] to orientations below one another
    sheet = tiles.view(len(chosen), 2, 3, 3, size, size).permute(2, 4, 0, 1, 5, 3)
    return sheet.reshape(3 * size, len(chosen) * 2 * size, 3)


def _colours(planes: Tensor) -> Tensor:
    """The first three channels, the first again where there are fewer. [M, 3, 3, H, W]"""
    shown = planes[:, :, :3].detach().float().cpu()
    missing = 3 - shown.shape[2]
    return torch.cat([shown, shown[:, :, :1].expand(-1, -1, missing, -1, -1)], dim=2)


def film_sheet(frames: Tensor, crop: Crop, model: LRM, moments: int = 6, side: int = 160) -> Tensor:
    """A few frames as the model is shown them.

    Args:
        frames: Premultiplied RGBA. uint8 [T, H, W, 4]
        crop: What the model is shown of them.
        model: The model.
        moments: Frames shown, spread evenly.
        side: Pixels per frame.

    Returns:
        Colours from 0 to 1, the frames side by side. [side, M side, 3]
    """
    chosen = torch.tensor(spread(moments, len(frames)))
    shown = model.prepare(crop.apply(straight_alpha(frames[chosen])))
    shown = F.interpolate(shown, size=(side, side), mode="bilinear", antialias=True)
    return shown.permute(2, 0, 3, 1).flatten(1, 2).clamp(0, 1)
