"""Detects fields that collapse to empty space or fog, and re-initialises them."""

import logging
import math
from typing import Any

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from xplanes.errors import ConfigError
from xplanes.training.module import RadianceModule

logger = logging.getLogger(__name__)

WINDOW = 100
"""Batches over which opacities are averaged."""

NOTHING = 0.05
"""Mean opacity of foreground rays below which a field counts as empty."""

FOG = 0.5
"""Mean opacity of background rays above which a field counts as fog."""

FIRST_FOG = 400
"""Steps during which fog may still clear by itself."""


class CollapseWatch(Callback):
    """Detects a field that is empty where the images show an object, or fog where they show none.

    The field is then re-initialised with another seed and the model's settings for this case
    (`ModelSettings.stronger`). If that does not help, or the model has no such settings, like the
    published baselines, the callback warns, and training continues to the end of its budget.

    Args:
        restarts: Maximum number of re-initialisations; 0 for a warning only.

    Attributes:
        collapsed: Description of the last collapse; empty if there was none.
    """

    def __init__(self, restarts: int = 1) -> None:
        if restarts < 0:
            raise ConfigError(f"restarts={restarts}: must be 0 or more")
        self.restarts = restarts
        self.collapsed = ""
        self._since = 0
        self._seen: list[tuple[float, float]] = []

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        assert isinstance(pl_module, RadianceModule)
        last = pl_module.tally.last
        self._seen.append((last.get("foreground", math.nan), last.get("background", math.nan)))
        if len(self._seen) < WINDOW or not pl_module.between_updates:
            return
        age = trainer.global_step - self._since
        found = verdict(self._seen, fog=age > FIRST_FOG)
        self._seen = []
        if not found:
            self.collapsed = ""
            return
        left = pl_module.restarts < self.restarts and trainer.world_size == 1
        if left and pl_module.parts.settings.stronger() is not None:
            logger.warning(
                "%s at step %d: re-initialised with another seed and stronger supervision of "
                "opacity",
                found,
                trainer.global_step,
            )
            pl_module.restart()
            self._since = trainer.global_step
        elif not self.collapsed:
            self.collapsed = found
            logger.warning(
                "%s at step %d. Check the poses, the times and data.half_side against a few images "
                "in media/, then try another seed or smaller learning rates",
                found,
                trainer.global_step,
            )

    def state_dict(self) -> dict[str, Any]:
        return {"since": self._since, "collapsed": self.collapsed, "seen": self._seen}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._since, self.collapsed = state_dict["since"], state_dict["collapsed"]
        self._seen = [tuple(pair) for pair in state_dict["seen"]]


def verdict(seen: list[tuple[float, float]], *, fog: bool) -> str:
    """Description of a collapse, from mean opacities of rays; empty if there is none.

    Args:
        seen: For each batch, mean opacity of foreground and of background rays, from 0 to 1; NaN
            without such rays.
        fog: Whether to check for fog.
    """
    foreground, background = (
        [value for value in values if not math.isnan(value)] for values in zip(*seen, strict=True)
    )
    if foreground and math.fsum(foreground) < NOTHING * len(foreground):
        return "the field is empty where the images show an object"
    if fog and background and math.fsum(background) > FOG * len(background):
        return "the field is fog where the images show background"
    return ""
