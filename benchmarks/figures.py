"""Plots of the benchmarks: one look, written whole or not at all."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from runner import RESULTS

from xplanes.files import replacing


def panels(
    count: int, width: float, height: float, *, rows: int = 1, **shared: bool
) -> tuple[Figure, list[Axes]]:
    """A figure with rows of panels, each with a grid; sizes in inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = list(figure.subplots(rows, count // rows, squeeze=False, **shared).flat)
    for one in axes:
        one.grid(alpha=0.3)
        one.set_axisbelow(True)
    return figure, axes


def bars(axes: Axes, labels: list[str], groups: dict[str, list[float]], start: float = 0) -> None:
    """Horizontal bars from ``start``, a colour for each group, the first label at the top."""
    thick = 0.8 / len(groups)
    for place, (name, values) in enumerate(groups.items()):
        heights = [row + (place + 0.5) * thick - 0.4 for row in range(len(labels))]
        lengths = [value - start for value in values]
        axes.barh(heights, lengths, thick, left=start, label=name)
    axes.set_yticks(range(len(labels)), labels)
    axes.set_ylim(len(labels) - 0.5, -0.5)
    axes.axvline(start, color="0.3", linewidth=0.8)
    axes.locator_params(axis="x", nbins=6)


def save(figure: Figure, name: str) -> None:
    """Write docs/results/NAME.png."""
    with replacing(RESULTS / f"{name}.png") as temporary:
        figure.savefig(temporary, dpi=110, format="png")
