"""Stage 3 measures the static gain and the overshoot under a Ziegler-Nichols PI, formula (1): Kp = Ku/2.2, Ti = Pu/1.2.

While the overshoot is outside its window, Kp is changed by 0.1 (Ku - Kp_zn), or by a factor (the paper's manual mode).
"""

from __future__ import annotations

from dataclasses import dataclass

from loopwright.tuning.experiments.controller_mismatch import check_law_in_step
from loopwright.tuning.experiments.primitives import Facts, OperatingPoint, Trace, settle
from loopwright.tuning.experiments.step_test import StepResult, allowed_step, step_test, unlimited
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode, Note, Plan, SetGains, SetMode, SetSetpoint
from loopwright.tuning.reasons import Reason, Refused

MAX_STEPS = 12


@dataclass(frozen=True, slots=True)
class ZnResult:
    """The result of Stage 3.

    Kp, Ti_s: the PI in effect when the overshoot was measured.
    overshoot_pct: the overshoot, percent of the step.
    static_gain: the static gain, PV units per MV unit, signed.
    step: the set-point step, PV units.
    tests: the number of steps made.
    """

    Kp: float
    Ti_s: float
    overshoot_pct: float
    static_gain: float
    step: float
    tests: int


def zn_pi(
    facts: Facts,
    point: OperatingPoint,
    Ku: float,
    Pu: float,
    static_gain: float,
    window: tuple[float, float],
    factor: float | None,
    into: Trace,
) -> Plan[ZnResult]:
    """Makes set-point steps until the overshoot is inside its window.

    Ku, Pu: the ultimate point, MV units per PV unit and s.
    static_gain: a first estimate of the static gain, nan without one, which keeps MV within its room.
    window: the overshoots that are accepted, percent.
    factor: the factor by which Kp is changed, None for the increment of the paper.
    into: a trace that is filled with the samples of the last step.
    Raises Refused: CONTROLLER_MISMATCH, NO_OVERSHOOT, MV_LIMIT.
    """
    Kp, Ti = Ku / 2.2, Pu / 1.2
    increment = 0.1 * (Ku - Kp)
    step = allowed_step(facts, point, 1.6 * Kp, static_gain)
    tests = 0
    seen: list[StepResult] = []
    while True:
        gains = Gains(Kp=Kp, Ti=Ti)
        commands = (SetGains(gains), SetMode(Mode.AUTOMATIC), SetSetpoint(point.sp))
        # A remnant of the last movement would add to the overshoot, so the loop rests for a whole period at least.
        stay_s = max(facts.T95_s / 5, Pu)
        max_s = max(3 * facts.T95_s, 8 * Pu)
        yield from settle(point.sp, 0.005 * step, stay_s, max_s, point.noise, commands)
        found = yield from step_test(
            facts, point, step, band=0.01, max_s=max(6 * facts.T95_s, 15 * Pu), smooth_s=Pu / 5, into=into
        )
        check_law_in_step(facts, into, gains)
        unlimited(facts, found, gains)
        seen.append(found)
        tests += 1
        over = found.overshoot_pct
        yield (Note(f"PI Kp = {Kp:.4g}, Ti = {Ti:.4g} s: overshoot {over:.1f} %"),)
        if window[0] <= over <= window[1]:
            return ZnResult(Kp, Ti, over, found.static_gain, step, tests)
        if len(seen) > 1 and (over - window[1]) * (seen[-2].overshoot_pct - window[1]) < 0:
            raise Refused(
                Reason.NO_OVERSHOOT,
                f"the overshoot jumped across the whole window, from {seen[-2].overshoot_pct:.0f} to {over:.0f} %",
            )
        up = over < window[0]
        Kp = (Kp * factor if up else Kp / factor) if factor else (Kp + increment if up else Kp - increment)
        if tests >= MAX_STEPS or not 0 < Kp < 0.98 * Ku:
            raise Refused(
                Reason.NO_OVERSHOOT,
                f"overshoot {over:.1f} % before Kp {Kp:.4g} (Ku {Ku:.4g}) after {tests} tests; "
                f"wanted {window[0]:g} to {window[1]:g} %",
            )
