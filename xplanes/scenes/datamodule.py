"""A scene as a LightningDataModule: rays for training and whole views for evaluation."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch
import yaml
from lightning import LightningDataModule
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, DistributedSampler, IterableDataset

from xplanes.components import build, plugins
from xplanes.config import compose_plain
from xplanes.errors import ConfigError, MissingSplitError
from xplanes.files import read_json
from xplanes.scenes.batches import Batch, Batches, DeviceBatches, RayBatches, RaySettings
from xplanes.scenes.frame import Frame, scene_frame
from xplanes.scenes.source import HELD_OUT, SceneSettings, held_out_places, may_hold_out
from xplanes.scenes.views import Scene, Views, spread

UNIFORM = RaySettings(
    per_batch=1024,
    samples_per_batch=8192,
    background="white",
    skip_background=False,
    background_share=1.0,
    background_jitter=0.0,
    error_share=0.0,
    match_exposure=False,
)
"""Batches for a LightningModule that does not specify any."""


class SceneDataModule(LightningDataModule):
    """Reads a scene, checks it, and serves rays for training and views for evaluation.

    Training batches are drawn with `RayBatches.draw` or `ViewBatches.draw`. A batch depends only on
    the seed, the rank, the number of batches before it and the state of the LightningModule, so a
    resumed run draws the same rays as an uninterrupted one. The LightningModule specifies batches
    by its attributes ``ray_settings`` (rays or whole views, which and how many) and ``frame``.
    Without them, a batch has 1024 rays through random pixels, in the frame of the scene's cube.
    Batches are endless; an epoch has about as many rays as the training views have pixels.

    `val_dataloader`, `test_dataloader` and `predict_dataloader` serve one whole view per batch, see
    `whole_view`. Validation views are ordered so that the first n are evenly spread for every n
    (`limit_val_batches`). Several processes share the views.

    Args:
        scene: Settings of the scene, or the group ``data`` of a configuration.
        seed: Seed for drawing rays.
        plugins: Names of the user's modules whose classes ``scene`` may name.

    Raises:
        ConfigError: If a setting is invalid, or a plug-in cannot be imported.
    """

    def __init__(
        self,
        scene: SceneSettings | Mapping[str, Any],
        *,
        seed: int = 0,
        plugins: Sequence[str] = (),
    ) -> None:
        super().__init__()
        self.settings = scene if isinstance(scene, SceneSettings) else _settings(scene, plugins)
        self.seed = seed
        if not isinstance(scene, _GivenScene):
            self.save_hyperparameters({"scene": self.settings.plain(), "seed": seed})
        self.drawn = 0
        """Number of batches already drawn."""
        self.holds_out = True
        """Whether training views may be held out for scores."""
        self.held_out = 0
        """Number of training views held out for validation, if the scene has no split for it."""
        self._scene: Scene | None = None
        self._batches: dict[int, tuple[Frame | None, Any, Batches]] = {}

    @property
    def _module(self) -> Any:
        return None if self.trainer is None else self.trainer.lightning_module

    @property
    def rays(self) -> int | None:
        """Number of rays in the next batch, if the LightningModule sets it (``rays``)."""
        return getattr(self._module, "rays", None)

    @property
    def errors(self) -> Tensor | None:
        """Errors by tile, if the LightningModule has an ``error_map``, see `Batches.draw`."""
        return getattr(getattr(self._module, "error_map", None), "errors", None)

    @classmethod
    def of(cls, scene: Scene, *, seed: int = 0) -> "SceneDataModule":
        """Build from a loaded scene of any source.

        Args:
            scene: The scene.
            seed: Seed for drawing rays.
        """
        data = cls.__new__(cls)
        # Not through a subclass, which may have arguments of its own.
        SceneDataModule.__init__(data, _GivenScene.around(scene), seed=seed)
        data.scene = scene
        return data

    @classmethod
    def compose(cls, *overrides: str, seed: int | None = None) -> "SceneDataModule":
        """Build from command-line overrides: ``compose("data=dnerf", "data.scene=hook")``.

        Args:
            *overrides: ``key=value`` each; ``plugins=[MODULE]`` allows classes of your own modules.
            seed: Seed for drawing rays; that of the overrides when None.

        Raises:
            ConfigError: If a setting does not exist or is invalid.
        """
        config = compose_plain("train", overrides)
        own = config["seed"] if seed is None else seed
        return cls(config["data"], seed=own, plugins=config["plugins"] or ())

    @classmethod
    def from_run(cls, run: str | Path, plugins: Sequence[str] = ()) -> "SceneDataModule":
        """Rebuild the data of a run, with its split and resolution.

        Args:
            run: The run directory.
            plugins: Names of the user's modules whose classes the run's settings may name.

        Raises:
            ConfigError: If the folder is not a run directory, or its config.yaml is damaged or
                invalid.
        """
        path = Path(run) / "config.yaml"
        try:
            content = yaml.safe_load(path.read_text(encoding="utf-8"))
            data, seed = content["data"], content["seed"]
        except (OSError, UnicodeDecodeError, yaml.YAMLError, TypeError, KeyError) as error:
            raise ConfigError(
                f"{run} is not a run directory, or its config.yaml is damaged ({error})"
            ) from error
        settings = _settings(data, plugins)
        root = found_root(Path(run), settings.root)
        return cls(replace(settings, root=root), seed=seed)

    @property
    def scene(self) -> Scene:
        """The scene; read on first access.

        Raises:
            SceneError: If it cannot be used.
        """
        if self._scene is None:
            self._scene = self.settings.read()
        return self._scene

    @scene.setter
    def scene(self, scene: Scene) -> None:
        self._scene, self._batches = scene, {}

    def prepare_data(self) -> None:
        self.settings.prepare()

    def setup(self, stage: str) -> None:
        """Read the splits that a stage needs: ``fit``, ``validate``, ``test`` or ``predict``."""
        if stage == "fit":
            # Each module continues its own count of batches.
            self.drawn = getattr(self._module, "batches", self.drawn)
        scores = self.trainer is None or self.trainer.limit_val_batches
        if stage in ("fit", "validate"):
            if (split := self.validation_split) is None:
                # Views that a test will score must not be trained on, either.
                if self.holds_out and (scores or "test" not in self.scene.splits):
                    self._hold_out()
            elif scores:
                self.read_split(split)
        if stage in ("test", "predict"):
            if not {"test", "val"} & self.scene.splits.keys():
                self._hold_out()
            self.read_split(self.test_split)

    @property
    def test_split(self) -> str:
        """The split on which a trained field is scored."""
        return self.settings.eval_split or ("test" if "test" in self.scene.splits else "val")

    @property
    def validation_split(self) -> str | None:
        """The split that is scored during training; None if there are no views for it.

        It is ``test`` only if the settings choose it.
        """
        return self.settings.eval_split or ("val" if "val" in self.scene.splits else None)

    def read_split(self, name: str) -> Views:
        """The views of a split, read now if they have not been read.

        Raises:
            SceneError: If there is none, or it cannot be used.
        """
        if name not in self.scene.splits:
            found = self.settings.read((name,)).splits[name]
            if self.scene.static_reason:
                found = replace(found, times=torch.zeros_like(found.times))
            self._scene = replace(self.scene, splits=self.scene.splits | {name: found})
        return self.scene.splits[name]

    def _hold_out(self) -> None:
        """Hold out training views as a validation split, if there are enough of them."""
        train = self.scene.splits["train"]
        if not may_hold_out(train):
            return
        times, order = train.times.sort(stable=True)
        chosen = torch.zeros(len(train), dtype=torch.bool)
        chosen[order[held_out_places(times.tolist(), HELD_OUT)]] = True
        train, val = (train.subset(part.nonzero()[:, 0]) for part in (~chosen, chosen))
        shared, self.held_out = {*val.files}, len(val)
        # The number of scored views must not change the training views.
        if (most := self.settings.eval_views) is not None:
            val = val.subset(spread(most, len(val)))
        self._scene = replace(
            self.scene,
            splits=self.scene.splits | {"train": train, "val": val},
            video=_without(self.scene.video, shared),
            lrm_views=_without(self.scene.lrm_views, shared),
        )
        self._batches = {}  # Earlier batches included the held-out views.

    def batches(self, rank: int) -> Batches:
        """The batches of a process for the module in training, drawn on its device if possible."""
        batches = self.batches_for(self._module, rank)
        device = getattr(self._module, "device", torch.device("cpu"))
        if isinstance(batches, RayBatches) and DeviceBatches.can_serve(batches, device):
            return DeviceBatches(batches, device)
        return batches

    def batches_for(self, module: Any, rank: int) -> Batches:
        """The batches of a process for a LightningModule, which may specify them."""
        own, settings = getattr(module, "frame", None), getattr(module, "ray_settings", UNIFORM)
        known = self._batches.get(rank)
        # Another module may have another frame or other settings.
        if known is None or known[0] is not own or known[1] != settings:
            views = self.scene.splits["train"]
            frame = own or scene_frame(views, self.settings.hints(self.scene))
            batches = settings.batches(views, frame, seed=self.seed, rank=rank)
            if self.scene.refine_cameras:
                batches.add_slopes()
            self._batches[rank] = known = own, settings, batches
        return known[2]

    def train_dataloader(self) -> DataLoader:
        batches = self.batches(self.trainer.global_rank if self.trainer else 0)
        warnings.filterwarnings("ignore", message=".*`IterableDataset` has `__len__` defined.*")
        warnings.filterwarnings("ignore", message=".*does not have many workers.*")
        return DataLoader(_Endless(batches, self), batch_size=None)

    def val_dataloader(self) -> DataLoader:
        split, tag = self.validation_split, "val"
        if split is None:
            # Test scores must not select a checkpoint, so they get a name that is not monitored.
            split, tag = self.test_split, "test"
        return self._views(split, tag, spread_order(len(self.read_split(split))))

    def test_dataloader(self) -> DataLoader:
        return self._views(self.test_split, "test")

    def predict_dataloader(self) -> DataLoader:
        return self._views(self.test_split, "predict")

    def _views(self, split: str, tag: str, order: Sequence[int] | None = None) -> DataLoader:
        views = self.read_split(split)
        order = sampler = range(len(views)) if order is None else order
        if self.trainer is not None and self.trainer.world_size > 1 and tag != "predict":
            # Each process scores its own views, at least one, or the others would wait forever.
            own = order[self.trainer.global_rank :: self.trainer.world_size]
            sampler = _Divided(own or order[:1])
        dataset = _WholeViews(views, self.scene.background, tag)
        return DataLoader(dataset, batch_size=None, sampler=sampler)

    def state_dict(self) -> dict[str, Any]:
        return {"batches": getattr(self._module, "batches", self.drawn)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.drawn = state_dict["batches"]


class _Endless(IterableDataset):
    """Endless batches from the current position; the length is that of an epoch."""

    def __init__(self, batches: Batches, data: SceneDataModule) -> None:
        self.batches, self.data = batches, data

    def __len__(self) -> int:
        # Given a length, Lightning does not prefetch: each step sets the next number of rays.
        return max(1, self.batches.views.pixels // self.batches.rays)

    def __iter__(self) -> Iterator[Batch]:
        while True:
            step = self.data.drawn
            self.data.drawn += 1
            yield self.batches.draw(step, self.data.rays, self.data.errors)


class _WholeViews(Dataset):
    """Dataset of whole views, see `whole_view`."""

    def __init__(self, views: Views, background: Tensor, tag: str) -> None:
        self.views, self.background, self.tag = views, background, tag

    def __getitem__(self, index: int) -> dict[str, Any]:
        return whole_view(self.views, index, self.background) | {"tag": self.tag}


class _Divided(DistributedSampler):
    """The views of one process, in order; prevents Lightning from dividing them further."""

    def __init__(self, order: Sequence[int]) -> None:
        self.order = order

    def __iter__(self) -> Iterator[int]:
        return iter(self.order)

    def __len__(self) -> int:
        return len(self.order)


def whole_view(views: Views, index: int, background: Tensor) -> dict[str, Any]:
    """A whole view.

    Args:
        views: The views.
        index: Index of the view.
        background: Colour behind the scene. [3]

    Returns:
        Its ``camera``, ``time`` from 0 to 1 [], ``target`` colours on ``background`` [H, W, 3],
        ``alpha`` uint8 [H, W], ``background`` [3], ``index`` and ``file``; if known also
        ``shown``, the pixels that are scored, bool [H, W], and ``foreground``, each
        pixel's coverage by the foreground object, uint8 [H, W].
    """
    item = {
        "camera": views.camera(index),
        "time": views.times[index],
        "target": views.composite(index, background),
        "alpha": views.image(index)[..., 3],
        "background": background,
        "index": index,
        "file": views.files[index],
    }
    more = {"shown": views.shown(index), "foreground": views.foreground_in(index)}
    return item | {name: value for name, value in more.items() if value is not None}


def spread_order(count: int) -> list[int]:
    """An order whose first n elements are evenly spread over the range, for every n.

    Bit-reversed counting (van der Corput): 0, the middle, the quarters, ...
    """
    bits = max(1, (count - 1).bit_length())
    order = (int(f"{place:0{bits}b}"[::-1], 2) for place in range(2**bits))
    return [place for place in order if place < count]


@dataclass(frozen=True, kw_only=True)
class _GivenScene(SceneSettings):
    """Settings for a scene that is already loaded."""

    @classmethod
    def around(cls, scene: Scene) -> "_GivenScene":
        given: dict[str, Any] = dict.fromkeys(entry.name for entry in fields(cls))
        given |= {"name": "given", "root": ".", "scene": scene.name, "train_on_video": False}
        given["refine_cameras"] = scene.refine_cameras
        return cls(**given)

    def load(self, splits: Sequence[str]) -> Scene:
        raise MissingSplitError(
            f"{self.scene}: there are no splits {', '.join(splits)} in this scene"
        )


def _without(views: Views | None, files: set[str]) -> Views | None:
    """Views except those of some files; None if none are left."""
    if views is None or files.isdisjoint(views.files):
        return views
    kept = [index for index, file in enumerate(views.files) if file not in files]
    return views.subset(kept) if kept else None


def found_root(run: Path, root: str) -> str:
    """Folder of a run's scenes; a relative one may refer to the folder where training started."""
    try:
        started = read_json(run / "run.json").get("directory")
    except (OSError, ValueError):
        started = None
    if Path(root).exists() or not isinstance(started, str):
        return root
    there = Path(started) / root
    return str(there) if there.exists() else root


def _settings(node: Mapping[str, Any], modules: Sequence[str]) -> SceneSettings:
    with plugins(modules):
        return build(node, SceneSettings, "data")
