"""Estimates the plant time of each stage of a retune from T95, and from the ultimate period where a model is known.

The factors cover the rehearsals of the plants of `benchmarks.plants` (the shortest and the longest of nine in ten) and
the time limits of the procedures.
"""

from __future__ import annotations

from collections.abc import Sequence

from loopwright.service.inputs.request import RetuneRequest
from loopwright.tuning.experiments.preflight import MAX_ATTEMPTS, MIN_LISTENED_SAMPLES
from loopwright.tuning.fast.evaluation.look import MIN_OWN_PERIODS
from loopwright.tuning.fast.experiment import STEP_BACK_FRACTION, VERIFICATION_PERIODS
from loopwright.tuning.fast.manual.manual_test import ANSWER_T95, BACK_PULSES, BACK_T95, LONGEST_PULSE_T95, MAX_RAISES
from loopwright.tuning.fast.manual.procedure import MANUAL
from loopwright.tuning.fast.manual.procedure import MAX_PERIODS as MAX_PERIODS_IN_MANUAL
from loopwright.tuning.fast.manual.procedure import MAX_T95 as MAX_T95_IN_MANUAL
from loopwright.tuning.fast.pulses.stage import MAX_PERIODS as MAX_PERIODS_OF_PULSES
from loopwright.tuning.fast.pulses.stage import MAX_T95
from loopwright.tuning.fast.relay.procedure import MIN_SAMPLES
from loopwright.tuning.fast.relay.relay_test import MAX_PERIODS

PU_OF_T95 = (0.07, 0.95)
"""Ultimate period as a fraction of T95: the range of eight in ten of 116 self-regulating plants."""

MOVES, MOVES_OF_STEP = 5.0, 2.0
"""Way of the set-point in permitted steps, at most: pulses up, down and up again; the step, and home at the end."""

Span = tuple[float, float]


def durations(
    request: RetuneRequest,
    stages: Sequence[str],
    t95_s: float,
    sample_time_s: float | None,
    pu_s: float | None,
    ramp_s: float = 0.0,
) -> dict[str, Span]:
    """Returns the shortest and the longest time expected of each stage, s.

    stages: the stages that the retune may have.
    pu_s: the ultimate period, s; None where no model is known.
    ramp_s: the time that the set-point takes for the permitted step, s.
    """
    designed_only = request.known_model is not None
    whole_record = request.fits_record
    minimum = MIN_SAMPLES if whole_record else MIN_LISTENED_SAMPLES
    look = max(0.5 * t95_s, minimum * (sample_time_s or 0.0))
    # a loop that is not at rest is given half a T95 before each further look
    listening = (look, MAX_ATTEMPTS * look + (MAX_ATTEMPTS - 1) * 0.5 * t95_s)
    low, high = (pu_s, pu_s) if pu_s else (PU_OF_T95[0] * t95_s, PU_OF_T95[1] * t95_s)
    nothing = (0.0, 0.0)
    if designed_only:
        return {"preflight": listening, "design": nothing, "verify": (0.6 * t95_s, 11.0 * t95_s)}
    if whole_record:
        # where operation has shown the plant only the trial moves the loop, else the trial is left out
        may_be_known = "trial" in stages
        pulses = (
            0.0 if may_be_known else 1.5 * low,
            max(MAX_PERIODS_OF_PULSES * high, MAX_T95 * t95_s) + MOVES * ramp_s,
        )
        # the relay follows pulses only where they tell too little
        relay = (0.0 if may_be_known or "pulses" in stages else 1.8 * low, MAX_PERIODS * high)
        longest = (1.0 + STEP_BACK_FRACTION) * VERIFICATION_PERIODS * high + MOVES_OF_STEP * ramp_s
        steps = (VERIFICATION_PERIODS * low, longest)
        verify = (0.0 if may_be_known else steps[0], steps[1])
        # the first pulse is raised where PV hardly answers, and PV is waited for until it comes back
        first = (1 + MAX_RAISES) * (LONGEST_PULSE_T95 + ANSWER_T95) + max(BACK_T95, BACK_PULSES * LONGEST_PULSE_T95)
        manual = (MIN_OWN_PERIODS * low, first * t95_s + max(MAX_PERIODS_IN_MANUAL * high, MAX_T95_IN_MANUAL * t95_s))
        known = {
            "preflight": listening,
            MANUAL: manual,
            "trial": steps,
            "pulses": pulses,
            "relay": relay,
            "verify": verify,
        }
        return {stage: known.get(stage, nothing) for stage in stages}
    return {
        "preflight": listening,
        "baseline": (1.5 * t95_s, 7.0 * t95_s),
        "relay": (5.0 * low, 8.0 * high + 2.0 * t95_s),
        "ultimate": (10.0 * low, 5.0 * (6.0 * high + 2.0 * t95_s)),
        "zn_pi": (3.0 * low, 15.0 * high + 4.0 * t95_s),
        "estimate": nothing,
        "optimise": nothing,
        "verify": (4.0 * low, 5.0 * high + 4.0 * t95_s),
    }
