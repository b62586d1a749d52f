"""Whether a plant that rises with another lag than it falls explains a record better than a linear plant does.

A heater that cools by itself is one. A linear fit takes the difference for loads, for a gain that differs above and
below rest, or for a plant that no PI makes robust. The record is therefore fitted again without load disturbances and
with a lag that has one value while PV rises and another one while it falls, one more lag behind it, and a dead time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from loopwright.tuning.fast.record import ExperimentRecord
from loopwright.tuning.fast.score_tests.changing_gain import fit_changing_gains
from loopwright.tuning.fast.score_tests.without_loads import fit_without_loads
from loopwright.tuning.identification.disturbances import MIN_BIC_GAIN
from loopwright.tuning.identification.output_error import (
    LOG_STEP,
    MAX_LOG_STEP,
    UNDISTURBED,
    Fit,
    Fitted,
    averaged,
    sums_of_squares_left,
)
from loopwright.tuning.identification.regressors import Regressors
from loopwright.tuning.identification.variable_projection import SearchBounds
from loopwright.tuning.models import Reals

LAGS, RATIOS, SECOND_LAGS = (0.3, 0.8, 2.0, 6.0), (0.2, 0.45, 1.0, 2.2, 5.0), (0.02, 0.2)
DEAD_TIMES = (0.05, 0.15, 0.3)
"""First guesses: of the lags and dead times in periods, of the lag of falling over that of rising."""
SHORTEST, LONGEST = 0.005, 40.0
"""Lags that are searched, in periods."""
STARTS = 5
MIN_RATIO = 1.1
"""Smallest ratio of the two lags that is named."""


@dataclass(frozen=True, slots=True)
class TwoLags:
    """A plant that rises with another lag than it falls.

    rises_s, falls_s: its lags, s. bic_gain: by how much it lowers BIC below the best linear model.
    """

    rises_s: float
    falls_s: float
    bic_gain: float

    @property
    def what(self) -> str:
        """The plant in words, with its lags."""
        ratio = max(self.falls_s / self.rises_s, self.rises_s / self.falls_s)
        slowly = "falls more slowly than it rises" if self.falls_s > self.rises_s else "rises more slowly than it falls"
        return f"PV {slowly}: the lag is {self.falls_s:.3g} s falling, {self.rises_s:.3g} s rising ({ratio:.2g} times)"


def find_two_lags(fit: Fit[ExperimentRecord], best: Fitted) -> TwoLags | None:
    """The plant of two lags that explains the record clearly better than the best linear model, and than a gain that
    changes with MV. None where there is none, or where the record has several pieces."""
    record = fit.record
    if len(record.pieces) > 1:
        return None
    u = averaged(record.direction * record.u / record.input_range, fit.block)
    ones = np.ones(len(fit.y))

    def regressors(at: Reals) -> Regressors:
        moved = _answers(u, at, fit.block)[:, : len(ones)]
        return Regressors(np.stack((moved, np.broadcast_to(ones, moved.shape)), axis=2))

    P = fit.period
    starts = np.array([
        (math.log(T * P), math.log(ratio * T * P), math.log(second * P), dead_time * P)
        for T in LAGS for ratio in RATIOS for second in SECOND_LAGS for dead_time in DEAD_TIMES
    ])  # fmt: skip
    left = sums_of_squares_left(regressors(starts).common, fit.y)
    begun = starts[np.argsort(left, kind="stable")[:STARTS]]
    bounds = SearchBounds(
        np.append(np.full(3, math.log(SHORTEST * P)), 0.0),
        np.append(np.full(3, math.log(LONGEST * P)), record.max_dead_time),
        np.append(np.full(3, MAX_LOG_STEP), 0.25 * P),
        np.append(np.full(3, LOG_STEP), LOG_STEP * P),
    )
    found = fit_without_loads(fit, best, regressors, begun, bounds)
    rises_s, falls_s = (math.exp(each) * record.Ts for each in found.at[:2])
    if found.bic_gain < MIN_BIC_GAIN or max(rises_s / falls_s, falls_s / rises_s) < MIN_RATIO:
        return None
    others = fit_changing_gains(fit, replace(best, hypothesis=UNDISTURBED))
    if any(each.bic_gain > found.bic_gain - MIN_BIC_GAIN for each in others):
        return None
    return TwoLags(rises_s, falls_s, found.bic_gain)


def _answers(u: Reals, at: Reals, block: int) -> Reals:
    """The answers of such plants of gain 1, shape (plants, N).

    u: MV, shape (N,), means of so many samples. at: the logarithms of the lags of rising and falling and of the second
    one, and the dead time, all in samples, shape (plants, 4).
    """
    rises, falls, second = (-np.expm1(-block / np.exp(at[:, i])) for i in range(3))
    n = np.arange(len(u))[:, None] - at[:, 3] / block
    driven = np.interp(n, np.arange(len(u)), u, left=0.0)
    first, then, found = np.zeros(len(at)), np.zeros(len(at)), np.empty((len(u), len(at)))
    for k, value in enumerate(driven):
        found[k] = then
        then = then + second * (first - then)
        away = value - first
        first = first + away * np.where(away > 0.0, rises, falls)
    return np.ascontiguousarray(found.T)
