"""X-Planes in training: regularisers of the planes, and L_r."""

import torch
from torch import Tensor

from xplanes.config import LossConfig, TrainerConfig
from xplanes.fields import XPlanes
from xplanes.scenes.batches import step_generator
from xplanes.training.methods.base import Method, warm_cosine
from xplanes.training.product import SparseProduct
from xplanes.training.regularisers import (
    add_distance_gradient,
    add_time_smoothness_gradient,
    add_total_variation_gradient,
    time_smoothness,
    total_variation,
)
from xplanes.training.sampling.base import Group, Moment

FRAME_STREAM = 1_000_037
"""Random stream of the frames at which L_r is taken."""


class XPlanesMethod(Method):
    """Colour error, smooth planes, and products of time planes near what moves.

    Args:
        field: The field.
        loss: Weights of the regularisers.
        trainer: Learning rates.
        product: What the products of time planes are tied to (L_r); None leaves the term out.
        hold: Weight of the planes' mean squared distances from their start.
        fade: Steps over which that and L_r fade away; None keeps them.
    """

    def __init__(
        self,
        field: XPlanes,
        *,
        loss: LossConfig,
        trainer: TrainerConfig,
        product: SparseProduct | None = None,
        hold: float = 0.0,
        fade: float | None = None,
    ) -> None:
        self._field, self.weights, self.options, self.product = field, loss, trainer, product
        self.hold, self.fade = hold, fade
        self._starts = [plane.detach().clone() for plane in self._planes] if hold else []
        self.advice = (
            f"Lower trainer.plane_lr={trainer.plane_lr} or trainer.decoder_lr={trainer.decoder_lr}"
        )

    @property
    def field(self) -> XPlanes:
        return self._field

    @property
    def _planes(self) -> list[Tensor]:
        return [p for p in (self._field.space, self._field.time) if p is not None]

    def groups(self) -> list[Group]:
        field = self._field
        groups: list[Group] = [
            {"params": [field.space], "lr": self.options.plane_lr, "name": "space"}
        ]
        if field.time is not None:
            groups.append({"params": [field.time], "lr": self.options.time_lr, "name": "time"})
        decoder = [p for p in field.decoder.parameters() if p.requires_grad]
        if decoder:
            groups.append({"params": decoder, "lr": self.options.decoder_lr, "name": "decoder"})
        return groups

    def rate(self, step: int, progress: float) -> float:
        options = self.options
        return warm_cosine(step, progress, warmup=options.warmup_steps, final=options.final_lr)

    def regularise(self, moment: Moment) -> None:
        every, field = self.weights.every, self._field
        if moment.step % every or field.space.grad is None:
            return
        tie = self._tie(moment.step)
        if not tie:
            self._starts, self.product = [], None  # Large, and of no more use.
        elif self.hold:
            # The field may have moved to another device since.
            self._starts = [start.to(field.space.device) for start in self._starts]
            for plane, start in zip(self._planes, self._starts, strict=True):
                if plane.grad is not None:
                    add_distance_gradient(plane.grad, plane, start, tie * self.hold * every)
        if weight := self.weights.total_variation * every:
            add_total_variation_gradient(field.space.grad, field.space, (1, 2), weight)
        if field.time is None or field.time.grad is None:
            return
        if weight:
            add_total_variation_gradient(field.time.grad, field.time, (2,), weight)
        if weight := self.weights.time_smoothness * every:
            add_time_smoothness_gradient(field.time.grad, field.time, weight)
        if weight := self.weights.time_magnitude * every:
            scale = 2 * weight / field.time.numel()
            field.time.grad.add_(field.time.detach(), alpha=scale)
        if self.product is not None:
            weight = tie * self.weights.sparse_weight * every
            # The same frames on all ranks: their planes must stay equal.
            generator = step_generator(moment.seed, moment.step, FRAME_STREAM)
            self.product.add_gradient(field.time.grad, field.time, weight, generator)

    def _tie(self, step: int) -> float:
        """Share of the weights that is left of what ties the field to its start."""
        return 1.0 if self.fade is None else max(0.0, 1 - step / self.fade)

    @torch.no_grad()
    def scalars(self) -> dict[str, float]:
        field = self._field
        values = {"reg/total_variation": float(total_variation(field.space, (1, 2)))}
        if field.time is not None:
            values["reg/time_smoothness"] = float(time_smoothness(field.time))
            values["reg/time_magnitude"] = float(field.time.square().mean())
            if self.product is not None:
                values["reg/sparse_product"] = self.product.value(field.time)
        return values
