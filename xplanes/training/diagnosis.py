"""Losses and gradients that are not finite: skipped steps, and messages for the user."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from xplanes.errors import XPlanesError
from xplanes.rendering.base import Rendering

if TYPE_CHECKING:
    from xplanes.training.module import RadianceModule


class TrainingError(XPlanesError, RuntimeError):
    """Training cannot continue; the message says what was observed and what to change."""


def usable(gradient: Tensor) -> bool:
    """Whether an optimiser can use a gradient: the sum of its squares is finite.

    Adam keeps a running average of the squares. After an overflow it would stay infinite and
    freeze its parameter, without any NaN.
    """
    if gradient.is_contiguous():
        flat = gradient.view(-1)
        return math.isfinite(torch.dot(flat, flat))
    return math.isfinite(torch.linalg.vector_norm(gradient))


def broken_flag(parameters: Iterable[nn.Parameter], losses: Sequence[Tensor]) -> Tensor:
    """1 if a gradient is not `usable` or a loss is not finite, on its device. float32 []

    Args:
        parameters: Parameters, some of which may have no gradient.
        losses: Losses of the batches to which the gradients belong. [] each
    """
    gradients = [p.grad for p in parameters if p.grad is not None]
    if losses[0].device.type == "cpu":
        sound = all(math.isfinite(loss) for loss in losses) and all(map(usable, gradients))
        return torch.tensor(float(not sound))
    norm = nn.utils.get_total_norm([*gradients, *losses])
    return (~norm.square().isfinite()).float()


def leave_out(optimizer: torch.optim.Optimizer, broken: Tensor) -> None:
    """Make an optimiser skip its next step if a flag is 1.

    Fused Adam reads the flag as ``found_inf`` of a gradient scaler, so that the host does not wait
    for the device. For other optimisers the gradients are removed.
    """
    if getattr(optimizer, "_step_supports_amp_scaling", False):
        optimizer.found_inf = broken  # type: ignore[attr-defined]
    elif bool(broken):
        optimizer.zero_grad(set_to_none=True)


def unusable_gradients(named: Iterable[tuple[str, nn.Parameter]]) -> list[str]:
    """Names of the parameters whose gradient is not `usable`."""
    return [name for name, p in named if p.grad is not None and not usable(p.grad)]


def not_finite(named: Iterable[tuple[str, Tensor]]) -> list[str]:
    """Names of the tensors that contain a NaN or an infinity."""
    # NaN * 0 and infinity * 0 are NaN; a plain sum of finite numbers could overflow.
    return [name for name, tensor in named if not bool((tensor.detach() * 0).sum() == 0)]


def diagnosis(
    module: "RadianceModule",
    rendering: Rendering,
    terms: Mapping[str, Tensor],
    unusable: Sequence[str] = (),
) -> str:
    """Error message: what was not finite in the last updates, and what to change.

    Args:
        module: The module that is trained.
        rendering: The rendering of the last batch.
        terms: Terms of its loss by name.
        unusable: Parameters whose gradients are not finite.
    """
    loss = float(torch.stack(list(terms.values())).detach().sum())
    count = module.tally.skipped_in_a_row
    what = "a gradient was infinite, NaN or too large to square"
    if not math.isfinite(loss):
        what = f"the loss was {loss}"
    density, parameters = rendering.density, not_finite(module.named_parameters())
    seen = {"colour": rendering.colour, "opacity": rendering.opacity, "density": density}
    rays = [f"rendered {name}" for name in not_finite(seen.items())]
    # Terms of the group ``losses`` are named by their setting.
    losses = [
        f"losses.{name}" if name in module.method.losses else f"loss term {name}"
        for name in not_finite(terms.items())
    ]
    gradients = [f"gradient of {name}" for name in unusable if math.isfinite(loss)]
    broken = parameters or gradients or [*rays, *losses]
    return (
        f"{what} for {count} steps in a row, from step {module.global_step - count + 1} on; not "
        "finite: "
        f"{', '.join(broken) or 'gradients, or a value in another process'}; largest density "
        f"{float(density.max()) if len(density) else 0:.3g}. "
        f"{_way_out(module, losses, rendered=not (parameters or rays))}"
    )


def require_finite(module: "RadianceModule") -> None:
    """Refuse to continue with, or to save, parameters that are not finite.

    Raises:
        TrainingError: With their names.
    """
    if broken := not_finite(module.named_parameters()):
        raise TrainingError(
            f"not finite at step {module.global_step}: {', '.join(broken)}. The last valid "
            f"checkpoint was not overwritten. {_way_out(module)}"
        )


def _way_out(
    module: "RadianceModule", broken: Sequence[str] = (), *, rendered: bool = False
) -> str:
    """Advice, given ``broken`` loss terms; ``rendered``: parameters and rendering are finite."""
    added = [f"losses.{name}" for name in module.method.losses] if rendered else []
    begun = module.tally.done > 0
    resume = "; resume= continues from the last checkpoint" if begun else ""
    if culprits := [name for name in added if name in broken]:
        return f"The rendering is finite: correct {' and '.join(culprits)} or omit it{resume}"
    precision = "" if module.field.precision == "32" else ", or set model.precision=32"
    if begun:
        if module.advice is not None:
            return f"{module.advice}{resume}"
        more = f", or omit {' and '.join(added)}" if added else ""
        return f"{module.model.advice}{more}{precision}{resume}"
    if module.site.initialised and not added and not (rendered and broken):
        largest = max(float(p.detach().abs().max()) for p in module.field.parameters())
        return (
            "No step has been completed, so the initialisation is the cause (largest value "
            f"{largest:.3g}): set lrm=none, or use another one"
        )
    checked = " and ".join([type(module.field).__name__, *added])
    return f"No step has been completed: check the values and gradients of {checked}{precision}"
