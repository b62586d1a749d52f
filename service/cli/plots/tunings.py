"""Plots tunings and an identified model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import median

import numpy as np
from matplotlib.axes import Axes

from loopwright.service.cli.plots import style
from loopwright.service.inputs.model_json import describe, dump_model
from loopwright.service.offline.csv_record.record import Record
from loopwright.service.offline.recommendation import ranked
from loopwright.service.offline.tunings import MethodResult
from loopwright.tuning.analysis.step_response import Response, step_response
from loopwright.tuning.identification.identify import Identified
from loopwright.tuning.models import Model

HIGHLIGHTED = style.CURVES[:4]
"""Colours and dashes of the methods that are highlighted, the recommended one first."""
SHOWN_SETTLINGS = 2.0
"""Length of the time axis in median settling times, which cuts off the slow loops."""
COVERED = 0.08
"""Largest distance of two answers to a unit step of the set-point that cover each other."""
OUTLIER = 3.0
"""Largest range of the axis in median ranges of the curves; a curve beyond that is cut off."""


def responses(path: Path, model: Model, found: Sequence[MethodResult]) -> None:
    """Plots unit steps of the set-point (left) and of the load (right), PV above MV; unstable loops are left out.

    At most four methods are highlighted, the first ones in the order in which they are recommended whose answers
    differ; the others are grey.
    """
    stable = [each for each in found if each.gains and each.assessment and each.assessment.stable]
    order = ranked({each.method.name: each.assessment for each in stable if each.assessment is not None})
    names = [each.method.name for each in stable]
    chosen = _different(model, stable, [*order, *(name for name in names if name not in order)])
    figure = style.new_figure(12, 7)
    axes = figure.subplots(2, 2, sharex="col", height_ratios=(3, 2))
    for column, load in enumerate((False, True)):
        horizon = _horizon([each for each in stable if each.method.name in chosen], load)
        drawn = {e.method.name: step_response(model, e.gains, horizon, load=load) for e in stable if e.gains}
        for row in (0, 1):
            axes[row, column].set_xlim(0.0, horizon)
            _curves(axes[row, column], drawn, chosen, of_mv=bool(row))
        axes[0, column].set_title(
            "unit step of the load, at the plant's input" if load else "unit step of the set-point", fontsize=10
        )
        axes[0, column].axhline(0.0 if load else 1.0, color=style.SETPOINT, linewidth=0.8, linestyle=":")
        style.plain(axes[0, column], "" if load else "change of PV, PV units")
        style.plain(axes[1, column], "" if load else "change of MV, MV units", "time since the step, s")
    figure.suptitle(_title(model, order, [name for name in names if name not in chosen]), fontsize=10.5)
    style.write(figure, path)


def _different(model: Model, stable: Sequence[MethodResult], order: Sequence[str]) -> list[str]:
    """The methods to highlight, in this order: a curve that covers another tells nothing."""
    gains = {each.method.name: each.gains for each in stable if each.gains}
    if not order:
        return []
    horizon = _horizon([each for each in stable if each.method.name == order[0]], load=False)
    chosen: dict[str, Response] = {}
    for name in order:
        response = step_response(model, gains[name], horizon)
        covers = (np.max(np.abs(response.y - np.interp(response.t, o.t, o.y))) < COVERED for o in chosen.values())
        if len(chosen) < len(HIGHLIGHTED) and not any(covers):
            chosen[name] = response
    return list(chosen)


def _title(model: Model, order: Sequence[str], others: Sequence[str]) -> str:
    lines = [describe(dump_model(model)) + (f"; recommended: {order[0]}" if len(order) > 1 else "")]
    if others:
        lines.append("grey: " + ", ".join(others))
    return "\n".join(lines)


def record_and_model(path: Path, record: Record, found: Identified) -> None:
    """Plots PV as recorded and as modelled, the residual, and MV."""
    figure = style.new_figure(10, 7)
    pv, rest, mv = figure.subplots(3, 1, sharex=True, height_ratios=(4, 1.2, 1.8))
    figure.suptitle(f"{describe(dump_model(found.model))}; fit {found.fit_pct:.1f} %", fontsize=10.5)
    style.measured(pv, record.t, record.y)
    pv.plot(record.t, found.fitted, color=style.AFTER, linewidth=1.1)
    if record.sp is not None:
        pv.step(record.t, record.sp, where="post", color=style.SETPOINT, linestyle=":", linewidth=1.0)
    for load in found.loads:
        pv.axvline(load.seen_s, color=style.LOAD, linewidth=1.0)
        top = pv.get_ylim()[1]
        style.text_at(pv, load.seen_s, top, f"load disturbance {load.size:+.3g} MV units", style.LOAD, below=True)
    _name_record(pv, record)
    style.measured(rest, record.t, record.y - found.fitted)
    rest.axhline(0.0, color=style.AFTER, linewidth=0.8)
    mv.step(record.t, record.u, where="post", color=style.MV, linewidth=1.1)
    pv_unit, mv_unit = record.units.get("y", "PV units"), record.units.get("u", "MV units")
    for axes, label, x in (
        (pv, f"PV, {pv_unit}", ""), (rest, f"residual,\n{pv_unit}", ""), (mv, f"MV, {mv_unit}", "time, s"),
    ):  # fmt: skip
        style.plain(axes, label, x)
    style.write(figure, path)


def _name_record(axes: Axes, record: Record) -> None:
    """Writes what the dots and the lines are into the upper left corner."""
    lines = [("dots: PV recorded", style.MEASURED), ("line: model", style.AFTER)]
    if record.sp is not None:
        lines.append(("dotted: set-point", style.SETPOINT))
    for i, (text, colour) in enumerate(lines):
        axes.text(0.01, 0.97 - 0.07 * i, text, color=colour, fontsize=8.5, va="top", transform=axes.transAxes)


def _curves(axes: Axes, drawn: dict[str, Response], chosen: Sequence[str], of_mv: bool) -> None:
    values = {name: response.u if of_mv else response.y for name, response in drawn.items()}
    for name in drawn:
        if name not in chosen:
            axes.plot(drawn[name].t, values[name], color=style.OTHER, linewidth=0.9, zorder=1)
    for name, (colour, line) in zip(chosen, HIGHLIGHTED, strict=False):
        axes.plot(drawn[name].t, values[name], color=colour, linestyle=line, linewidth=1.6)
    if drawn:
        # one large move of MV must not flatten all other curves
        lows, highs = [float(np.min(each)) for each in values.values()], [float(np.max(e)) for e in values.values()]
        span = max(median(highs) - median(lows), 1e-12)
        low, high = max(min(lows), median(lows) - OUTLIER * span), min(max(highs), median(highs) + OUTLIER * span)
        axes.set_ylim(low - 0.05 * (high - low), high + 0.05 * (high - low))
    if not of_mv:
        named = zip(chosen, HIGHLIGHTED, strict=False)
        style.name_curves(axes, [(name, colour, drawn[name].t, values[name]) for name, (colour, _) in named])


def _horizon(stable: Sequence[MethodResult], load: bool) -> float:
    """Returns the length of the time axis, s: twice the median settling time, at most 1.2 times the longest."""
    times = []
    for each in stable:
        figures = each.assessment and (each.assessment.load if load else each.assessment.setpoint)
        if figures and figures.settling_s:
            times.append(figures.settling_s)
    return min(SHOWN_SETTLINGS * median(times), 1.2 * max(times)) if times else 1.0
