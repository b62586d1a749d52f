"""The plots of a report: the record with its model, the answers to steps, and Nyquist."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from loopwright.service.api.report.drawing import Label, Picture, around
from loopwright.service.api.report.words import mark_names
from loopwright.service.jobs.job_record import JobRecord
from loopwright.service.listening.bins import GAP_BEFORE, Bins
from loopwright.service.planning.curves import LOAD_PCT, LoopCurves
from loopwright.tuning.models import Reals

WIDTH = 690.0
_SMALL = (225.0, 160.0)
_POINTS = 450
_LABEL_APART = 190.0


@dataclass(frozen=True, slots=True)
class StepPictures:
    """The answers to a set-point step and to a load step, and the Nyquist plot."""

    setpoint: Picture
    load: Picture
    nyquist: Picture


def record_pictures(record: JobRecord, pv_step: float) -> list[Picture]:
    """Returns PV with SP and the model, the residual where there is a model, and MV, one above the other.

    pv_step: a change of PV that is of interest, PV units.
    """
    record = record.thinned(_POINTS)
    bins, explained = record.measured, record.explained
    begin, end = float(bins["at_s"][0]), float(bins["until_s"][-1])
    if not end > begin:
        end = begin + record.facts.sample_time_s
    x = (begin, end)
    t, pv = _extremes(bins, "pv")
    _, mv = _extremes(bins, "mv")
    sp = np.asarray(bins["sp"], float)
    at = np.asarray(bins["at_s"], float)
    rows = _rows(record, x)
    low, high = around([pv, sp], 0.5 * pv_step, 0.06)
    high += (high - low) * 0.07 * (1 + max(rows, default=0))  # room for the names of the stages
    top = Picture("pv", "PV measured, set-point and model", x, (low, high), WIDTH, 160.0, named_x=False)
    top.curve(at, sp, "sp", stepped=True)
    top.curve(t, pv, "measured" if explained is not None else "pv")
    if explained is not None:
        top.curve(at, np.asarray(explained["pv_mean"], float), "new")
    pictures = [top]
    if explained is not None:
        _, left = _extremes(explained, "mv")
        noise = record.facts.noise or 0.0
        rest = Picture(
            "left", "What the model leaves", x, around([left], 6.0 * noise), WIDTH, 70.0, named_x=False, y_apart=15.0
        )
        if noise > 0.0:
            rest.band(-2.0 * noise, 2.0 * noise)
        rest.curve(t, left, "rest")
        pictures.append(rest)
    bottom = Picture("mv", "MV", x, around([mv], 5.0), WIDTH, 92.0)
    bottom.curve(t, mv, "mv", stepped=True)
    pictures.append(bottom)
    names = mark_names([mark.stage for mark in record.facts.marks])
    for mark, name, row in zip(record.facts.marks, names, rows, strict=True):
        for picture in pictures:
            picture.line_at(mark.at_s, "mark", name if picture is top else "", row)
    for load in record.facts.loads:
        for picture in pictures:
            picture.line_at(load.t_s, "load", f"load {load.size:+.3g} %" if picture is top else "", max(rows) + 1)
    return pictures


def _rows(record: JobRecord, x: tuple[float, float]) -> list[int]:
    """Returns the row in which the name of each stage stands, so that no two names overlap."""
    rows: list[int] = []
    last = -math.inf
    for mark in record.facts.marks:
        place = WIDTH * (mark.at_s - x[0]) / (x[1] - x[0])
        rows.append(rows[-1] + 1 if place - last < _LABEL_APART and rows else 0)
        last = place
    return rows


def _extremes(bins: Bins, name: str) -> tuple[Reals, Reals]:
    """Returns times and values of the curve through the smallest and largest value of each bin, interrupted where
    samples are missing."""
    t: list[float] = []
    values: list[float] = []
    columns = (bins[each].tolist() for each in ("at_s", "until_s", f"{name}_min", f"{name}_max", "count", "gap"))
    for at, until, low, high, count, gap in zip(*columns, strict=True):
        if gap & GAP_BEFORE and t:
            t.append(at)
            values.append(math.nan)
        t += [at] if count == 1 else [at, until]
        values += [low] if count == 1 else [low, high]
    return np.asarray(t), np.asarray(values)


def step_pictures(
    before: LoopCurves | None, after: LoopCurves | None, size: float, Ms: float | None, unstable: bool = False
) -> StepPictures | None:
    """Returns the pictures of these curves of the loop, before and after; None where there are none.

    size: of the set-point step, PV units.
    Ms: of the gains after, or of those before where there are none: the radius of the circle.
    unstable: whether the gains before are known and not stable on the model.
    """
    shown = [(curves, look) for curves, look in ((before, "old"), (after, "new")) if curves is not None]
    if not shown:
        return None
    pictures = []
    for name, which, factor, target in (
        ("PV after a set-point step", "setpoint", size, [0.0, size]),
        ("PV after a load step", "load", LOAD_PCT, [0.0, 1e-6]),
    ):
        curves = [(getattr(each, which), look) for each, look in shown]
        end = curves[-1][0].horizon_s
        values = [factor * np.asarray(curve.pv) for curve, _ in curves]
        picture = Picture(
            which, name, (0.0, end), around([np.asarray(target), *values], 0.0), *_SMALL, x_apart=44.0
        )  # fmt: skip
        if which == "setpoint":
            picture.curve([0.0, end], [size, size], "sp")
        for (curve, look), y in zip(curves, values, strict=True):
            picture.curve(curve.t, y, look)
        if unstable:
            picture.labels.append(Label(60.0, 20.0, "previous: not stable on the model"))
        pictures.append(picture)
    return StepPictures(pictures[0], pictures[1], _nyquist(shown, Ms))


def _nyquist(shown: list[tuple[LoopCurves, str]], Ms: float | None) -> Picture:
    width, height = _SMALL
    y = (-1.55, 1.0)
    # the same scale on both axes
    picture = Picture("nyquist", "Nyquist plot", (0.0, 1.0), y, width, height, x_apart=36.0)
    per_px = (y[1] - y[0]) / picture.inner_height
    picture.x = (-2.0, -2.0 + per_px * picture.inner_width)
    picture.curve(picture.x, [0.0, 0.0], "axis")
    picture.curve([0.0, 0.0], y, "axis")
    angle = np.linspace(0.0, 2.0 * np.pi, 121)
    if Ms is not None and Ms > 1.0:
        picture.curve(-1.0 + np.cos(angle) / Ms, np.sin(angle) / Ms, "circle")
    for curves, look in shown:
        picture.curve(np.asarray(curves.nyquist_re), np.asarray(curves.nyquist_im), look)
    minus_one = (picture.at_x(-1.0), picture.at_y(0.0))
    picture.labels.append(Label(minus_one[0] - 7.0, minus_one[1] + 4.0, "+", "point"))
    picture.labels.append(Label(minus_one[0] - 14.0, minus_one[1] - 6.0, "−1"))
    return picture
