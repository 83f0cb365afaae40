"""Settings of K-Planes."""

from dataclasses import dataclass

from omegaconf import MISSING


@dataclass
class KPlanesConfig:
    """K-Planes: products of planes at several scales, and a small decoder."""

    family: str = MISSING  # kplanes: chooses the settings' type.
    name: str = MISSING  # Name in run directories and tables.
    variant: str = MISSING  # hybrid (MLPs) or explicit (linear, colour bases by direction).
    half_side: float | None = MISSING  # Half its cube's side, about the origin; null: the scene's.
    resolution: int = MISSING  # Texels along each space axis, at the first scale.
    scales: list[int] = MISSING  # Factors on the resolution; the time axis keeps its rows.
    time_resolution: int | None = MISSING  # Rows of time; null: half the training views.
    channels: int = MISSING  # Channels of each plane and scale.
    space_low: float = MISSING  # Least start value of the space planes.
    space_high: float = MISSING  # Largest one; time planes start at 1.
    width: int = MISSING  # Neurons of the hidden layers.
    learning_rate: float = MISSING  # Of all parameters.
    warmup_steps: int = MISSING  # Steps until the full learning rate; then half a cosine to 0.


@dataclass
class KPlanesLossConfig:
    """Terms of K-Planes' loss beyond the colour's mean squared error."""

    background: str = MISSING  # Behind training rays: white, random, or one (random, per batch).
    variation: str = MISSING  # Form of the total variation: coded, or corrected (as in the paper).
    total_variation: float = MISSING  # Weight of squared differences between texels.
    time_smoothness: float = MISSING  # Weight of squared second differences along time.
    time_identity: float = MISSING  # Weight of the time planes' distance from 1.
