"""The look that all plots share: legible in grey, thin axes, names at the lines."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from loopwright.service.cli.whole_file import written_whole
from loopwright.tuning.models import Reals

BEFORE, AFTER, MEASURED, SETPOINT, MV, LOAD, OTHER = (
    "#b3402a", "#1f4e9e", "#555555", "#111111", "#2f6b3a", "#c77700", "#c4c4c4",
)  # fmt: skip
LOOKS: dict[str, tuple[str, str | tuple[int, tuple[int, int]]]] = {
    "previous": (BEFORE, (0, (5, 2))), "new": (AFTER, "-")
}  # fmt: skip
"""The colour and the line of what is compared: colours differ in lightness, and curves in their dashes."""
CURVES: tuple[tuple[str, str | tuple[int, tuple[float, ...]]], ...] = (
    (AFTER, "-"), (LOAD, (0, (6, 2))), (MV, (0, (2, 1.5))), ("#8d2f6d", (0, (6, 2, 1, 2))),
    (SETPOINT, (0, (1, 1))), (BEFORE, (0, (10, 2))),
)  # fmt: skip
"""Colours and dashes of curves that stand side by side, the foremost first; more than four are hard to tell apart."""
DPI = 110
MAX_DOTS = 700
"""Number of samples above which an envelope is drawn in place of dots."""
_LABEL_POINTS = 60


def new_figure(width: float, height: float) -> Figure:
    """Returns an empty figure with its canvas; width and height are in inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def write(figure: Figure, path: Path) -> None:
    """Writes a figure to a file in the format of its suffix, the same bytes for the same figure. Raises OSError."""
    undated = {".png": {"Software": None}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
    with written_whole(path) as new, rc_context({"svg.hashsalt": "loopwright"}):
        figure.savefig(new, dpi=DPI, metadata=undated.get(path.suffix.lower()))


def plain(axes: Axes, y: str = "", x: str = "") -> None:
    """Gives axes the look of all: two spines, a faint grid, the quantities named with their units."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("0.4")
    axes.tick_params(colors="0.25", labelsize=8)
    axes.grid(color="0.92", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.set_ylabel(y, fontsize=9)
    axes.set_xlabel(x, fontsize=9)


def measured(axes: Axes, t: Reals, values: Reals, colour: str = MEASURED) -> None:
    """Draws what was measured: a dot for each sample, of many samples the band between minimum and maximum."""
    if len(t) <= MAX_DOTS:
        axes.plot(t, values, ".", color=colour, markersize=2.6, markeredgewidth=0.0)
        return
    block = -(-len(t) // (MAX_DOTS // 2))
    starts = np.arange(0, len(t), block)
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    axes.fill_between(t[starts], low, high, step="post", color=colour, alpha=0.45, linewidth=0.0)


def text_at(axes: Axes, x: float, y: float, text: str, colour: str, below: bool = False) -> None:
    """Writes a name beside a point, on white so that it is read over lines. below: below the point."""
    axes.annotate(
        text, (x, y), xytext=(4, -3 if below else 3), textcoords="offset points", color=colour, fontsize=8.5,
        va="top" if below else "baseline", bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 0.6},
    )  # fmt: skip


def name_curves(axes: Axes, curves: Sequence[tuple[str, str, Reals, Reals]]) -> None:
    """Writes the name of each curve where the curves are farthest apart.

    curves: name, colour, times and values of each.
    """
    left, right = axes.get_xlim()
    low, high = axes.get_ylim()
    at = np.linspace(left + 0.04 * (right - left), left + 0.8 * (right - left), _LABEL_POINTS)
    values = np.array([np.interp(at, t, y) for _, _, t, y in curves])
    inside = np.clip(values, low, high)
    apart = np.min(np.diff(np.sort(inside, axis=0), axis=0), axis=0) if len(curves) > 1 else np.zeros(len(at))
    best = int(np.argmax(apart))
    order = np.argsort(inside[:, best])
    smallest = 0.055 * (high - low)
    y, placed = -np.inf, {}
    for i in order:
        y = max(float(inside[i, best]), y + smallest)
        placed[int(i)] = y
    for i, (name, colour, _, _) in enumerate(curves):
        text_at(axes, float(at[best]), placed[i], name, colour)
