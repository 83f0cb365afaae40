"""A budget of total time: what was spent on the preparation is not left for training.

A plug-in of runs that are compared after equal time; `OVERRIDES` turn it on.
"""

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from xplanes.errors import ConfigError
from xplanes.training.clock import TrainingClock, find_callback
from xplanes.training.module import RadianceModule

OVERRIDES = ("plugins=[total_time]", "+callbacks.total_time._target_=total_time.TotalTime")


class TotalTime(Callback):
    """Ends training when preparation and training have taken ``trainer.max_seconds`` together.

    Learning rates and all else that follows the share of the budget end there, too.
    """

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        clock = find_callback(trainer, TrainingClock)
        assert clock is not None
        assert isinstance(pl_module, RadianceModule)
        assert pl_module.initialisation is not None
        if clock.max_seconds is None:
            raise ConfigError("trainer.max_seconds=null: a budget of total time needs a number")
        spent = sum(pl_module.initialisation.seconds.values())
        if spent >= clock.max_seconds:
            raise ConfigError(
                f"trainer.max_seconds={clock.max_seconds:g}: the preparation took {spent:.1f} s, "
                "so that nothing is left for training; give more"
            )
        clock.max_seconds -= spent
