"""Settings of Tensor4D."""

from dataclasses import dataclass

from omegaconf import MISSING


@dataclass
class Tensor4DDensityConfig:
    """The nine planes of Tensor4D with density in place of a surface."""

    family: str = MISSING  # tensor4d or tensor4d_density: chooses the settings' type.
    name: str = MISSING  # Name in run directories and tables.
    resolution: int = MISSING  # Texels along each space axis, coarse level.
    fine_resolution: int = MISSING  # The same, fine level.
    time_resolution: int = MISSING  # Rows of time.
    channels: int = MISSING  # Channels of the coarse planes.
    fine_channels: int = MISSING  # Channels of the fine planes.
    width: int = MISSING  # Neurons of the hidden layers.
    point_octaves: int = MISSING  # Frequencies of the positions' encoding.
    time_octaves: int = MISSING  # Frequencies of the time's encoding.
    direction_octaves: int = MISSING  # Frequencies of the directions' encoding.
    fine_from: int = MISSING  # Step at which the fine level joins.
    blur_until: int = MISSING  # Steps in which planes are averaged down before they are read
    blur_resolution: int = MISSING  # to this many texels.
    learning_rate: float = MISSING  # Of the networks.
    plane_learning_rate: float = MISSING  # Of the planes.
    warmup_steps: int = MISSING  # Steps until the full learning rate; then a cosine
    final_rate: float = MISSING  # to this share of it.


@dataclass
class Tensor4DConfig(Tensor4DDensityConfig):
    """Tensor4D: a surface in canonical space, and a flow that leads there."""

    flow_planes: bool = MISSING  # Train the flow's planes, which the released code forgets.
    radius: float = MISSING  # Of the sphere at the start, the cube being 2 wide.
    sharpness: float = MISSING  # The surface's width at the start is exp(-10 times this).


@dataclass
class Tensor4DDensityLossConfig:
    """The colour's mean squared error, alone."""

    background: str = MISSING  # Behind training rays: white, random, or one (random, per batch).


@dataclass
class Tensor4DLossConfig(Tensor4DDensityLossConfig):
    """Terms of Tensor4D's loss."""

    masked: bool = MISSING  # Compare colours in the silhouettes alone.
    eikonal: float = MISSING  # Weight of the gradient's distance from length 1.
    opacity: float = MISSING  # Weight of the cross entropy between opacity and silhouette.
    smoothness: float = MISSING  # Weight of the change of features over a small distance.
    smoothness_distance: float = MISSING  # That distance, the cube being 2 wide.
