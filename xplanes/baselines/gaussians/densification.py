"""Adaptive density control: Gaussians are cloned, split and removed during training."""

from dataclasses import dataclass

import torch
from torch import Tensor

from xplanes.baselines.gaussians.field import Gaussians
from xplanes.baselines.gaussians.rasteriser import GaussianError
from xplanes.baselines.gaussians.reference import rotations
from xplanes.settings import Count, Positive, Settings, Share, Steps

SHRINK = 1.6
"""Factor by which a split reduces the scales of a Gaussian (Kerbl et al. 2023)."""

LARGEST = 0.1
"""Gaussians above this share of the cameras' extent are removed after a reset (Kerbl et al.)."""

RESET_OPACITY = 0.01
"""Largest opacity after a reset (Kerbl et al. 2023)."""


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
    """Clone or split Gaussians whose projected means have large gradients, and remove faint ones.

    Small Gaussians are cloned in place. Large ones are replaced by two smaller ones, whose means
    are drawn from them. Moments of the optimiser are kept with their rows; new rows get 0.

    Args:
        field: The Gaussians; changed in place, with statistics reset.
        optimizer: The optimiser of their parameters; changed in place.
        settings: Thresholds.
        generator: Draws the means of split Gaussians.
        remove_large: Whether Gaussians larger than `LARGEST`, after splitting, are also removed.
        views: Views per step: losses are means over them, so gradients are scaled back by it.

    Raises:
        GaussianError: If no Gaussian would be left.
    """
    slopes = views * field.slopes / field.seen.clamp(min=1)
    size, extent = field.scales.amax(dim=1), float(field.extent)
    keep = field.opacities >= settings.least_opacity
    steep, large = slopes >= settings.threshold, size > settings.large * extent
    if remove_large:
        # Sizes after splitting count.
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
    """Replace the rows of a field by copies of some of them, with their moments in the optimiser.

    Args:
        field: Changed in place; there must be no pending gradients.
        optimizer: Changed in place.
        source: Index of the old row that each new row copies. int64 [M]
        fresh: New rows whose moments are set to 0. bool [M]
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
    """Clamp all opacities to `RESET_OPACITY`, and set their moments to 0."""
    most = torch.tensor(RESET_OPACITY).logit()
    field.logits.data.clamp_(max=float(most))
    for name, moments in optimizer.state.get(field.logits, {}).items():
        if name != "step":
            moments.zero_()
