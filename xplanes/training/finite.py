"""Whether parameters and gradients are finite."""

from collections.abc import Iterable

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


def all_usable(parameters: Iterable[nn.Parameter]) -> bool:
    """Whether all gradients are `usable`; one pass over each, and one wait for the device."""
    gradients = [p.grad for p in parameters if p.grad is not None]
    if not gradients or gradients[0].device.type == "cpu":
        return all(usable(gradient) for gradient in gradients)
    return usable_together(gradients)


def usable_together(gradients: Iterable[Tensor]) -> bool:
    """Whether all of some gradients, at least one, are `usable`, with one wait for the device."""
    norms = [torch.linalg.vector_norm(gradient, dtype=torch.float32) for gradient in gradients]
    return bool(torch.stack(norms).square().isfinite().all())


def unusable_gradients(named: Iterable[tuple[str, nn.Parameter]]) -> list[str]:
    """Names of the parameters whose gradient is not `usable`."""
    return [name for name, p in named if p.grad is not None and not usable(p.grad)]


def not_finite(named: NamedTensors) -> list[str]:
    """Names of the tensors that hold a NaN or an infinity."""
    # NaN and infinity survive a product with 0 as NaN; the sum of finite numbers may overflow.
    return [name for name, tensor in named if not bool((tensor.detach() * 0).sum() == 0)]
