"""Plots tunings and an identified model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import median

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from loopwright.service.inputs.model_json import describe, dump_model
from loopwright.service.offline.csv_record.record import Record
from loopwright.service.offline.tunings import MethodResult
from loopwright.tuning.analysis.step_response import Response, step_response
from loopwright.tuning.identification.identify import Identified
from loopwright.tuning.models import Model
from loopwright.tuning.rules.registry import METHODS

_COLOURS = colormaps["tab10"]
_LINES = ("-", "--", ":", "-.")
SHOWN_SETTLINGS = 2.0
"""Length of the time axis in median settling times, which cuts off the slow loops."""
OUTLIER = 3.0
"""Largest range of the axis in median ranges of the curves; a curve beyond that is cut off."""


def responses(path: Path, model: Model, found: Sequence[MethodResult]) -> None:
    """Plots unit steps of the set-point (left) and of the load (right), PV above MV; unstable loops are left out."""
    stable = [each for each in found if each.gains and each.assessment and each.assessment.stable]
    figure = Figure(figsize=(13, 7.5), layout="constrained")
    axes = figure.subplots(2, 2, sharex="col")
    for column, load in enumerate((False, True)):
        horizon = _horizon(stable, load)
        drawn = [step_response(model, each.gains, horizon, load=load) for each in stable if each.gains]
        for row in (0, 1):
            _curves(axes[row, column], drawn, [each.method.name for each in stable], of_mv=bool(row))
        axes[0, column].set_title(
            "unit step of the load, at the plant's input" if load else "unit step of the set-point"
        )
        axes[0, column].axhline(0.0 if load else 1.0, color="black", linewidth=0.8, linestyle=":")
        axes[1, column].set_xlabel("time since the step, s")
        axes[1, column].set_xlim(0.0, horizon)
    axes[0, 0].set_ylabel("change of PV, PV units")
    axes[1, 0].set_ylabel("change of MV, MV units")
    figure.suptitle(describe(dump_model(model)))
    if stable:
        figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside right upper", fontsize=10)
    figure.savefig(path, dpi=110)


def record_and_model(path: Path, record: Record, found: Identified) -> None:
    """Plots PV as recorded and as modelled, the residual, and MV."""
    figure = Figure(figsize=(10, 7.5), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True, height_ratios=(3, 1, 1.5))
    axes[0].plot(record.t, record.y, color="0.6", linewidth=1.0, label="PV recorded")
    axes[0].plot(record.t, found.fitted, color="tab:blue", linewidth=1.3, label=f"model, fit {found.fit_pct:.1f} %")
    if record.sp is not None:
        axes[0].step(record.t, record.sp, where="post", color="black", linestyle=":", linewidth=1.0, label="set-point")
    for load in found.loads:
        axes[0].axvline(
            load.seen_s, color="tab:orange", linewidth=1.2, label=f"load disturbance {load.size:+.3g} MV units"
        )
    axes[0].set_ylabel("PV, PV units")
    axes[0].legend(loc="best")
    axes[1].plot(record.t, record.y - found.fitted, color="tab:red", linewidth=0.8)
    axes[1].set_ylabel("residual,\nPV units")
    axes[2].step(record.t, record.u, where="post", color="tab:green")
    axes[2].set_ylabel("MV, MV units")
    axes[2].set_xlabel("time, s")
    for each in axes:
        each.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def _curves(axes: Axes, drawn: Sequence[Response], names: Sequence[str], of_mv: bool) -> None:
    lows, highs = [], []
    for response, name in zip(drawn, names, strict=True):
        values = response.u if of_mv else response.y
        # a method has the same colour in every plot
        i = list(METHODS).index(name)
        style = _LINES[i // 10 % len(_LINES)]
        axes.plot(response.t, values, label=name, linewidth=1.4, color=_COLOURS(i % 10), linestyle=style)
        lows.append(float(np.min(values)))
        highs.append(float(np.max(values)))
    axes.grid(alpha=0.3)
    if drawn:
        # one large move of MV must not flatten all other curves
        span = max(median(highs) - median(lows), 1e-12)
        low, high = max(min(lows), median(lows) - OUTLIER * span), min(max(highs), median(highs) + OUTLIER * span)
        axes.set_ylim(low - 0.05 * (high - low), high + 0.05 * (high - low))


def _horizon(stable: Sequence[MethodResult], load: bool) -> float:
    """Returns the length of the time axis, s: twice the median settling time, at most 1.2 times the longest."""
    times = []
    for each in stable:
        figures = each.assessment and (each.assessment.load if load else each.assessment.setpoint)
        if figures and figures.settling_s:
            times.append(figures.settling_s)
    return min(SHOWN_SETTLINGS * median(times), 1.2 * max(times)) if times else 1.0
