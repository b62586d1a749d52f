"""The preflight checks whether a loop can be tested. It only listens, and refuses with the numbers.

Noise alone moves a slow loop, and a recent disturbance dies away. A loop that is not at rest is therefore given time
and checked again.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from loopwright.tuning.analysis.pv_faults import pv_faults, without_wrong_samples
from loopwright.tuning.analysis.sticking import find_sticking
from loopwright.tuning.analysis.window import oscillation_at_rest
from loopwright.tuning.experiments.controller_mismatch import check_law_at_rest
from loopwright.tuning.experiments.primitives import Facts, OperatingPoint, Trace, record
from loopwright.tuning.plan import Mode, Note, Plan, StageStarted, worked
from loopwright.tuning.reasons import Reason, Refused

PREFLIGHT, SETTLE = "preflight", "settle"
MAX_ATTEMPTS = 4
MIN_LISTENED_SAMPLES = 60
MAX_NOISE = 0.10
"""Noise (standard deviation) as a share of the set-point step, above which no overshoot can be read."""
MAX_AWAY = 0.05
"""PV off the set-point, and its drift, as a share of the set-point step, above which the loop is not at rest."""
LISTENED_PARTS, MAX_PARTS_MOVED = 10, 5
"""A set-point that moves in more of the equal parts of the listening is moved by another controller or a ramp. An outer
loop may be sampled more slowly than this one."""
MIN_ROOM = 0.05
"""Room for MV on both sides, as a share of its permitted range."""


def preflight(facts: Facts, after_s: float) -> Plan[OperatingPoint]:
    """The operating point of a loop at rest, see `at_rest`."""
    point, _ = yield from at_rest(facts, after_s)
    return point


def at_rest(
    facts: Facts, after_s: float, min_samples: int = MIN_LISTENED_SAMPLES, mode: Mode = Mode.AUTOMATIC
) -> Plan[tuple[OperatingPoint, Trace]]:
    """Checks the loop until it is at rest, at most MAX_ATTEMPTS times.

    The result is the operating point and the samples of the last check. Each check is a stage of its own, with a stage
    of settling between two checks.

    after_s: the expected plant time of the stages that follow, s.
    min_samples: the smallest number of samples of a check.
    mode: the mode that the test needs, automatic or manual. In manual the set-point drives nothing: it may be
    anywhere, and may move.
    Raises Refused: WRONG_MODE, SETPOINT_IS_DRIVEN, NOT_AT_REST, NOISE_TOO_HIGH, SATURATED, CONTROLLER_MISMATCH.
    """
    once_s = facts.T95_s / 2
    begin = (StageStarted(PREFLIGHT, once_s, after_s),)
    heard = Trace()
    for _ in range(MAX_ATTEMPTS - 1):
        yield begin
        try:
            return (yield from check_at_rest(facts, min_samples, mode, heard))
        except Refused as refused:
            if refused.reason is not Reason.NOT_AT_REST:
                raise
            note = Note(refused.detail), StageStarted(SETTLE, once_s, once_s + after_s)
            heard.extend((yield from record(once_s, note)))
    yield begin
    try:
        return (yield from check_at_rest(facts, min_samples, mode, heard))
    except Refused as refused:
        # a sticking valve cycles more slowly than what swings PV several times in one look
        if refused.reason is not Reason.NOT_AT_REST or mode is not Mode.AUTOMATIC or isinstance(refused, _Swinging):
            raise
        rows = map(np.asarray, (heard.mv, heard.pv))
        sticking = yield from worked(partial(find_sticking, facts.sample_time_s, *rows))
        if sticking is None:
            raise
        raise Refused(Reason.NOT_AT_REST, f"{refused.detail}; {sticking.in_words}") from None


def check_at_rest(
    facts: Facts, min_samples: int = MIN_LISTENED_SAMPLES, mode: Mode = Mode.AUTOMATIC, heard: Trace | None = None
) -> Plan[tuple[OperatingPoint, Trace]]:
    """Checks the loop once, for half of T95 and at least `min_samples`. Raises Refused as `at_rest`.

    heard: gets the samples as well.
    """
    trace = yield from record(max(facts.T95_s / 2, min_samples * facts.sample_time_s))
    sample = yield ()
    trace.add(sample)
    if heard is not None:
        heard.extend(trace)
    if sample.mode != mode:
        found = Mode(sample.mode).name.lower()
        raise Refused(Reason.WRONG_MODE, f"the controller is in mode {found}, not {mode.name.lower()}")
    pv, mv = np.asarray(trace.pv), np.asarray(trace.mv)
    step = facts.sp_deviation
    by_setpoint = mode is Mode.AUTOMATIC
    moved = np.diff(trace.sp) != 0.0
    parts = sum(bool(part.any()) for part in np.array_split(moved, LISTENED_PARTS))
    if parts and by_setpoint:
        text = (
            f"the set-point moved at {np.count_nonzero(moved)} of {len(pv)} samples while listening, in {parts} of "
            f"{LISTENED_PARTS} parts of the time, by {np.ptp(trace.sp):.4g}"
        )
        raise Refused(Reason.SETPOINT_IS_DRIVEN if parts > MAX_PARTS_MOVED else Reason.NOT_AT_REST, text)
    x = np.linspace(-0.5, 0.5, len(pv))
    drift = float(np.polyfit(x, pv, 1)[0])
    noise = float(np.std(np.diff(pv))) / math.sqrt(2)
    spread = float(np.std(pv - drift * x))
    away = float(pv.mean()) - sample.sp if by_setpoint else 0.0
    near = facts.mv_high - facts.mv_low
    room = min(facts.mv_high - float(mv.mean()), float(mv.mean()) - facts.mv_low)
    if room < MIN_ROOM * near:
        raise Refused(
            Reason.SATURATED,
            f"MV {mv.mean():.4g} leaves {room:.3g} of room within {facts.mv_low:.4g} .. {facts.mv_high:.4g}; "
            f"at least {MIN_ROOM * near:.3g} is needed",
        )
    slack = 4 * noise / math.sqrt(len(pv))
    if noise > MAX_NOISE * step:
        text = f"noise {noise:.3g} is above {MAX_NOISE:.0%} of the step {step:.3g}"
        raise _named(Reason.NOISE_TOO_HIGH, text, trace, facts)
    near_rest = MAX_AWAY * step
    if abs(drift) > near_rest + 4 * slack or abs(away) > near_rest + slack or spread > 0.03 * step + 2 * noise:
        off = f"is {away:+.3g} off the set-point and " if by_setpoint else "and "
        text = (
            f"within {trace.t[-1] - trace.t[0]:.3g} s PV drifted by {drift:+.3g}, {off}varies by {spread:.3g} "
            f"(noise {noise:.3g}); the step would be {step:.3g}"
        )
        raise _named(Reason.NOT_AT_REST, text, trace, facts)
    if by_setpoint:
        check_law_at_rest(facts, trace)
    room = min(room, 0.5 * facts.mv_step_max)
    return OperatingPoint(sample.sp, float(pv.mean()), float(mv.mean()), noise, room), trace


def _named(reason: Reason, text: str, trace: Trace, facts: Facts) -> Refused:
    """The refusal, which names single wrong samples of PV, or what swings it, before the noise that they would seem."""
    pv = np.asarray(trace.pv)
    if wrong := pv_faults(pv).of_wrong_samples:
        without = float(np.std(np.diff(without_wrong_samples(pv)))) / math.sqrt(2)
        return Refused(reason, f"{wrong}, where the noise is {without:.2g} without them: {text}")
    if (oscillation := oscillation_at_rest(pv, np.asarray(trace.mv), facts.sample_time_s)) is None:
        return Refused(reason, text)
    return _Swinging(Reason.MV_ALTERED if oscillation.by_window else reason, f"{oscillation.in_words}: {text}")


class _Swinging(Refused):
    """Something swings PV several times in one look."""
