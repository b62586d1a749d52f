"""A set-point step on the live loop, until PV has settled. Baseline, Stage 3 and verification are made of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from loopwright.tuning.experiments.primitives import Array, Facts, OperatingPoint, Trace, same, settle
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Plan, SetSetpoint
from loopwright.tuning.reasons import Reason, Refused

KICK_OF_ROOM = 0.7
"""Largest first kick of a set-point step, as a fraction of the room for MV."""


@dataclass(frozen=True, slots=True)
class StepResult:
    """The figures of one measured set-point step.

    step: the set-point step, PV units.
    overshoot_pct: the overshoot, percent of the step.
    IAE: the integral of |error|, PV units * s.
    settling_s: the time until PV stays within 5 % (or the noise), s.
    static_gain: the static gain, PV units per MV unit, signed; nan when PV did not settle, infinite when MV came back
    to where it was.
    mv_span: the range of MV (maximum less minimum), MV units.
    mv_at_limit_s: the time for which MV was at a limit, s.
    settled: True if PV settled within the time allowed.
    duration_s: the duration of the record, s.
    """

    step: float
    overshoot_pct: float
    IAE: float
    settling_s: float
    static_gain: float
    mv_span: float
    mv_at_limit_s: float
    settled: bool
    duration_s: float


def allowed_step(facts: Facts, point: OperatingPoint, kick: float, static_gain: float) -> float:
    """The largest permitted set-point step (PV units) that keeps the kick and the final value of MV within its room.

    kick: how far MV goes at once, MV units per PV unit of the step: the gain in effect, or a little more than that.
    static_gain: the static gain of the plant, nan where it is not known.
    """
    step = min(facts.sp_deviation, KICK_OF_ROOM * point.room / kick)
    if static_gain == static_gain and static_gain != 0:
        step = min(step, 0.6 * point.room * abs(static_gain))
    return step


def step_test(
    facts: Facts,
    point: OperatingPoint,
    step: float,
    *,
    band: float,
    max_s: float,
    smooth_s: float,
    into: Trace | None = None,
) -> Plan[StepResult]:
    """Steps the set-point from rest by `step` (PV units) and waits until PV stays within band * step for T95/5.

    band: the settling band, as a fraction of the step.
    max_s: the longest time to wait, s.
    smooth_s: the width of the parabola fitted around the peak, s; it must be shorter than the peak.
    into: a trace that is filled with the samples, of which the first is that of the step.
    """
    target = point.sp + step
    sample = yield (SetSetpoint(target),)
    while not same(sample.sp, target):
        sample = yield ()
    later, settled = yield from settle(target, band * abs(step), facts.T95_s / 5, max_s, point.noise)
    trace = Trace()
    trace.add(sample)
    trace.extend(later)
    if into is not None:
        into.t, into.sp, into.pv, into.mv, into.mode = trace.t, trace.sp, trace.pv, trace.mv, trace.mode
    t, pv, mv = (np.asarray(column) for column in (trace.t, trace.pv, trace.mv))
    t = t - t[0]
    tail = trace.tail(facts.T95_s / 5)
    change = float(mv[tail].mean()) - point.mv
    error = (target - pv) / step
    hair = 1e-6 * (facts.mv_high - facts.mv_low)  # REAL32 on the bus
    outside = np.flatnonzero(np.abs(error) > 0.05 + 3 * point.noise / abs(step))
    return StepResult(
        step=step,
        overshoot_pct=100 * max(0.0, _peak(t, -error, smooth_s)),
        IAE=float(np.trapezoid(np.abs(target - pv), t)),
        settling_s=float(t[outside[-1]]) if len(outside) else 0.0,
        static_gain=_ratio(float(pv[tail].mean()) - point.pv, change) if settled else math.nan,
        mv_span=float(np.ptp(mv)),
        mv_at_limit_s=facts.sample_time_s * int(np.sum((mv <= facts.mv_low + hair) | (mv >= facts.mv_high - hair))),
        settled=settled,
        duration_s=float(t[-1]),
    )


def unlimited(facts: Facts, result: StepResult, gains: Gains) -> None:
    """Raises Refused, MV_LIMIT, when the limits of MV have influenced the response, which then says nothing of the
    loop.

    A kick that is clipped for a sample or two has no influence.
    """
    if result.mv_at_limit_s > max(2.5 * facts.sample_time_s, 0.02 * gains.Ti):
        raise Refused(
            Reason.MV_LIMIT,
            f"MV was at the end of its permitted range for {result.mv_at_limit_s:.3g} s of a set-point step of "
            f"{result.step:.4g} with Kp {gains.Kp:.4g}",
        )


def _ratio(pv_change: float, mv_change: float) -> float:
    return pv_change / mv_change if mv_change else math.inf


def _peak(t: Array, y: Array, width: float) -> float:
    """The height of the highest peak, from a parabola fitted around the highest moving average.

    The largest sample would be two or three standard deviations of the noise above the peak.
    """
    dt = t[1] - t[0] if len(t) > 1 else 1.0
    half = int(width / dt / 2)
    if half < 2:
        return float(y.max())
    kernel = np.ones(half) / half
    middle = (
        int(np.argmax(np.convolve(y, kernel, mode="same")[half : -half or None])) + half if len(y) > 4 * half else 0
    )
    part = slice(max(0, middle - half), middle + half + 1)
    x = t[part] - t[middle]
    c = np.polyfit(x, y[part], 2)
    if c[0] >= 0:
        return float(np.polyval(c, x).max())
    top = min(max(-c[1] / (2 * c[0]), float(x[0])), float(x[-1]))
    return float(np.polyval(c, top))
