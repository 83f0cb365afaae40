"""Settings of TiNeuVox."""

from dataclasses import dataclass

from omegaconf import MISSING


@dataclass
class TiNeuVoxConfig:
    """TiNeuVox: a grid of features in canonical space, a deformation, and small networks."""

    family: str = MISSING  # tineuvox: chooses the settings' type.
    name: str = MISSING  # Name in run directories and tables.
    near: float = MISSING  # The grid's box holds what the cameras see from here, in world units,
    far: float = MISSING  # to here,
    margin: float = MISSING  # and this many times as much.
    half_side: float | None = MISSING  # Half the side of a cube about the origin instead of that.
    resolution: int = MISSING  # Cube root of the number of cells in the end.
    channels: int = MISSING  # Channels of a cell.
    width: int = MISSING  # Neurons of the hidden layers.
    alpha_start: float = MISSING  # Opacity of one cell at the start.
    point_octaves: int = MISSING  # Frequencies of the positions' encoding.
    time_octaves: int = MISSING  # Frequencies of the time's encoding.
    direction_octaves: int = MISSING  # Frequencies of the directions' encoding.
    feature_octaves: int = MISSING  # Frequencies of the features' encoding.
    grow_at: list[int] = MISSING  # Steps at which the number of cells doubles.
    grid_learning_rate: float = MISSING  # Of the grid.
    deformation_learning_rate: float = MISSING  # Of the deformation.
    network_learning_rate: float = MISSING  # Of the other networks.
    decay_steps: int = MISSING  # Steps in which learning rates fall to a tenth.


@dataclass
class TiNeuVoxLossConfig:
    """Terms of TiNeuVox' loss beyond the colour's mean squared error."""

    background: str = MISSING  # Behind training rays: white, random, or one (random, per batch).
    entropy: float = MISSING  # Weight of the entropy of the light that passes each ray.
    sample_colour: float = MISSING  # Weight of the squared errors of single samples' colours.
