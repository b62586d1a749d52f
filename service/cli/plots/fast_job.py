"""Plots a fast job: the record, the fitted model, the residual, and the loop before and after."""

from __future__ import annotations

import textwrap
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from loopwright.service.cli.plots.shown import Shown
from loopwright.service.jobs.stored_record import StoredRecord
from loopwright.service.results import EvidenceView, GainsView
from loopwright.tuning.analysis.assessment import assess
from loopwright.tuning.analysis.step_response import step_response
from loopwright.tuning.fast.structure_choice import choose_structure
from loopwright.tuning.gains import Gains
from loopwright.tuning.identification.output_error import Fit, averaged
from loopwright.tuning.reasons import Ended

GREY, RED, BLUE, GREEN = "0.55", "tab:red", "tab:blue", "tab:green"
SHOWN_SETTLINGS = 2.5


def fast_job(path: Path, job: Shown, record: StoredRecord, pv_unit: str) -> None:
    """Writes the plot of a fast job to a file.

    job: the job, however it ended.
    record: the record of its relay experiment.
    """
    proposed = job.new_gains is not None
    figure = Figure(figsize=(12 if proposed else 9, 6.5), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    why = f", {job.reason}" if job.reason and job.reason.value != job.state.value else ""
    title = f"{job.loop}: {job.state}{why}"
    figure.suptitle(title if proposed else "\n".join([title, *textwrap.wrap(job.detail or "", 110)]), fontsize=11)
    grid = figure.add_gridspec(3, 2 if proposed else 1, height_ratios=(3, 1, 1.5), width_ratios=(3, 2)[: 1 + proposed])
    pv, rest = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[1, 0])
    mv = figure.add_subplot(grid[2, 0])
    _record(pv, rest, mv, record, job.evidence, pv_unit)
    if proposed:
        before_after(figure.add_subplot(grid[0:2, 1]), figure.add_subplot(grid[2, 1]), job, pv_unit)
    elif job.advice:
        figure.supxlabel("\n".join(textwrap.wrap(f"Advice: {job.advice}", 110)), fontsize=9)
    canvas.print_figure(path, dpi=80)


def _record(pv: Axes, rest: Axes, mv: Axes, record: StoredRecord, found: EvidenceView | None, pv_unit: str) -> None:
    t = record.t
    pv.plot(t, record.pv, color=GREY, linewidth=1.0, label="PV measured")
    pv.step(t, record.sp, where="post", color="black", linestyle=":", linewidth=1.0, label="set-point")
    evidence = record.experiment_record()
    if evidence is None:
        rest.text(0.5, 0.5, "too few turns for a fit", ha="center", transform=rest.transAxes)
        rest.set_yticks([])
    else:
        fit = Fit(evidence)
        best = choose_structure(fit).best
        residual = best.linear.residual * evidence.output_range
        at = averaged(t[: len(fit.u)], fit.block)
        pv.plot(at, fit.y * evidence.output_range - residual + record.rest[1], color=BLUE, linewidth=1.2,
                label="fitted model")  # fmt: skip
        rest.plot(at, residual, color=RED, linewidth=0.8)
        noise = 2.0 * evidence.noise
        rest.axhspan(-noise, noise, color="0.88", zorder=0, label="noise at rest, 2 standard deviations")
        rest.legend(loc="upper left", fontsize=7)
    for load in () if found is None else found.loads:
        pv.axvline(load.t_s, color="tab:orange", linewidth=1.2, label=f"load disturbance {load.size:+.3g} %")
    mv.step(t, record.mv, where="post", color=GREEN, linewidth=1.0)
    for axes, label in ((pv, f"PV, {pv_unit}"), (rest, "residual"), (mv, "MV, %")):
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
        axes.set_xlim(t[0], t[-1])
        axes.axvline(0.0, color="0.3", linewidth=0.8, linestyle="--")
        if record.excited < len(t):
            axes.axvline(t[record.excited], color="0.3", linewidth=0.8, linestyle="--")
    pv.legend(loc="best", fontsize=8)
    taken_over = "; the new gains are in effect from the second dashed line" if record.excited < len(t) else ""
    mv.set_xlabel(f"plant time since the start of the {record.excitation.in_words}, s{taken_over}")


def before_after(top: Axes, bottom: Axes, job: Shown, pv_unit: str) -> None:
    """Plots a set-point step up of the size tested, computed on the model found."""
    assert job.model is not None and job.old_gains is not None and job.new_gains is not None
    model = job.model.process_model()
    # method setpoint steps home, which is mostly down
    size = 1.0 if job.verification is None else abs(job.verification.step or 1.0)
    both = {"before": (job.old_gains, RED, "--"), "after": (job.new_gains, BLUE, "-")}
    gains = {label: _gains(shown) for label, (shown, _, _) in both.items()}
    settled = [f.settling_s for f in (assess(model, g).setpoint for g in gains.values()) if f and f.settling_s]
    horizon = SHOWN_SETTLINGS * min(settled) if settled else 20.0 * (model.L + 1.0)
    for label, (_, colour, line) in both.items():
        try:
            found = step_response(model, gains[label], horizon)
        except Ended:
            top.plot([], [], color=colour, linestyle=line, label=f"{label}: unstable")
            continue
        top.plot(found.t, size * found.y, color=colour, linestyle=line, label=f"PV {label}")
        bottom.plot(found.t, size * found.u, color=colour, linestyle=line)
    top.axhline(size, color="black", linestyle=":", linewidth=1.0)
    top.set_title("set-point step, predicted by the model", fontsize=10)
    top.set_ylabel(f"change of PV, {pv_unit}")
    bottom.set_ylabel("change of MV, %")
    bottom.set_xlabel("s")
    top.legend(loc="lower right", fontsize=8)
    for axes in (top, bottom):
        axes.grid(alpha=0.3)
        axes.set_xlim(0.0, horizon)
        low, high = axes.get_ylim()
        axes.set_ylim(max(low, -2.0 * abs(high)), high)


def _gains(shown: GainsView) -> Gains:
    return Gains(shown.Kp, shown.Ti, shown.Td, shown.Tf)
