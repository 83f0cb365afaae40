"""Adaptive density control: Gaussians are cloned, split and removed as training goes on."""

from dataclasses import dataclass

import torch
from torch import Tensor

from xplanes.baselines.gaussians.field import Gaussians
from xplanes.baselines.gaussians.rasteriser import GaussianError
from xplanes.baselines.gaussians.reference import rotations
from xplanes.settings import Count, Positive, Settings, Share, Steps

SHRINK = 1.6
"""Factor by which halves are smaller than the Gaussian that was split (Kerbl et al. 2023)."""

LARGEST = 0.1
"""Gaussians above this share of the cameras' extent are removed after a reset (Kerbl et al.)."""

RESET_OPACITY = 0.01
"""Opacity at most, after a reset (Kerbl et al. 2023)."""


@dataclass(frozen=True, kw_only=True)
class DensifySettings(Settings):
    """When Gaussians are cloned, split and removed."""

    every: Count  # Steps between densifications.
    first: Steps  # Steps before the first densification.
    until: Share  # Share of the budget after which densification stops.
    threshold: Positive  # Mean screen-space gradient above which a Gaussian is cloned or split.
    # Size above which a Gaussian is split, not cloned, relative to the cameras' extent.
    large: Positive
    least_opacity: Share  # Opacity below which a Gaussian is removed.
    reset_every: Count | None  # Steps between opacity resets; null for none.
    most: Count  # Maximum number of Gaussians.


@torch.no_grad()
def densify(
    field: Gaussians,
    optimizer: torch.optim.Optimizer,
    settings: DensifySettings,
    generator: torch.Generator,
    *,
    remove_large: bool,
    views: int = 1,
) -> None:
    """Double Gaussians whose projected means have large gradients, and remove faint ones.

    Small Gaussians are cloned where they are. Large ones are replaced by two smaller ones, drawn
    from themselves. Moments of the optimiser follow their rows; those of new rows are 0.

    Args:
        field: Changed in place, its statistics set to 0.
        optimizer: Of its parameters; changed in place.
        settings: Thresholds.
        generator: Draws the places of halves.
        remove_large: Whether Gaussians larger than `LARGEST` are removed, too, once halves are
            smaller.
        views: Views whose losses a step averages: the statistics hold that share of each gradient.

    Raises:
        GaussianError: If none would be left.
    """
    slopes = views * field.slopes / field.seen.clamp(min=1)
    size, extent = field.scales.amax(dim=1), float(field.extent)
    keep = field.opacities >= settings.least_opacity
    steep, large = slopes >= settings.threshold, size > settings.large * extent
    if remove_large:
        # A split comes before: halves that are small enough stay.
        keep &= torch.where(steep & large, size / SHRINK, size) <= LARGEST * extent
    if not keep.any():
        raise GaussianError(
            f"all {len(field)} Gaussians are fainter than model.densify.least_opacity="
            f"{settings.least_opacity}, or too large: nothing would be left to train. Lower it, or "
            "the learning rates of opacity and scales; resume= continues from the last checkpoint"
        )
    double = keep & steep
    room = max(0, settings.most - int(keep.sum()))
    if int(double.sum()) > room:
        chosen = torch.where(double, slopes, -1).topk(room).indices
        double = torch.zeros_like(double).index_fill_(0, chosen, True)
    split = double & large
    stay, clones, halves = (
        (mask).nonzero()[:, 0] for mask in (keep & ~split, double & ~split, split)
    )
    source = torch.cat([stay, clones, halves, halves])
    fresh = torch.arange(len(source), device=source.device) >= len(stay)
    spread = field.scales[halves].repeat(2, 1)
    noise = torch.randn(spread.shape, generator=generator).to(spread)
    turns = rotations(field.quaternions[halves]).repeat(2, 1, 1)
    select_rows(field, optimizer, source, fresh)
    new = slice(len(stay) + len(clones), len(source))
    field.means[new] += (turns @ (spread * noise)[..., None])[..., 0]
    field.log_scales[new] = (spread / SHRINK).log()
    field.slopes.zero_()
    field.seen.zero_()


@torch.no_grad()
def select_rows(
    field: Gaussians, optimizer: torch.optim.Optimizer, source: Tensor, fresh: Tensor
) -> None:
    """Give a field other rows of its own, with their moments in the optimiser.

    Args:
        field: Changed in place; no gradients may wait.
        optimizer: Changed in place.
        source: Row of before that each row of afterwards is a copy of. int64 [M]
        fresh: Rows whose moments begin at 0. bool [M]
    """
    for tensor in field.rows.values():
        for name, moments in optimizer.state.get(tensor, {}).items():
            if name != "step":
                moved = moments[source]
                moved[fresh] = 0
                optimizer.state[tensor][name] = moved
        tensor.data = tensor.data[source]


@torch.no_grad()
def reset_opacity(field: Gaussians, optimizer: torch.optim.Optimizer) -> None:
    """Lower all opacities to `RESET_OPACITY` at most, with moments of 0."""
    most = torch.tensor(RESET_OPACITY).logit()
    field.logits.data.clamp_(max=float(most))
    for name, moments in optimizer.state.get(field.logits, {}).items():
        if name != "step":
            moments.zero_()
