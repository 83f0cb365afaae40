"""A built field as a LightningModule that renders and scores views."""

from dataclasses import replace
from typing import Any

import torch
from lightning import LightningModule
from lightning.pytorch.trainer.states import TrainerFn
from torch import Tensor

from xplanes.errors import ConfigError
from xplanes.fields.base import Representation
from xplanes.models.base import Model
from xplanes.models.initialisation import Initialisation
from xplanes.rendering.base import Renderer
from xplanes.rendering.sampler import Sampler, Site
from xplanes.scenes.frame import Frame
from xplanes.scenes.views import Scene
from xplanes.training.building import Parts
from xplanes.training.meters import Tally
from xplanes.training.scores import ViewScore, gathered, mean_scores, render_item, score_image


class FieldModule(LightningModule):
    """A field with its model and sampler; validation and test score whole views.

    Attributes:
        field: The field, once it is built.
        scores: Scores of the views of the last validation or test, from all processes.
        tally: Counts of training steps, and the last losses and scores.
    """

    field: Representation

    def __init__(self) -> None:
        super().__init__()
        self.scores: list[ViewScore] = []
        self.tally = Tally()
        self._tag = ""
        self._parts: Parts | None = None

    @property
    def parts(self) -> Parts:
        """The field with its model and sampler.

        Raises:
            ConfigError: If they are not built yet.
        """
        if self._parts is None:
            raise ConfigError(
                "the field is not built yet: fit with a SceneDataModule, or load a checkpoint"
            )
        return self._parts

    @property
    def model(self) -> Model:
        """The field's losses and learning rates."""
        return self.parts.model

    @property
    def sampler(self) -> Sampler:
        """The sampler, which renders training batches."""
        return self.parts.sampler

    @property
    def site(self) -> Site:
        """Context for which the field was built."""
        return self.parts.site

    @property
    def initialisation(self) -> Initialisation | None:
        """The initialisation; None if the field was loaded."""
        return self.parts.initialisation

    @property
    def frame(self) -> Frame | None:
        """The field's frame; None before it is built."""
        return None if self._parts is None else self._parts.site.frame

    @property
    def renderer(self) -> Renderer:
        """Renders images of the field."""
        return self.parts.sampler.renderer

    def corrected(self, poses: Tensor) -> Tensor:
        """World poses with the corrections that training has learnt. [V, 4, 4]"""
        frame = self.frame
        return poses if frame is None else self.sampler.corrected(poses, frame)

    def corrected_scene(self, scene: Scene) -> Scene:
        """A scene with corrected poses."""
        splits = {
            name: replace(views, camera_to_world=self.corrected(views.camera_to_world))
            for name, views in scene.splits.items()
        }
        return replace(scene, splits=splits)

    @property
    def _ddp_params_and_buffers_to_ignore(self) -> list[str]:
        """Buffers that DDP does not broadcast from the first process before each step.

        The occupancy grid takes 20 MB; the processes synchronise it at intervals.
        """
        modules = self.sampler.modules.items()
        return [f"{name}.{key}" for name, part in modules for key, _ in part.named_buffers()]

    def predict_step(self, batch: dict[str, Any], batch_idx: int) -> dict[str, Tensor]:
        """One view: ``colour`` [H, W, 3], ``opacity`` and ``depth`` [H, W]."""
        camera = batch["camera"]
        pose = self.corrected(camera.camera_to_world[None])[0]
        item = batch | {"camera": replace(camera, camera_to_world=pose)}
        return render_item(self.field, self.renderer, self.site.frame, item)

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> dict[str, Tensor]:
        """Render and score a view; the mean scores are logged at the end of the epoch."""
        image = self.predict_step(batch, batch_idx)
        self.scores.append(score_image(image, batch))
        self._tag = batch["tag"]
        return image

    test_step = validation_step

    def on_validation_epoch_start(self) -> None:
        self.agree()
        self.scores = []

    on_test_epoch_start = on_validation_epoch_start

    def on_validation_epoch_end(self) -> None:
        self.scores = gathered(self.scores, self.trainer)
        tag = self.trainer.strategy.broadcast(self._tag)  # A process may have had no view.
        means = {f"{tag}/{name}": value for name, value in mean_scores(self.scores).items()}
        self.tally.last |= means
        if self.trainer.state.fn == TrainerFn.FITTING:
            # Lightning's own count is one less, and restarts in a resumed run.
            means["step"] = float(self.trainer.global_step)
        # All processes already have the means of all views; sync_dist avoids Lightning's warning.
        self.log_dict(means, batch_size=1, sync_dist=self.trainer.world_size > 1)

    on_test_epoch_end = on_validation_epoch_end

    def agree(self) -> None:
        """Copy the sampler's buffers from the first process to all others.

        Each has observed only its own rays; with equal buffers all score and save the same field.
        """
        if self._trainer is None or self._trainer.world_size == 1:
            return
        for part in self.sampler.modules.values():
            own = getattr(part, "own", ())
            for name, buffer in part.named_buffers():
                if name not in own:
                    torch.distributed.broadcast(buffer, src=0)
