"""The look of all figures: narrow enough for a phone, names beside what they name, error bars."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from runner import RESULTS

from xplanes.files import replacing

WIDTH = 5.2
"""Inches of a figure. At 160 pixels per inch its letters are legible on a screen of 390 pixels."""

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's, which people with any kind of colour vision tell apart."""

OWN = {"X-Planes, nine": 5, "X-Planes": 0, "six planes": 0, "nine planes": 5}
OWN |= {"4D-GS": 1, "K-Planes": 4, "TiNeuVox-S": 2}
"""The same method has the same colour in all figures of methods, by the beginning of its name."""

MARKS = "osD^vPX"

STYLE: Any = {
    "font.size": 10,
    "axes.titlesize": 10,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.alpha": 0.3,
}

Value = tuple[float, float] | None
"""A mean with its standard deviation; None where nothing was measured."""


def panels(
    count: int, height: float, *, width: float = WIDTH, rows: int | None = None, **shared: Any
) -> tuple[Figure, list[Axes]]:
    """A figure whose panels lie one above the other, or in so many rows; sizes in inches."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        rows = rows or count
        axes = list(figure.subplots(rows, count // rows, squeeze=False, **shared).flat)
    return figure, axes


def colours(names: Iterable[str]) -> list[str]:
    """A colour for each line or group: the methods' own if all have one, else one after another."""
    named = list(names)
    found = [next((OWN[key] for key in OWN if name.startswith(key)), None) for name in named]
    if None in found or len(set(found)) < len(found):
        found = [place % len(COLOURS) for place in range(len(named))]
    return [COLOURS[each] for each in found if each is not None]


def curves(axes: Axes, lines: Mapping[str, Sequence[Sequence[float]]]) -> None:
    """Lines of (x, mean, standard deviation), each with its name to the right of its end."""
    ends = []
    for place, (name, tint) in enumerate(zip(lines, colours(lines), strict=True)):
        x, y, spread = zip(*lines[name], strict=True)
        axes.errorbar(x, y, spread, color=tint, marker=MARKS[place % 7], markersize=3, capsize=2)
        ends.append((float(y[-1]), float(x[-1]), name, tint))
    figure = axes.get_figure()
    assert isinstance(figure, Figure)
    low, high = axes.get_ylim()
    apart = 0.17 * (high - low) / max(1.0, figure.get_figheight() / len(figure.axes))
    last = -float("inf")
    for y, x, name, tint in sorted(ends):
        last = max(y, last + apart)
        axes.annotate(
            name,
            (x, y),
            xytext=(1.02, last),
            textcoords=axes.get_yaxis_transform(),
            color=tint,
            va="center",
            annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": tint, "alpha": 0.35, "linewidth": 0.8},
        )


def dots(axes: Axes, labels: Sequence[str], groups: Mapping[str, Sequence[Value]]) -> None:
    """A row for each label, the first at the top, with a dot and its error bar for each group."""
    tints = colours(groups)
    for place, (name, values) in enumerate(groups.items()):
        shift = 0.6 * ((place + 0.5) / len(groups) - 0.5)
        known = [(row + shift, value) for row, value in enumerate(values) if value is not None]
        axes.errorbar(
            [value[0] for _, value in known],
            [row for row, _ in known],
            xerr=[value[1] for _, value in known],
            fmt=MARKS[place % 7],
            color=tints[place],
            markersize=5,
            capsize=2,
            label=name,
        )
    _rows(axes, labels)


def bars(axes: Axes, labels: Sequence[str], groups: Mapping[str, Sequence[float]]) -> None:
    """Horizontal bars from 0, a colour for each group, the first label at the top."""
    thick, tints = 0.8 / len(groups), colours(groups)
    for place, (name, values) in enumerate(groups.items()):
        heights = [row + (place + 0.5) * thick - 0.4 for row in range(len(labels))]
        axes.barh(heights, values, thick, color=tints[place], label=name)
    _rows(axes, labels)


def _rows(axes: Axes, labels: Sequence[str]) -> None:
    axes.set_yticks(range(len(labels)), labels)
    axes.set_ylim(len(labels) - 0.5, -0.5)
    axes.locator_params(axis="x", nbins=6)


def legend(figure: Figure, axes: Axes, columns: int = 2) -> None:
    """What the colours of a panel mean, below all panels and off their data."""
    figure.legend(
        *axes.get_legend_handles_labels(), loc="outside lower center", ncols=columns, frameon=False
    )


def save(figure: Figure, name: str) -> None:
    """Write docs/results/NAME.png, whole or not at all."""
    with (
        matplotlib.rc_context(STYLE),
        replacing(RESULTS / f"{name}.png") as temporary,
    ):
        figure.savefig(temporary, dpi=160, format="png", bbox_inches="tight")
