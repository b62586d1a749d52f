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
from loopwright.tuning.identification.output_error import (
    FLOOR,
    LOG_STEP,
    MAX_LOG_STEP,
    DisturbanceHypothesis,
    Fit,
    Fitted,
    sums_of_squares_left,
)
from loopwright.tuning.identification.variable_projection import SearchBounds, descend, solve
from loopwright.tuning.models import Reals

SPACING = 0.25
"""Spacing of the first guesses of how much later the second path acts, in periods."""
STARTS, MAX_STEPS = 4, 12
RELATIVE_DECREASE = 1e-5
MIN_SHARE = 0.05
"""Smallest effect of a second path, as a fraction of the first one at the ultimate period, that matters for Ms."""


@dataclass(frozen=True, slots=True)
class SecondPath:
    """A second path that explains a record without load disturbances.

    later_s: how much later it acts than the first one, s.
    share: its effect at the ultimate period, a fraction of that of the first one.
    gain: by how much it lowers BIC below the model with load disturbances; negative where it raises BIC.
    rms: the rms of the residual that it leaves, as a fraction of the range of PV.
    """

    later_s: float
    share: float
    gain: float
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

    def columns(at: Reals) -> Reals:
        """The regressors at points of theta and then the delay of the second path, shape (points, rows, columns)."""
        later = at[:, :-1].copy()
        later[:, lags] += at[:, -1]
        first = fit.regressors(structure, hypothesis, at[:, :-1])
        return np.concatenate((first, fit.regressors(structure, hypothesis, later)[:, :, :inputs]), axis=2)

    start = best.theta[: structure.searched]
    spacing = SPACING * fit.period
    starts = [np.append(start, at) for at in np.arange(spacing, longest - start[lags], spacing)]
    if not starts:
        return None
    rss = np.concatenate([sums_of_squares_left(columns(at[None]), fit.y) for at in starts])
    begun = np.array([starts[i] for i in np.argsort(rss, kind="stable")[:STARTS]])
    low, high = fit.bounds(structure, hypothesis)
    bounded = SearchBounds(
        np.append(low, 0.0),
        np.append(high, float(longest)),
        np.append(np.full(lags, MAX_LOG_STEP), np.full(2, 0.25 * fit.period)),
        np.append(np.full(lags, LOG_STEP), np.full(2, LOG_STEP * fit.period)),
    )
    points, left = descend(columns, fit.y, begun, bounded, MAX_STEPS, RELATIVE_DECREASE)
    found = points[int(np.argmin(left))]
    regressors = columns(found[None])[0]
    linear = solve(regressors, fit.y)
    share = _share(fit, best, found, linear.coefficients)
    if share < MIN_SHARE:
        return None
    # the delay was chosen among many: it counts twice, as the time of a load disturbance does
    parameters = len(found) + regressors.shape[1] + 1
    bic = fit.samples * math.log(linear.rss / fit.samples + FLOOR**2) + parameters * math.log(fit.samples)
    rms = math.sqrt(linear.rss / len(linear.residual))
    return SecondPath(float(found[-1]) * record.Ts, share, best.bic - bic, rms)


def _share(fit: Fit[ExperimentRecord], best: Fitted, found: Reals, coefficients: Reals) -> float:
    """The effect of the second path over that of the first one at the ultimate period."""
    structure, inputs = best.structure, best.structure.inputs
    w = np.array([2.0 * math.pi / (fit.period * fit.record.Ts)])
    theta = found[:-1]
    first, second = (
        abs(complex(fit.transfer(structure, theta, each).frequency_response(w)[0]))
        for each in (coefficients[:inputs], coefficients[-inputs:])
    )
    return second / first if first > 0.0 else math.inf
