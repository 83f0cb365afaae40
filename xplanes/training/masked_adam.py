"""Adam that leaves entries alone which no ray has reached."""

from collections.abc import Callable
from typing import Any

import torch


class MaskedAdam(torch.optim.Optimizer):
    """Adam whose groups may be ``masked``: entries with a gradient of zero keep value and moments.

    The bias corrections are taken into the step, so ``eps`` counts against the uncorrected root.

    Args:
        groups: Parameter groups with ``params``, ``lr`` and, if they are, ``masked``.
        betas: Decay of the two moments.
        eps: Keeps the step finite.

    Source: TiNeuVox and DirectVoxGO, released code.
    """

    def __init__(
        self,
        groups: list[dict[str, Any]],
        betas: tuple[float, float] = (0.9, 0.99),
        eps: float = 1e-8,
    ) -> None:
        super().__init__(groups, {"lr": 1e-3, "betas": betas, "eps": eps, "masked": False})

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Update all parameters that have a gradient."""
        result = None
        if closure is not None:
            with torch.enable_grad():
                result = closure()
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    self._update(parameter, group)
        return result

    def _update(self, parameter: torch.Tensor, group: dict[str, Any]) -> None:
        gradient, state = parameter.grad, self.state[parameter]
        assert gradient is not None
        if not state:
            state["step"] = 0
            state["mean"] = torch.zeros_like(parameter)
            state["square"] = torch.zeros_like(parameter)
        state["step"] += 1
        first, second = group["betas"]
        mean, square = state["mean"], state["square"]
        size = (1 - second ** state["step"]) ** 0.5 / (1 - first ** state["step"])
        if not group["masked"]:
            mean.lerp_(gradient, 1 - first)
            square.mul_(second).addcmul_(gradient, gradient, value=1 - second)
            parameter.addcdiv_(mean, square.sqrt().add_(group["eps"]), value=-size * group["lr"])
            return
        reached = gradient.flatten().nonzero()[:, 0]
        flat = gradient.flatten()[reached]
        new_mean = mean.view(-1)[reached].lerp_(flat, 1 - first)
        new_square = square.view(-1)[reached].mul_(second).addcmul_(flat, flat, value=1 - second)
        mean.view(-1)[reached], square.view(-1)[reached] = new_mean, new_square
        change = new_mean / new_square.sqrt().add_(group["eps"])
        parameter.view(-1).index_add_(0, reached, change, alpha=-size * group["lr"])
