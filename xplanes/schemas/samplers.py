"""Settings of the samplers."""

from dataclasses import dataclass

from omegaconf import MISSING


@dataclass
class SamplerConfig:
    """Where rays are sampled, and which samples are never computed."""

    name: str = MISSING  # Name of the sampler.
    samples: int = MISSING  # Steps along the diagonal of the cube in training.
    render_samples: int = MISSING  # The same in pictures, for scores and films.
    grid_resolution: int = MISSING  # Cells of the occupancy grid along each side.
    time_bins: int = MISSING  # Bins of the occupancy grid along time.
    threshold: float = MISSING  # Opacity of one step below which a cell is empty.
    decay: float = MISSING  # Factor on a cell's density at each look.
    skip_empty: bool = MISSING  # Skip samples in empty cells.
    skip_occluded: bool = MISSING  # Skip samples behind opaque surfaces.
    occlusion: float = MISSING  # Light left behind a surface below which it is opaque.
    thinning: float = MISSING  # Gradients below this times the mean go on at random; 0: all do.
    silhouettes: bool = MISSING  # Rule out cells that the images' alpha shows to be empty.
    fill: bool = MISSING  # Empty cells where a start that is not random shows nothing.
    coarse_steps: int = MISSING  # First steps, in which samples lie twice as far apart.
    sweep_at: list[int] = MISSING  # Steps at which all occupied cells are looked at.
    sweep_every: int = MISSING  # Steps between such sweeps later on.
    update_every: int = MISSING  # Steps between looks at cells that no sample may reach.
    update_cells: int = MISSING  # Cells per look at most.


@dataclass
class ProposalConfig:
    """Samples where small density fields, trained along, expect something."""

    name: str = MISSING  # proposal: chooses the settings' type.
    near: float | None = MISSING  # First sample's distance in world units; null: the cube's.
    far: float | None = MISSING  # Last sample's distance in world units; null: the cube's.
    samples: int = MISSING  # Samples of a ray that reach the field.
    proposal_samples: list[int] = MISSING  # Samples in each density field, in order.
    resolutions: list[int] = MISSING  # Texels along each space axis of each density field.
    time_resolution: int = MISSING  # Rows of time of the density fields.
    channels: int = MISSING  # Channels of their planes.
    width: int = MISSING  # Neurons of their hidden layer.
    linear: bool = MISSING  # Leave out their activation, as the explicit K-Planes does.
    space_low: float = MISSING  # Least start value of their space planes.
    space_high: float = MISSING  # Largest one; time planes start at 1.
    padding: float = MISSING  # Added to each weight before samples are drawn.
    anneal_steps: int = MISSING  # Steps over which the weights' exponent rises to 1.
    anneal_slope: float = MISSING  # How fast it rises at first.
    update_every: int = MISSING  # Steps between the density fields' updates, later on.
    update_warmup: int = MISSING  # Steps over which they grow this rare.
    histogram: float = MISSING  # Weight of the bound on the field's weights.
    variation: str = MISSING  # Form of the total variation: coded or corrected.
    total_variation: float = MISSING  # Weight of squared differences between texels.
    time_smoothness: float = MISSING  # Weight of squared second differences along time.
    time_identity: float = MISSING  # Weight of the time planes' distance from 1.
    learning_rate: float = MISSING  # Of the density fields.


@dataclass
class FixedStepConfig:
    """Equal steps through a field's box; samples that add nothing get no colour."""

    name: str = MISSING  # fixed_step: chooses the settings' type.
    near: float = MISSING  # First sample's distance in world units.
    far: float = MISSING  # Last sample's distance in world units.
    step: float = MISSING  # Distance between samples, in cells of the field.
    threshold: float = MISSING  # Opacity, and weight, at which samples are dropped.


@dataclass
class NeusConfig:
    """Samples near a surface, which a coarse round finds."""

    name: str = MISSING  # neus: chooses the settings' type.
    samples: int = MISSING  # Equal steps of the coarse round.
    more_samples: int = MISSING  # Samples that it adds near the surface.
    coarse_sharpness: float = MISSING  # Sharpness at which it looks for the surface.


def occupancy_conflict(sampler: SamplerConfig) -> str | None:
    """What is wrong with an occupancy grid's settings, in words; None for nothing."""
    if sampler.occlusion >= 1:
        return (
            f"sampler.occlusion={sampler.occlusion}: must be below 1, or no light counts as "
            "seen; 1e-5 is the default, sampler.skip_occluded=false skips nothing"
        )
    if sampler.threshold >= 1:
        return f"sampler.threshold={sampler.threshold}: must be below 1, or nothing is seen"
    if sampler.grid_resolution**3 * sampler.time_bins > 2**28:
        return (
            f"sampler.grid_resolution={sampler.grid_resolution} with sampler.time_bins="
            f"{sampler.time_bins}: more than 268 million cells; lower one of them"
        )
    return None


def fixed_step_conflict(sampler: FixedStepConfig) -> str | None:
    """What is wrong with a fixed-step sampler's settings, in words; None for nothing."""
    if sampler.near >= sampler.far:
        return f"sampler.near={sampler.near}: must be below sampler.far={sampler.far}"
    if sampler.threshold >= 1:
        return f"sampler.threshold={sampler.threshold}: must be below 1, or nothing is seen"
    return None


def proposal_conflict(sampler: ProposalConfig) -> str | None:
    """What is wrong with a proposal sampler's settings, in words; None for nothing."""
    if len(sampler.proposal_samples) != len(sampler.resolutions):
        return (
            f"sampler.proposal_samples={sampler.proposal_samples} with sampler.resolutions="
            f"{sampler.resolutions}: one number for each density field in both"
        )
    if (sampler.near is None) != (sampler.far is None):
        return (
            f"sampler.near={sampler.near} with sampler.far={sampler.far}: set both in world units, "
            "or both to null for the field's cube"
        )
    if sampler.near is not None and sampler.far is not None and sampler.near >= sampler.far:
        return f"sampler.near={sampler.near}: must be below sampler.far={sampler.far}"
    return None
