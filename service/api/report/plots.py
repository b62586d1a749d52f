"""The plots of a report: the record with its model, the answers to steps, and Nyquist."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from loopwright.service.api.report.drawing import Label, Picture, around
from loopwright.service.api.report.words import stage_name
from loopwright.service.jobs.job_record import JobRecord
from loopwright.service.listening.bins import GAP_BEFORE, Bins
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.analysis.stability import open_loop
from loopwright.tuning.analysis.step_response import step_response
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Model, Reals, time_constants
from loopwright.tuning.reasons import Ended

WIDTH = 690.0
_SMALL = (225.0, 160.0)
_POINTS = 450
_SHOWN_SETTLINGS = 1.6
_LABEL_APART = 120.0
LOAD_PCT = 10.0
"""Size of the load step that is drawn, percent of MV."""


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
    for mark, row in zip(record.facts.marks, rows, strict=True):
        for picture in pictures:
            picture.line_at(mark.at_s, "mark", stage_name(mark.stage) if picture is top else "", row)
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
    model: Model, before: Gains | None, after: Gains | None, size: float, Ms: float | None
) -> StepPictures:
    """Returns the answers of the loop on the model, under the gains before and after.

    model: with the delay of the sampling in its dead time.
    size: of the set-point step, PV units.
    Ms: of the gains after, or of those before where there are none: the radius of the circle.
    """
    loops = [(gains, look) for gains, look in ((before, "old"), (after, "new")) if gains is not None]
    stable = [(gains, look) for gains, look in loops if _is_stable(model, gains)]
    horizon = max((_settling(model, gains) for gains, _ in stable[-1:]), default=20.0 * (model.L + 1.0))
    answers = {}
    for load, factor in ((False, size), (True, LOAD_PCT)):
        found = []
        for gains, look in stable:
            try:
                response = step_response(model, gains, horizon, load=load)
            except Ended:
                continue
            at = np.linspace(0.0, horizon, 240)
            found.append((at, factor * np.interp(at, response.t, response.y), look))
        answers[load] = found
    target = np.asarray([0.0, size])
    setpoint = Picture(
        "step", "PV after a set-point step", (0.0, horizon), around([target, *(y for _, y, _ in answers[False])], 0.0),
        *_SMALL, x_apart=44.0,
    )  # fmt: skip
    setpoint.curve([0.0, horizon], [size, size], "sp")
    load_picture = Picture(
        "loadstep", "PV after a load step", (0.0, horizon),
        around([np.zeros(1), *(y for _, y, _ in answers[True])], 1e-6), *_SMALL, x_apart=44.0,
    )  # fmt: skip
    for picture, load in ((setpoint, False), (load_picture, True)):
        for at, y, look in answers[load]:
            picture.curve(at, y, look)
        if before is not None and not any(look == "old" for _, look in stable):
            picture.labels.append(Label(60.0, 20.0, "before: not stable on the model"))
    return StepPictures(setpoint, load_picture, _nyquist(model, loops, Ms))


def _nyquist(model: Model, loops: list[tuple[Gains, str]], Ms: float | None) -> Picture:
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
    scale = model.L + float(np.sum(time_constants(model)))
    w = np.geomspace(1e-3, 1e3, 1500) / (scale or 1.0)
    for gains, look in loops:
        try:
            N, D = open_loop(model, gains)
        except Ended:
            continue
        s = 1j * w
        loop = np.polyval(N, s) / np.polyval(D, s) * np.exp(-model.L * s)
        shown = (np.abs(loop) < 4.0) & (np.abs(loop) > 0.08)
        picture.curve(np.where(shown, loop.real, np.nan), np.where(shown, loop.imag, np.nan), look)
    minus_one = (picture.at_x(-1.0), picture.at_y(0.0))
    picture.labels.append(Label(minus_one[0] - 7.0, minus_one[1] + 4.0, "+", "point"))
    picture.labels.append(Label(minus_one[0] - 14.0, minus_one[1] - 6.0, "−1"))
    return picture


def _is_stable(model: Model, gains: Gains) -> bool:
    try:
        return margins(model, gains).stable
    except Ended:
        return False


def _settling(model: Model, gains: Gains) -> float:
    """Returns a time within which the answers to both steps have come to rest, s."""
    times = []
    for load in (False, True):
        found = step_response(model, gains, load=load)
        away = np.abs(found.y - found.y[-1])
        late = np.flatnonzero(away > 0.05 * float(np.max(away, initial=0.0)))
        times.append(float(found.t[late[-1]]) if len(late) else float(found.t[-1]))
    return max(_SHOWN_SETTLINGS * max(times), 4.0 * model.L, 1e-6)
