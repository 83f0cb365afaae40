"""How a LightningModule scores the views of a scene."""

from abc import abstractmethod
from typing import Any

import torch
from lightning import LightningModule
from lightning.pytorch.trainer.states import TrainerFn
from torch import Tensor, nn

from xplanes.fields.base import Representation
from xplanes.rendering.base import Renderer
from xplanes.scenes.frame import Frame
from xplanes.training.meters import Tally
from xplanes.training.scores import ViewScore, gathered, mean_scores, render_item, score_image


class ViewScoring(LightningModule):
    """Scores whole views, as `SceneDataModule` serves them, in validation and test.

    Attributes:
        field: What is rendered.
        tally: Takes the means over views.
        scores: Those of the views of the last validation or test, of all processes.
    """

    field: Representation
    tally: Tally
    scores: list[ViewScore]
    _tag = ""

    @property
    @abstractmethod
    def frame(self) -> Frame | None:
        """The field's frame; None before it is built."""

    @property
    @abstractmethod
    def renderer(self) -> Renderer:
        """Renders images of the field."""

    @property
    @abstractmethod
    def shared_parts(self) -> list[nn.Module]:
        """What processes that share a run keep apart while they train."""

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> dict[str, Any]:
        return self._score(batch, batch_idx)

    def test_step(self, batch: dict[str, Any], batch_idx: int) -> dict[str, Any]:
        return self._score(batch, batch_idx)

    def predict_step(self, batch: dict[str, Any], batch_idx: int) -> dict[str, Tensor]:
        """One view: ``colour`` [H, W, 3], ``opacity`` and ``depth`` [H, W]."""
        frame = self.frame
        assert frame is not None
        return render_item(self.field, self.renderer, frame, batch)

    def _score(self, batch: dict[str, Any], batch_idx: int) -> dict[str, Any]:
        """The rendered view; its scores wait for those of the others."""
        image = self.predict_step(batch, batch_idx)
        self.scores.append(score_image(image, batch))
        self._tag = batch["tag"]
        return image

    def on_validation_epoch_start(self) -> None:
        self.agree()
        self.scores = []

    def on_test_epoch_start(self) -> None:
        self.agree()
        self.scores = []

    def on_validation_epoch_end(self) -> None:
        self._log_scores()

    def on_test_epoch_end(self) -> None:
        self._log_scores()

    def _log_scores(self) -> None:
        self.scores = gathered(self.scores, self.trainer)
        tag = self.trainer.strategy.broadcast(self._tag)  # A process may have had no view.
        means = {f"{tag}/{name}": value for name, value in mean_scores(self.scores).items()}
        self.tally.last |= means
        if self.trainer.state.fn == TrainerFn.FITTING:
            # Lightning's own count is one less, and not that of a run that goes on.
            means["step"] = float(self.trainer.global_step)
        # All processes have the means of all views; Lightning warns where it need not.
        self.log_dict(means, batch_size=1, sync_dist=self.trainer.world_size > 1)

    def agree(self) -> None:
        """Go on with the first process's sampler, for each has seen the samples of its own rays.

        What is scored, or goes into a checkpoint, is one field.
        """
        if self._trainer is None or self._trainer.world_size == 1:
            return
        for part in self.shared_parts:
            for buffer in part.buffers():
                torch.distributed.broadcast(buffer, src=0)
