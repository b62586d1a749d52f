"""The picture of a job, from its samples."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from loopwright.service.jobs.relay_record import relay_record
from loopwright.service.plots.shown import Shown

LEAD_IN = 20
"""Samples shown before the step."""


Samples = Callable[[str | None], dict[str, Any]]
"""The columns of the samples of a job, of one stage or (None) of all, as GET /jobs/{id}/samples has them."""


class NoPicture(Exception):
    """There is nothing to be shown yet."""


def job_picture(path: Path, samples: Samples, job: Shown, pv_unit: str) -> None:
    """A picture of a fast job shows its record, fit and residual, and the loop before and after; a picture of any other
    job shows the set-point step before and after. Raises NoPicture.
    """
    if job.method == "fast" and (record := relay_record(samples(None))) is not None:
        from loopwright.service.plots.fast_job import fast_job

        fast_job(path, job, record, pv_unit)
        return
    named = {"before": "baseline", "after": "verify"}
    stages = {label: samples(stage) for label, stage in named.items()}
    stages = {label: columns for label, columns in stages.items() if columns["t_s"]}
    if not stages:
        raise NoPicture(f"job {job.id} has neither a relay's record nor a set-point step to show")
    before_after(path, f"{job.loop}: the same set-point step before and after", pv_unit, stages)


def before_after(path: Path, title: str, pv_unit: str, stages: dict[str, dict[str, Any]]) -> None:
    """stages: "before" and "after", each the columns of GET /jobs/{id}/samples?stage=..."""
    figure = Figure(figsize=(9, 6), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    top, bottom = figure.subplots(2, 1, sharex=True)
    figure.suptitle(title)
    for (label, columns), colour in zip(stages.items(), ("tab:red", "tab:blue"), strict=False):
        first, last = step_up(columns["sp"])
        t, sp, pv, mv = (columns[name][max(first - LEAD_IN, 0) : last] for name in ("t_s", "sp", "pv", "mv"))
        shifted = [x - columns["t_s"][first] for x in t]
        top.plot(shifted, pv, color=colour, label=f"PV {label}")
        top.step(shifted, sp, color=colour, linestyle=":", linewidth=1, where="post")
        bottom.step(shifted, mv, color=colour, label=f"MV {label}", where="post")
    top.set_ylabel(f"PV, {pv_unit}")
    bottom.set_ylabel("MV, %")
    bottom.set_xlabel("plant time since the set-point step, s")
    for axes in (top, bottom):
        axes.legend(loc="lower right")
        axes.grid(alpha=0.3)
    canvas.print_figure(path, dpi=110)


def step_up(sp: list[float]) -> tuple[int, int]:
    """Where the last rise of the set-point begins and where it ends: the step that the figures are about."""
    changes = [i for i in range(1, len(sp)) if sp[i] != sp[i - 1]]
    rises = [i for i in changes if sp[i] > sp[i - 1]]
    first = rises[-1] if rises else 0
    return first, next((i for i in changes if i > first), len(sp))
