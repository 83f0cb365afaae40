"""Density fields that place samples, and learn from what the field shows."""

from typing import Any

from torch import Tensor, nn

from xplanes.fields.kplanes import DensityField
from xplanes.rendering.proposal import ProposalRenderer, ProposalRendering
from xplanes.scenes.batches import Batch
from xplanes.schemas.samplers import ProposalConfig
from xplanes.training.losses import histogram_loss
from xplanes.training.plane_terms import PlaneTerms
from xplanes.training.sampling.base import Group, Moment, Sampling

ALWAYS = 10
"""First steps, in each of which the density fields learn."""


class ProposalSampling(Sampling):
    """Samples drawn from density fields that train along.

    Args:
        renderer: Holds the density fields.
        config: Schedule, weights and learning rate.

    Source: K-Planes, released code.
    """

    def __init__(self, renderer: ProposalRenderer, config: ProposalConfig) -> None:
        self._renderer, self.config = renderer, config
        renderer.exponent.fill_(self.anneal(0))
        self.schedule = UpdateSchedule(config.update_every, config.update_warmup)
        self.terms = PlaneTerms(
            config.total_variation,
            config.variation,  # type: ignore[arg-type]
            config.time_smoothness,
            config.time_identity,
        )

    @property
    def renderer(self) -> ProposalRenderer:
        return self._renderer

    @property
    def parts(self) -> dict[str, nn.Module]:
        return {"proposals": self._renderer.proposals}

    @property
    def outline(self) -> str:
        counts = " + ".join(str(count) for count in self._renderer.counts)
        return f"{counts} samples a ray in density fields, {self._renderer.samples} in the field"

    def groups(self) -> list[Group]:
        parameters = list(self._renderer.proposals.parameters())
        return [{"params": parameters, "lr": self.config.learning_rate, "name": "proposals"}]

    def anneal(self, step: int) -> float:
        """Exponent of the weights that samples are drawn from: from 0 to 1, fast at first."""
        share = min(step / self.config.anneal_steps, 1.0)
        slope = self.config.anneal_slope
        return slope * share / ((slope - 1) * share + 1)

    def render(self, field: Any, rays: Batch, moment: Moment) -> ProposalRendering:
        # It stays in force for the pictures after this step.
        self._renderer.exponent.fill_(self.anneal(moment.step))
        return self._renderer.render(
            field,
            rays["origins"],
            rays["directions"],
            rays["times"],
            rays["background"],
            moment.generator(rays["times"].device),
            learn=self.schedule.learns(moment.step),
        )

    def loss(self, rendering: ProposalRendering) -> Tensor | None:
        if not rendering.levels[0].weights.requires_grad:
            return None
        return self.config.histogram * histogram_loss(rendering.levels)

    def regularise(self) -> None:
        for proposal in self._renderer.proposals:
            assert isinstance(proposal, DensityField)
            self.terms.add_gradients(proposal.products)


class UpdateSchedule:
    """In which steps density fields learn: all at first, then rarer, a function of the step alone.

    They learn when more than n steps have passed since they last did; n grows from 1 to ``every``.

    Args:
        every: n in the end.
        warmup: Steps over which it grows.
    """

    def __init__(self, every: int, warmup: int) -> None:
        self.every, self.warmup = every, warmup
        self._step, self._last = -1, 0

    def learns(self, step: int) -> bool:
        """Whether they learn in a step."""
        if step < self._step:
            self._step, self._last = -1, 0
        while self._step < step:
            self._step += 1
            gap = max(1.0, self.every * min(1.0, self._step / self.warmup))
            if self._step < ALWAYS or self._step - self._last > gap:
                self._last = self._step
        return self._last == step
