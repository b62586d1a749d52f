"""What a procedure knows of its loop, and how long it may take."""

from __future__ import annotations

import math

from loopwright.service.inputs.config import LoopConfig
from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.experiments.primitives import Directions, Facts
from loopwright.tuning.fast.pulses.procedure import SETPOINT
from loopwright.tuning.fast.relay.procedure import FAST

TIME_BUDGET_T95 = {FAST: 100.0, SETPOINT: 100.0}
OTHER_BUDGET_T95 = 500.0
MIN_BUDGET_SAMPLES = 1000
"""Minimum time limit in samples: the wait for rest is counted in samples, which matters where T95 is a few of them."""


def facts_of(config: LoopConfig, state: LoopState) -> Facts:
    """Returns what the procedures know of a loop, with the narrower of the job's and the controller's MV limits.

    Raises Refused: BAD_LIMITS, SAMPLING_TOO_SLOW.
    """
    return Facts(
        sample_time_s=state.sample_time_s,
        T95_s=config.t95_s,
        mv_low=max(config.mv_limits.low, state.mv_low),
        mv_high=min(config.mv_limits.high, state.mv_high),
        sp_deviation=config.sp_deviation,
        previous_gains=state.gains,
        reverse=state.reverse_acting,
        mv_step_max=config.test.mv_step_max or math.inf,
        pv_low=config.pv_limits.low,
        pv_high=config.pv_limits.high,
        directions=Directions(config.test.directions),
        sp_rate_max_per_s=config.test.sp_rate_max_per_s or math.inf,
    )


def time_budget_s(method: str, t95_s: float, sample_time_s: float) -> float:
    """Returns the time limit of a retune, plant time in s: several times what a loop of this T95 takes."""
    budget = TIME_BUDGET_T95.get(method, OTHER_BUDGET_T95) * t95_s
    return max(budget, MIN_BUDGET_SAMPLES * sample_time_s)
