"""Every setting, typed. The values live in conf/, one YAML group per thing a user varies."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

from omegaconf import MISSING, DictConfig, OmegaConf

from xplanes.schemas import families
from xplanes.schemas.samplers import SamplerConfig


class ConfigError(ValueError):
    """A setting that cannot work; the message names the key, the value and the way out."""


@dataclass
class DataConfig:
    """A scene on disk in the format of D-NeRF or Blender."""

    name: str = MISSING  # Kind of data: demo or dnerf.
    root: str = MISSING  # Folder that holds the scenes.
    scene: str = MISSING  # Folder of the scene, or name of the demo scene.
    resolution: int | None = MISSING  # Pixels per side; null keeps the native size.
    views: int | None = MISSING  # Training views kept, spread over time; null keeps all.
    train_on_video: bool = MISSING  # Train on the frames of the scene's fixed camera too.
    still: bool | None = MISSING  # Nothing moves; null: where the fixed camera's frames are equal.
    eval_split: str = MISSING  # Split that is scored: test or val.
    eval_views: int | None = MISSING  # Views of it, spread over time; null takes all.
    half_side: float | None = MISSING  # Half the side of the scene's cube; null finds it.
    background_share: float = MISSING  # Share of rays drawn far from the silhouettes.
    background_jitter: float = MISSING  # Share of all time by which their times are moved at most.
    skip_background: bool = MISSING  # Draw rays near the silhouettes more often than elsewhere.


@dataclass
class DemoConfig(DataConfig):
    """A procedural scene, rendered on first use."""

    seed: int = MISSING  # Varies colours, motion and cameras.
    train_views: int = MISSING  # Training views, each at its own time.
    test_views: int = MISSING  # Test views, at times of their own.
    val_views: int = MISSING  # Validation views.


@dataclass
class DecoderConfig:
    """The MLP from features to colour and density."""

    width: int = MISSING  # Neurons of each hidden layer.
    hidden: int = MISSING  # Hidden layers.
    activation: str = MISSING  # Between layers: relu or silu.
    density: str = MISSING  # Activation of the density: softplus or exp.
    density_scale: float = MISSING  # Factor on the density.
    density_start: float = MISSING  # Start of the density logit; lower is emptier.
    colour_margin: float = MISSING  # How far colours may pass 0 and 1.
    freeze: bool = MISSING  # Keep the decoder as it starts.


@dataclass
class ModelConfig:
    """The field: planes and decoder."""

    name: str = MISSING  # Name in run directories and tables.
    plane_set: str = MISSING  # six, nine, or three (no time).
    resolution: int = MISSING  # Texels along each space axis.
    time_resolution: int | None = MISSING  # Rows of time; null: half as many as distinct times.
    channels: int = MISSING  # Channels of each plane.
    space_scale: float = MISSING  # Standard deviation of the space planes at the start.
    time_scale: float = MISSING  # Standard deviation of the time planes at the start.
    decoder: DecoderConfig = field(default_factory=DecoderConfig)


@dataclass
class LRMConfig:
    """The Large Reconstruction Model that starts the planes."""

    name: str = MISSING  # none starts them at random.


@dataclass
class TriplaneFileConfig(LRMConfig):
    """A triplane sequence that was computed before, from a file."""

    triplanes: str | None = MISSING  # File written by save_triplanes.


@dataclass
class ImageLRMConfig(LRMConfig):
    """A model, and how it meets the scene's pictures."""

    weights: str | None = MISSING  # A local file instead.
    matching: str = MISSING  # Where focal lengths differ: scale, or pad the pictures (exact).
    crop: bool = MISSING  # Show the model the object at the size that it was trained with.
    batch: int = MISSING  # Pictures at a time.
    precision: str = MISSING  # 32, bf16, or auto: bf16 where the hardware has it.


@dataclass
class BundledLRMConfig(ImageLRMConfig):
    """A model of the package, or with `weights` one of the same form."""

    bundled: str = MISSING  # Name of its files in the package.


@dataclass
class PretrainedLRMConfig(ImageLRMConfig):
    """A published model."""

    architecture: str = MISSING  # One of openlrm-{small,base,large}-{1.0,1.1} and triposr.
    repository: str = MISSING  # On the Hugging Face hub.
    file: str = MISSING  # Name of the weights there.
    revision: str = MISSING  # Branch, tag or commit there.
    licence: str = MISSING  # Of the weights.
    megabytes: int = MISSING  # Size of the file.
    config: str | None = MISSING  # A config.json or config.yaml for weights of other sizes.


@dataclass
class DecompositionConfig:
    """From a triplane sequence to low-rank and sparse parts, and from these to planes."""

    name: str = MISSING  # Name of the settings.
    method: str = MISSING  # adaptive, growing, admm (the paper's) or exact (slow).
    sparsity_weight: int | float | str = MISSING  # Weight of the sparse part; auto fits the size.
    penalty: float = MISSING  # Penalty of ADMM; where adaptive starts.
    scale: str = MISSING  # Unit of the penalty: rms of the features, or none.
    tolerance: float = MISSING  # Relative residual at which it stops.
    max_iterations: int = MISSING  # Iterations at most.
    static: str = MISSING  # Space planes from the low-rank part: median, mean or middle frame.
    dynamic: str = MISSING  # Time planes: rank1 fits the sparse part, random starts near zero.
    noise: float = MISSING  # Standard deviation of the time planes' noise.
    cache: bool = MISSING  # Keep the parts in preparation.cache (twice the triplanes' size).


@dataclass
class PreparationConfig:
    """What happens before training, for a start that is not random."""

    cache: str | None = MISSING  # Folder for finished stages; null computes them anew.
    frames: int = MISSING  # Moments of the fixed view.
    fixed_view: str = MISSING  # The scene's video, train (a field films it), or auto.
    fixed_view_model: str = MISSING  # The model that films it: a file of conf/model.
    fixed_view_seconds: float = MISSING  # Training clock of the field that films it.
    fixed_view_steps: int = MISSING  # Its steps at most.
    azimuth: float | None = MISSING  # The filming camera, degrees from x to y; null: an axis.
    elevation: float = MISSING  # Its height angle in degrees.


@dataclass
class LossConfig:
    """Terms of the loss beyond the colour's mean squared error."""

    background: str = MISSING  # Behind training rays: white, random, or one (random, per batch).
    total_variation: float = MISSING  # Weight of squared differences between texels.
    time_smoothness: float = MISSING  # Weight of squared second differences along time.
    time_magnitude: float = MISSING  # Weight of squared values of the time planes.
    sparse_weight: float = MISSING  # Weight of L_r: time planes' products near what moves.
    sparse_frames: int = MISSING  # Random frames per application of L_r.
    start_weight: float = MISSING  # Pull to a start's planes, over the number of views squared.
    start_steps: int | None = MISSING  # Steps times views until L_r and the pull end; null: never.
    every: int = MISSING  # Steps between applications of these, at as many times the weight.


@dataclass
class TrainerConfig:
    """Budget, optimiser, evaluation and hardware."""

    name: str = MISSING  # Name of the hardware setting.
    accelerator: str = MISSING  # auto, cpu or gpu.
    devices: int = MISSING  # Processes; rays are split between them.
    strategy: str = MISSING  # auto, or ddp for several devices.
    precision: str = MISSING  # Of the decoder: 32, bf16, or auto: bf16 where the hardware has it.
    max_steps: int = MISSING  # Steps at most.
    max_seconds: float | None = MISSING  # Training clock at most; null for no limit.
    plateau: float | None = MISSING  # End when twice the steps gain fewer dB; null: never.
    rays_per_batch: int = MISSING  # Rays of a step at most.
    samples_per_batch: int = MISSING  # Samples of a step at most, on average.
    accumulate: int = MISSING  # Batches per optimiser step.
    plane_lr: float = MISSING  # Learning rate of the space planes.
    time_lr: float = MISSING  # Learning rate of the time planes.
    decoder_lr: float = MISSING  # Learning rate of the decoder.
    warmup_steps: int = MISSING  # Steps until the full learning rate.
    final_lr: float = MISSING  # Share of the learning rate left at the end.
    checkpoint_every: int = MISSING  # Steps between checkpoints.
    evaluate_at: list[float] = MISSING  # Shares of the budget at which the views are scored.
    evaluate_views: int | None = MISSING  # Views scored on the way; null scores all.
    log_every: int = MISSING  # Steps between TensorBoard scalars.
    deterministic: bool = MISSING  # The same digits each time; CPU only, budget in steps.
    media: bool = MISSING  # Write the turning render at the end.


@dataclass
class TrainConfig:
    """The whole configuration of a run."""

    seed: int = MISSING  # Source of all randomness.
    resume: str | None = MISSING  # A run directory to go on with, or auto.
    data: Any = MISSING
    model: Any = MISSING
    lrm: Any = MISSING
    preparation: PreparationConfig = field(default_factory=PreparationConfig)
    decomposition: DecompositionConfig = field(default_factory=DecompositionConfig)
    sampler: Any = MISSING
    loss: Any = MISSING
    trainer: TrainerConfig = field(default_factory=TrainerConfig)


XPLANES = families.Family(ModelConfig, LossConfig, ("occupancy", "proposal"))
"""The family of models without ``model.family``."""

SCHEMAS: dict[tuple[str | None, str], type] = {
    (None, "train_schema"): TrainConfig,
    ("data", "dnerf_schema"): DataConfig,
    ("data", "demo_schema"): DemoConfig,
    ("model", "xplanes_schema"): ModelConfig,
    ("lrm", "lrm_schema"): LRMConfig,
    ("lrm", "file_schema"): TriplaneFileConfig,
    ("lrm", "bundled_lrm_schema"): BundledLRMConfig,
    ("lrm", "pretrained_lrm_schema"): PretrainedLRMConfig,
    ("preparation", "preparation_schema"): PreparationConfig,
    ("decomposition", "decomposition_schema"): DecompositionConfig,
    ("sampler", "occupancy_schema"): SamplerConfig,
    ("loss", "loss_schema"): LossConfig,
    ("trainer", "trainer_schema"): TrainerConfig,
    **families.SCHEMAS,
}
"""Schema by configuration group and the name under which its YAML files inherit it."""


@cache
def register_schemas() -> None:
    """Make the schemas known to Hydra; calling it again changes nothing."""
    from hydra.core.config_store import ConfigStore

    store = ConfigStore.instance()
    for (group, name), schema in SCHEMAS.items():
        store.store(group=group, name=name, node=schema)


_PACKAGE = Path(__file__).resolve().parent
CONF = _PACKAGE / "conf" if (_PACKAGE / "conf").is_dir() else _PACKAGE.parent / "conf"
"""The configuration files: inside an installed package, beside it in a checkout."""


def compose_plain(name: str, overrides: Sequence[str], conf: Path = CONF) -> dict[str, Any]:
    """A configuration with some settings changed, resolved to builtins.

    Args:
        name: Its file in ``conf``, without ending.
        overrides: ``key=value`` each.
        conf: The configuration folder.

    Raises:
        ConfigError: For a key or option that does not exist, or a value of another type.
    """
    from hydra import compose, initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.singleton import Singleton
    from hydra.errors import HydraException

    register_schemas()
    # Inside a job there is a Hydra already, which must be there again afterwards.
    outer = Singleton.get_state()
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(conf), version_base="1.3"):
            return to_plain(compose(name, list(overrides)))
    except HydraException as error:
        raise ConfigError(f"{error}. All settings are in docs/configuration.md") from error
    finally:
        Singleton.set_state(outer)


def to_plain(config: DictConfig) -> dict[str, Any]:
    """The resolved configuration as dicts, lists, numbers and strings, without Hydra's part."""
    plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    assert isinstance(plain, dict)
    plain.pop("hydra", None)
    return {str(key): value for key, value in plain.items()}


def build(schema: type, values: dict[str, Any]) -> Any:
    """A plain dict as an instance of its schema, nested schemas included."""
    arguments = {}
    for entry in fields(schema):
        value = values[entry.name]
        inner = entry.type
        arguments[entry.name] = (
            build(inner, value) if is_dataclass(inner) and isinstance(inner, type) else value
        )
    return schema(**arguments)
