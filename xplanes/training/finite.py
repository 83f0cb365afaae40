"""Whether parameters and gradients are finite, and steps without those that are not."""

import math
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor, nn

NamedTensors = Iterable[tuple[str, Tensor]]


def usable(gradient: Tensor) -> bool:
    """Whether an optimiser can take in a gradient: the sum of its squares is finite.

    Adam keeps the squares. One that overflows its type would stay infinite for ever and hold its
    parameter where it is, without a NaN anywhere.
    """
    if gradient.is_contiguous():
        flat = gradient.view(-1)
        return bool(torch.dot(flat, flat).isfinite())
    return bool(torch.linalg.vector_norm(gradient).isfinite())


def broken_flag(parameters: Iterable[nn.Parameter], losses: Sequence[Tensor]) -> Tensor:
    """1 if a gradient is not `usable` or a loss is not finite, on its device. float32 []

    Args:
        parameters: Parameters, some of which may have no gradient.
        losses: Losses of the batches that the gradients are of. [] each
    """
    gradients = [p.grad for p in parameters if p.grad is not None]
    if losses[0].device.type == "cpu":
        sound = all(math.isfinite(loss) for loss in losses) and all(map(usable, gradients))
        return torch.tensor(float(not sound))
    norm = nn.utils.get_total_norm([*gradients, *losses])
    return (~norm.square().isfinite()).float()


def leave_out(optimizer: torch.optim.Optimizer, broken: Tensor) -> None:
    """Let an optimiser leave out its next step where a flag is 1.

    Fused Adam takes the flag as that of a gradient scaler, and nothing waits for the device. Others
    find no gradients.
    """
    if getattr(optimizer, "_step_supports_amp_scaling", False):
        optimizer.found_inf = broken  # type: ignore[attr-defined]
    elif bool(broken):
        optimizer.zero_grad(set_to_none=True)


def unusable_gradients(named: Iterable[tuple[str, nn.Parameter]]) -> list[str]:
    """Names of the parameters whose gradient is not `usable`."""
    return [name for name, p in named if p.grad is not None and not usable(p.grad)]


def not_finite(named: NamedTensors) -> list[str]:
    """Names of the tensors that hold a NaN or an infinity."""
    # NaN and infinity survive a product with 0 as NaN; the sum of finite numbers may overflow.
    return [name for name, tensor in named if not bool((tensor.detach() * 0).sum() == 0)]
