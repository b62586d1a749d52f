"""The before/after picture of a job, from its samples."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure


def before_after(path: Path, title: str, pv_unit: str, stages: dict[str, dict[str, Any]]) -> None:
    """stages: "before" and "after", each the columns of GET /jobs/{id}/samples?stage=..."""
    figure = Figure(figsize=(9, 6), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    top, bottom = figure.subplots(2, 1, sharex=True)
    figure.suptitle(title)
    for (label, columns), colour in zip(stages.items(), ("tab:red", "tab:blue"), strict=False):
        t, sp = columns["t_s"], columns["sp"]
        # Time 0 is the first change of the set-point in the stage.
        start = next((i for i in range(1, len(sp)) if sp[i] != sp[i - 1]), 0)
        shifted = [x - t[start] for x in t] if t else []
        top.plot(shifted, columns["pv"], color=colour, label=f"PV {label}")
        top.step(shifted, sp, color=colour, linestyle=":", linewidth=1, where="post")
        bottom.step(shifted, columns["mv"], color=colour, label=f"MV {label}", where="post")
    top.set_ylabel(f"PV, {pv_unit}")
    bottom.set_ylabel("MV, %")
    bottom.set_xlabel("plant time since the set-point step, s")
    for axes in (top, bottom):
        axes.legend(loc="lower right")
        axes.grid(alpha=0.3)
    canvas.print_figure(path, dpi=110)
