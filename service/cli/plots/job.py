"""Plots a job from its samples."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from loopwright.service.cli.plots import style
from loopwright.service.cli.plots.shown import Shown, ShownSamples
from loopwright.service.jobs.stored_record import stored_record
from loopwright.service.results import DESIGNED

LEAD_IN = 20
"""Number of samples shown before the step."""

Samples = Callable[[str | None], ShownSamples]
"""Gets the samples of a job: those of one stage, or all for None."""


class NoPicture(Exception):
    """The job has no samples that could be plotted."""


def job_picture(path: Path, samples: Samples, job: Shown, pv_unit: str) -> None:
    """Writes the plot of a job to a file; the suffix of `path` chooses the format.

    The plot of a fast job shows the record, the fit and the residual, and the loop before and after; the plot of any
    other job shows the set-point step before and after. Raises NoPicture.
    """
    if job.method in DESIGNED and (record := stored_record(samples(None).columns())) is not None:
        from loopwright.service.cli.plots.fast_job import fast_job

        fast_job(path, job, record, pv_unit)
        return
    named = {"previous": "baseline", "new": "verify"}
    stages = {label: samples(stage) for label, stage in named.items()}
    stages = {label: columns for label, columns in stages.items() if columns.t_s}
    if not stages:
        raise NoPicture(f"job {job.id} has neither a relay's record nor a set-point step to show")
    before_after(path, f"{job.loop}: the same set-point step before and after", pv_unit, stages)


def before_after(path: Path, title: str, pv_unit: str, stages: dict[str, ShownSamples]) -> None:
    """Plots set-point steps over each other.

    stages: the samples of the stages with the label "previous" or "new".
    """
    figure = style.new_figure(9, 6)
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1.6))
    figure.suptitle(title, fontsize=10.5)
    drawn = []
    for label, columns in stages.items():
        colour, line = style.LOOKS[label]
        first, last = step_up(columns.sp)
        shown = slice(max(first - LEAD_IN, 0), last)
        t, sp, pv, mv = (np.asarray(column[shown]) for column in (columns.t_s, columns.sp, columns.pv, columns.mv))
        shifted = t - columns.t_s[first]
        top.plot(shifted, pv, color=colour, linestyle=line, linewidth=1.5)
        top.step(shifted, sp, color=style.SETPOINT, linestyle=":", linewidth=0.9, where="post")
        bottom.step(shifted, mv, color=colour, linestyle=line, linewidth=1.2, where="post")
        drawn.append((f"PV {label}", colour, shifted, pv))
    style.name_curves(top, drawn)
    style.plain(top, f"PV, {pv_unit}")
    style.plain(bottom, "MV, %", "plant time since the set-point step, s")
    style.write(figure, path)


def step_up(sp: list[float]) -> tuple[int, int]:
    """Returns the first sample of the last rise of the set-point, and the first sample after that level."""
    changes = [i for i in range(1, len(sp)) if sp[i] != sp[i - 1]]
    rises = [i for i in changes if sp[i] > sp[i - 1]]
    first = rises[-1] if rises else 0
    return first, next((i for i in changes if i > first), len(sp))
