"""Whether a second path from MV to PV explains a record as well as the load disturbances of its model do.

A part of MV's effect that comes late, through a long pipe or by recirculation, looks like a load disturbance as long as
the record shows little more than its beginning. The record is therefore fitted again without load disturbances and with
a second path: the lags of the plant once more, with a numerator and a dead time of their own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from loopwright.tuning.fast.record import ExperimentRecord
from loopwright.tuning.fast.score_tests.without_loads import WithoutLoads, at_the_ultimate_period, fit_without_loads
from loopwright.tuning.identification.output_error import (
    LOG_STEP,
    MAX_LOG_STEP,
    DisturbanceHypothesis,
    Fit,
    Fitted,
    sums_of_squares_left,
)
from loopwright.tuning.identification.regressors import Regressors
from loopwright.tuning.identification.variable_projection import SearchBounds
from loopwright.tuning.models import Reals

SPACING = 0.25
"""Spacing of the first guesses of how much later the second path acts, in periods."""
STARTS = 4
MIN_SHARE = 0.05
"""Smallest effect of a second path, as a fraction of the first one at the ultimate period, that matters for Ms."""


@dataclass(frozen=True, slots=True)
class SecondPath:
    """A second path that explains a record without load disturbances.

    later_s: how much later it acts than the first one, s.
    share: its effect at the ultimate period, a fraction of that of the first one.
    bic_gain: by how much it lowers BIC below the model with load disturbances; negative where it raises BIC.
    rms: the rms of the residual that it leaves, as a fraction of the range of PV.
    """

    later_s: float
    share: float
    bic_gain: float
    rms: float


def find_second_path(fit: Fit[ExperimentRecord], best: Fitted) -> SecondPath | None:
    """The second path that explains the record best in place of the load disturbances of the best model.

    None where the model has no load disturbance, where the record has several pieces, or where the second path found
    is too small to matter for Ms.
    """
    record, structure = fit.record, best.structure
    hypothesis = DisturbanceHypothesis(drift=best.hypothesis.drift)
    longest = len(record.u) - record.listened
    if not best.hypothesis.load_disturbances or len(record.pieces) > 1:
        return None
    inputs, lags = structure.inputs, structure.lags

    def regressors(at: Reals) -> Regressors:
        """The regressors at points of theta and then the delay of the second path, shape (points, rows, columns)."""
        later = at[:, :-1].copy()
        later[:, lags] += at[:, -1]
        first, second = (fit.regressors(structure, hypothesis, each).common for each in (at[:, :-1], later))
        return Regressors(np.concatenate((first, second[:, :, :inputs]), axis=2))

    start = best.theta[: structure.searched]
    spacing = SPACING * fit.period
    starts = [np.append(start, at) for at in np.arange(spacing, longest - start[lags], spacing)]
    if not starts:
        return None
    rss = np.concatenate([sums_of_squares_left(regressors(at[None]).common, fit.y) for at in starts])
    begun = np.array([starts[i] for i in np.argsort(rss, kind="stable")[:STARTS]])
    low, high = fit.bounds(structure, hypothesis)
    bounded = SearchBounds(
        np.append(low, 0.0),
        np.append(high, float(longest)),
        np.append(np.full(lags, MAX_LOG_STEP), np.full(2, 0.25 * fit.period)),
        np.append(np.full(lags, LOG_STEP), np.full(2, LOG_STEP * fit.period)),
    )
    found = fit_without_loads(fit, best, regressors, begun, bounded, chosen_among_many=1)
    share = _share(fit, best, found)
    if share < MIN_SHARE:
        return None
    return SecondPath(float(found.at[-1]) * record.Ts, share, found.bic_gain, found.rms)


def _share(fit: Fit[ExperimentRecord], best: Fitted, found: WithoutLoads) -> float:
    """The effect of the second path over that of the first one at the ultimate period."""
    inputs, theta, coefficients = best.structure.inputs, found.at[:-1], found.coefficients
    first, second = (
        abs(at_the_ultimate_period(fit, best, theta, each)) for each in (coefficients[:inputs], coefficients[-inputs:])
    )
    return second / first if first > 0.0 else math.inf
