"""The last stage makes a set-point step from rest under the new gains and compares it with the model's prediction."""

from __future__ import annotations

import math

from loopwright.tuning.analysis.comparison import Predicted
from loopwright.tuning.experiments.controller_mismatch import check_law_in_step
from loopwright.tuning.experiments.primitives import Facts, OperatingPoint, Trace, settle
from loopwright.tuning.experiments.step_test import StepResult, allowed_step, step_test, unlimited
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode, Plan, SetGains, SetMode, SetSetpoint
from loopwright.tuning.reasons import Reason, Refused


def verification(
    facts: Facts, point: OperatingPoint, gains: Gains, predicted: Predicted, static_gain: float, dead_time_s: float
) -> Plan[StepResult]:
    """The set-point step under the new gains; it is not larger than a step under the previous gains might have been.

    predicted: what the model predicts for the new gains.
    static_gain: the static gain of the model, PV units per MV unit, nan where it is not known.
    dead_time_s: the dead time of the model, s.
    Raises Refused: CONTROLLER_MISMATCH, NOT_CONFIRMED, MV_LIMIT.
    """
    step = min(
        allowed_step(facts, point, max(gains.b, 1.0) * gains.Kp, abs(static_gain)),
        allowed_step(facts, point, facts.previous_gains.Kp, math.nan),
    )
    commands = (SetGains(gains), SetMode(Mode.AUTOMATIC), SetSetpoint(point.sp))
    yield from settle(point.sp, 0.02 * step, facts.T95_s / 5, 3 * facts.T95_s, point.noise, commands)
    to = facts.side * step
    trace = Trace()
    result = yield from step_test(
        facts, point, to, band=0.05, max_s=5 * facts.T95_s, smooth_s=dead_time_s / 2, into=trace
    )
    check_law_in_step(facts, trace, gains)
    unlimited(facts, result, gains)
    maximum = max(40.0, predicted.overshoot_pct + 25.0)
    if not result.settled or result.overshoot_pct > maximum:
        raise Refused(
            Reason.NOT_CONFIRMED,
            f"under the new gains the loop {'settled' if result.settled else 'did not settle'} with an overshoot of "
            f"{result.overshoot_pct:.1f} % (predicted {predicted.overshoot_pct:.1f} %, at most {maximum:.0f} %)",
        )
    # the loop returns under the new gains, so that the old ones take over a loop at rest
    yield from settle(point.sp, 0.05 * step, facts.T95_s / 5, 3 * facts.T95_s, point.noise, (SetSetpoint(point.sp),))
    return result
