"""Plots a fast job: the loop before and after with what changed in numbers, and below it the test as evidence.

A refused job has the record alone, with an arrow where the model explains it least.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from loopwright.service.cli.plots import style
from loopwright.service.cli.plots.shown import Shown
from loopwright.service.jobs.stored_record import StoredRecord
from loopwright.service.planning.curves import LOAD_PCT
from loopwright.service.results import EvidenceView
from loopwright.tuning.analysis.assessment import Assessment, assess
from loopwright.tuning.analysis.step_figures import StepFigures
from loopwright.tuning.analysis.step_response import Response, step_response
from loopwright.tuning.fast.evaluation.proposal import delayed
from loopwright.tuning.fast.structure_choice import choose_structure
from loopwright.tuning.gains import Gains
from loopwright.tuning.identification.output_error import Fit, averaged
from loopwright.tuning.models import Model, Reals, sign
from loopwright.tuning.reasons import Ended

SHOWN_SETTLINGS, MAX_SHOWN_SETTLINGS = 2.5, 6.0
"""Lengths of the time axis of a step, in settling times of the loop that settles sooner: one at which its transient
still fills the picture, and the longest, where the other loop settles later."""


def fast_job(path: Path, job: Shown, record: StoredRecord, pv_unit: str) -> None:
    """Writes the plot of a fast job to a file.

    job: the job, however it ended.
    record: the record of its experiment.
    """
    fitted = _fitted(record)
    rows = [4.0, 1.1, 1.5] if fitted else [4.0, 1.5]
    if job.new_gains is None:
        figure = style.new_figure(9.5, 6.5)
        why = f", {job.reason}" if job.reason and job.reason.value != job.state.value else ""
        title = f"{job.loop}: {job.state}{why}"
        figure.suptitle("\n".join([title, *textwrap.wrap(job.detail or "", 115)]), fontsize=10)
        if job.advice:
            figure.supxlabel("\n".join(textwrap.wrap(f"Advice: {job.advice}", 120)), fontsize=9)
        evidence = figure.subplots(len(rows), 1, sharex=True, height_ratios=rows)
    else:
        figure = style.new_figure(11, 10)
        parts = figure.add_gridspec(2, 1, height_ratios=(1.15, 1.0))
        top, bottom = figure.add_subfigure(parts[0]), figure.add_subfigure(parts[1])
        before_after(top, job, pv_unit)
        bottom.suptitle("the test that this rests on", fontsize=10)
        evidence = bottom.subplots(len(rows), 1, sharex=True, height_ratios=rows)
    _record(list(evidence), record, fitted, job, pv_unit)
    style.write(figure, path)


def before_after(figure: Figure | SubFigure, job: Shown, pv_unit: str) -> None:
    """Plots a step of the set-point, of the size tested, and one of the load, computed on the model found.

    figure: a figure or a part of one.
    """
    assert job.model is not None and job.previous_gains is not None and job.new_gains is not None
    # with half a sample of delay, as the figures of the job
    model = delayed(job.model.process_model(), 0.5 * (job.sample_time_s or 0.0))
    turned = sign(model)  # the responses are of a plant of positive gain
    # method setpoint steps home, which is mostly down
    size = 1.0 if job.verification is None else abs(job.verification.step or 1.0)
    gains = {label: shown.gains() for label, shown in (("previous", job.previous_gains), ("new", job.new_gains))}
    assessed = {label: assess(model, each) for label, each in gains.items()}
    figure.suptitle(f"{job.loop}: {_changes(gains, assessed)}", fontsize=10.5)
    axes = figure.subplots(2, 2, sharex="col", height_ratios=(3, 1.4))
    for column, load in enumerate((False, True)):
        pv, mv = axes[0, column], axes[1, column]
        horizon = _horizon(model, assessed, load)
        curves = _answers(model, gains, assessed, horizon, load)
        scale = turned * LOAD_PCT if load else size
        pv.set_xlim(0.0, horizon)
        for label, response in curves.items():
            colour, line = style.LOOKS[label]
            pv.plot(response.t, scale * response.y, color=colour, linestyle=line, linewidth=1.6)
            moved = turned * (LOAD_PCT if load else size) * response.u
            mv.plot(response.t, moved, color=colour, linestyle=line, linewidth=1.3)
        pv.axhline(0.0 if load else size, color=style.SETPOINT, linestyle=":", linewidth=0.9)
        for each in () if load else (pv, mv):
            low, high = each.get_ylim()
            each.set_ylim(max(low, -2.0 * abs(high)), high)
        style.name_curves(pv, [(label, style.LOOKS[label][0], r.t, scale * r.y) for label, r in curves.items()])
        for label in sorted(gains.keys() - curves.keys()):
            pv.text(0.5, 0.9, f"{label}: unstable", color=style.LOOKS[label][0], fontsize=9, transform=pv.transAxes)
        what = f"load step of {LOAD_PCT:g} % of MV" if load else f"set-point step of {size:.3g} {pv_unit}"
        pv.set_title(f"{what}, computed with the model", fontsize=9.5)
        style.plain(pv, "" if load else f"change of PV, {pv_unit}")
        style.plain(mv, "" if load else "change of MV, %", "time since the step, s")


def _changes(gains: Mapping[str, Gains], assessed: Mapping[str, Assessment]) -> str:
    """The gains before and after, and how the figures changed, in numbers."""
    old, new = gains["previous"], gains["new"]
    parts = [f"Kp {old.Kp:.3g} → {new.Kp:.3g}, Ti {old.Ti:.3g} → {new.Ti:.3g} s"]
    if old.Td or new.Td:
        parts[0] += f", Td {old.Td:.3g} → {new.Td:.3g} s"
    if old.b != 1.0 or new.b != 1.0:
        parts[0] += f", b {old.b:.3g} → {new.b:.3g}"
    before, after = assessed["previous"], assessed["new"]
    if before.margins.Ms and after.margins.Ms and before.stable:
        parts.append(f"Ms {before.margins.Ms:.2f} → {after.margins.Ms:.2f}")
    figures: list[str] = []
    for name, was, now in (("set-point", before.setpoint, after.setpoint), ("load", before.load, after.load)):
        if was and now:
            figures.append(f"IAE of the {name} {_percent(was, now)}")
    if before.setpoint and after.setpoint:
        figures.append(f"overshoot {before.setpoint.overshoot_pct:.0f} → {after.setpoint.overshoot_pct:.0f} %")
    return ", ".join(parts) + ("\n" + ", ".join(figures) if figures else "")


def _percent(before: StepFigures, after: StepFigures) -> str:
    return f"{100.0 * (after.IAE / before.IAE - 1.0):+.0f} %"


def _horizon(model: Model, assessed: Mapping[str, Assessment], load: bool) -> float:
    """Returns the length of the time axis, s: both loops have settled at its end, where one of them does not settle
    much later than the other."""
    figures = [each.load if load else each.setpoint for each in assessed.values()]
    settled = [each.settling_s for each in figures if each and each.settling_s]
    if not settled:
        return 20.0 * (model.L + 1.0)
    soonest = min(settled)
    return float(np.clip(max(settled), SHOWN_SETTLINGS * soonest, MAX_SHOWN_SETTLINGS * soonest))


def _answers(
    model: Model, gains: Mapping[str, Gains], assessed: Mapping[str, Assessment], horizon: float, load: bool
) -> dict[str, Response]:
    """The answers of the loop under the gains with which it is stable."""
    found = {}
    for label, each in gains.items():
        if assessed[label].stable:
            try:
                found[label] = step_response(model, each, horizon, load=load)
            except Ended:
                continue
    return found


def _fitted(record: StoredRecord) -> tuple[Reals, Reals, Reals, float] | None:
    """Times, PV of the model and residual, and two standard deviations of the noise; None without a fit."""
    evidence = record.experiment_record()
    if evidence is None:
        return None
    fit = Fit(evidence)
    residual = choose_structure(fit).best.linear.residual * evidence.output_range
    at = averaged(record.t[: len(fit.u)], fit.block)
    return at, fit.y * evidence.output_range - residual + record.rest[1], residual, 2.0 * evidence.noise


def _record(
    axes: list[Axes], record: StoredRecord, fitted: tuple[Reals, Reals, Reals, float] | None, job: Shown, pv_unit: str
) -> None:
    """Plots PV with the model, the residual where there is a model, and MV; the phases of the test are named."""
    t = record.t
    pv, mv = axes[0], axes[-1]
    style.measured(pv, t, record.pv)
    pv.step(t, record.sp, where="post", color=style.SETPOINT, linestyle=":", linewidth=1.0)
    mv.step(t, record.mv, where="post", color=style.MV, linewidth=1.0)
    names = "grey: PV measured, dotted: set-point"
    if fitted is not None:
        at, model, residual, noise = fitted
        pv.plot(at, model, color=style.AFTER, linewidth=1.1)
        names += ", line: model"
        rest = axes[1]
        rest.axhspan(-noise, noise, color="0.9", zorder=0)
        style.measured(rest, at, residual)
        style.plain(rest, "residual")
        if job.new_gains is None:
            _point_out(rest, at, residual, noise)
    style.plain(pv, f"PV, {pv_unit}")
    style.plain(mv, "MV, %", f"plant time since the start of the {record.excitation.in_words}, s")
    pv.set_xlim(t[0], t[-1])
    low, high = pv.get_ylim()
    pv.set_ylim(low, high + 0.14 * (high - low))  # room for the names of the phases
    pv.text(0.005, 0.02, names, fontsize=8, color=style.MEASURED, transform=pv.transAxes)
    phases = [(t[0], "at rest"), (0.0, record.excitation.in_words)]
    if record.excited < len(t):
        phases.append((float(t[record.excited]), "new gains take over: PV runs on from where it was"))
    for i, (begin, name) in enumerate(phases):
        if i:
            for each in axes:
                each.axvline(begin, color="0.45", linewidth=0.8, linestyle="--")
        style.text_at(pv, begin, pv.get_ylim()[1], name, "0.2", below=True)
    _loads(pv, job.evidence)


def _loads(pv: Axes, found: EvidenceView | None) -> None:
    low, high = pv.get_ylim()
    for load in () if found is None else found.loads:
        pv.axvline(load.t_s, color=style.LOAD, linewidth=1.2)
        style.text_at(pv, load.t_s, low + 0.1 * (high - low), f"load disturbance {load.size:+.3g} %", style.LOAD)


def _point_out(rest: Axes, at: Reals, residual: Reals, noise: float) -> None:
    """Draws an arrow to the largest residual, with its size beside the noise at rest, where it is beyond that."""
    worst = int(np.argmax(np.abs(residual)))
    size = abs(float(residual[worst]))
    if noise <= 0.0 or size <= 2.0 * noise:
        return
    right = at[worst] < 0.5 * (at[0] + at[-1])
    rest.annotate(
        f"largest residual {size:.3g}, {2.0 * size / noise:.0f} times the noise at rest (grey: 2 standard deviations)",
        (float(at[worst]), float(residual[worst])), xytext=(0.98 if right else 0.02, 0.85),
        textcoords="axes fraction", ha="right" if right else "left", fontsize=8.5, color=style.BEFORE,
        arrowprops={"arrowstyle": "->", "color": style.BEFORE},
    )  # fmt: skip
