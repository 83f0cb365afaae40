"""The cached stages from a triplane sequence to planes, and their images."""

import sys
import warnings
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from xplanes.decomposition import decompose, space_planes, time_planes, unexplained_energy
from xplanes.fields.xplanes import PLANE_SETS, SPACE_PLANES, TIME_PLANES
from xplanes.lrm.images import Crop
from xplanes.lrm.model import LRM
from xplanes.models.initialisation import DecompositionSettings
from xplanes.models.x_planes import XPlanesSettings
from xplanes.preparation.cache import Stage, StageCache
from xplanes.preparation.encode import straight_alpha
from xplanes.rendering.pictures import first_colours
from xplanes.scenes.views import spread
from xplanes.streams import Stream, step_generator

PARTS_TIMES, PARTS_SIDE, FRAMES, FRAME_SIDE = 4, 128, 6, 160
"""Columns of the two sheets, evenly spaced in time, and pixels per plane or frame."""


def parts_sheet(low_rank: Tensor, sparse: Tensor) -> Tensor:
    """Low-rank and sparse part side by side at a few timesteps, three channels as colours.

    Rows are xy, xz, yz. Each column is a timestep: low-rank part on the left, sparse part on the
    right (grey is zero). Each orientation and part has one colour scale for all timesteps.

    Args:
        low_rank: The static part. [T, 3, C, H, W]
        sparse: The dynamic part. [T, 3, C, H, W]

    Returns:
        Colours from 0 to 1. [3 (side + 4), M 2 (side + 4), 3]
    """
    chosen, side = spread(PARTS_TIMES, len(low_rank)), PARTS_SIDE
    static, moving = (first_colours(part[chosen]) for part in (low_rank, sparse))
    static = static - static.mean(dim=(0, 3, 4), keepdim=True)
    spread_of = 5 * static.std(dim=(0, 3, 4), correction=0, keepdim=True).clamp_min(1e-8)
    peak = 2 * moving.abs().amax(dim=(0, 2, 3, 4), keepdim=True).clamp_min(1e-8)
    both = torch.stack([static / spread_of, moving / peak], dim=1) + 0.5  # [M, 2, 3, 3, H, W]
    tiles = F.interpolate(both.clamp(0, 1).flatten(0, 2), size=(side, side), mode="nearest")
    tiles = F.pad(tiles, (2, 2, 2, 2), value=1.0)
    size = side + 4
    # [timestep, part, orientation, colour, row, column], with orientations below one another.
    sheet = tiles.view(len(chosen), 2, 3, 3, size, size).permute(2, 4, 0, 1, 5, 3)
    return sheet.reshape(3 * size, len(chosen) * 2 * size, 3)


def contact_sheet(frames: Tensor, crop: Crop, model: LRM) -> Tensor:
    """Contact sheet of a few frames, as the LRM sees them.

    Args:
        frames: Premultiplied RGBA. uint8 [T, H, W, 4]
        crop: Crop that the model is given.
        model: The model.

    Returns:
        Colours from 0 to 1, the frames side by side. [side, M side, 3]
    """
    chosen = torch.tensor(spread(FRAMES, len(frames)))
    shown = model.prepare(crop.apply(straight_alpha(frames[chosen])))
    shown = F.interpolate(shown, size=(FRAME_SIDE, FRAME_SIDE), mode="bilinear", antialias=True)
    return shown.permute(2, 0, 3, 1).flatten(1, 2).clamp(0, 1)


REPORTED = (
    *("rank", "iterations", "residual", "change", "converged", "sparsity", "drift"),
    *("low_rank_energy", "sparse_energy", "sparsity_weight", "unit"),
)
"""Entries of metrics.json for each orientation."""


def decompose_stage(
    triplanes: Tensor, config: DecompositionSettings, cache: StageCache, device: torch.device
) -> Stage:
    """Robust PCA of a sequence; a single triplane has no sparse part.

    Args:
        triplanes: The sequence. [T, 3, C, H, H]
        config: Its settings.
        cache: Cache of the stage.
        device: Device of the computation.

    Returns:
        The static part ``low_rank`` and the dynamic part ``sparse`` [T, 3, C, H, H] on the CPU, and
        ``report``, the entries of `REPORTED` for each of "xy", "xz" and "yz". For a single triplane
        ``sparse`` is None and the report is empty.
    """
    triplanes = triplanes.float()
    names = ("method", "sparsity_weight", "penalty", "scale", "tolerance", "max_iterations")
    options = {name: getattr(config, name) for name in names}
    if len(triplanes) == 1:
        content = {"low_rank": triplanes, "sparse": None, "report": {}}
        return cache.stage("decomposition", [triplanes, options], lambda: content, keep=False)

    def make() -> dict[str, Any]:
        with warnings.catch_warnings():
            # The caller warns once for all orientations, even if the parts are cached.
            warnings.filterwarnings("ignore", message="robust PCA stopped")
            # Only on a terminal: in a log file a progress bar would fill many lines.
            shown = sys.stderr.isatty()
            parts = decompose(triplanes.to(device), progress=shown, **options)
        report = {
            name: {key: whole[key] for key in REPORTED} for name, whole in parts.reports.items()
        }
        return {"low_rank": parts.low_rank.cpu(), "sparse": parts.sparse.cpu(), "report": report}

    return cache.stage("decomposition", [triplanes, options], make, keep=config.cache)


def convert_stage(
    parts: Stage,
    model: XPlanesSettings,
    config: DecompositionSettings,
    seed: int,
    cache: StageCache,
    device: torch.device,
) -> Stage:
    """Space planes from the low-rank part, time planes from the sparse part.

    Args:
        parts: Result of `decompose_stage`.
        model: The model's settings with which the field is built.
        config: Settings of the conversion.
        seed: The run's seed, for the noise.
        cache: Cache of the stage.
        device: Device of the computation.

    Returns:
        The planes ``space`` [3, R, R, C] and ``time`` [P, Rt, R, C], on the CPU, and
        ``unexplained``, the share of the sparse part's energy that products of time planes do not
        explain: ``before`` for random planes, ``after`` for the returned ones. Without time planes,
        ``time`` is None and ``unexplained`` is empty.
    """
    moving = model.plane_set != "three"
    sparse = parts.content["sparse"] if moving else None
    texels = model.coarse_texels()
    time_texels = model.time_texels or texels

    def initial_planes(dynamic: str, target: Tensor) -> Tensor:
        rows = model.time_resolution
        assert rows != "half", "from_sequence replaces it by a number"
        return time_planes(
            target,
            plane_set=model.plane_set,
            dynamic=dynamic,
            resolution=time_texels,
            time_resolution=rows,
            noise=config.noise,
            generator=step_generator(seed, 0, Stream.NOISE),
        )

    def make() -> dict[str, Any]:
        low_rank = parts.content["low_rank"].to(device)
        space = space_planes(low_rank, static=config.static, resolution=texels)
        content: dict[str, Any] = {"space": space.cpu(), "time": None, "unexplained": {}}
        if sparse is not None:
            target = sparse.to(device)
            initial = initial_planes(config.dynamic, target)
            content["time"] = initial.cpu()
            content["unexplained"] = {
                "before": unexplained_energy(initial_planes("random", target), target, rows=rows),
                "after": unexplained_energy(initial, target, rows=rows),
            }
        return content

    rows = PLANE_SETS[model.plane_set]  # A user's own plane set may change without a new name.
    of_time = [config.dynamic, config.noise, model.plane_set, rows, model.time_resolution]
    of_time += [time_texels, seed]
    inputs = [parts.key, config.static, texels, of_time if moving else []]
    return cache.stage("planes", inputs, make)


def named_planes(planes: Stage, plane_set: str) -> dict[str, Tensor]:
    """The planes of `convert_stage` by name. [C, rows, columns] each"""
    names = {"space": SPACE_PLANES, "time": TIME_PLANES[plane_set]}
    return {
        name: plane.permute(2, 0, 1)
        for part, known in names.items()
        if planes.content[part] is not None
        for name, plane in zip(known, planes.content[part], strict=True)
    }
