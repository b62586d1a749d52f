"""The sensitivities of the output and of the model of a fitted record to its parameters, for the delta method."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from loopwright.tuning.identification.output_error import LOG_STEP, Fit, Fitted, S
from loopwright.tuning.models import Reals


def sensitivities(fit: Fit[S], found: Fitted) -> Reals:
    """The derivatives of the output by theta and the linear coefficients, in this order, shape (rows, parameters)."""
    structure, hypothesis, c = found.structure, found.hypothesis, found.linear.coefficients
    low, high = fit.bounds(structure, hypothesis)
    # The response has corners, so a time moves by half a sample, or by a whole one with feed-through.
    time = (1.0 if structure.feed_through else 0.5) * fit.block
    step = np.append(np.full(structure.lags, LOG_STEP), np.full(len(found.theta) - structure.lags, time))
    above = [np.minimum(found.theta + move, high) for move in np.diag(step)]
    below = [np.maximum(found.theta - move, low) for move in np.diag(step)]
    outputs = fit.regressors(structure, hypothesis, np.array(above + below)).dense() @ c
    count = len(found.theta)
    apart = np.array([above[i][i] - below[i][i] for i in range(count)])
    slopes = ((outputs[:count] - outputs[count:]) / apart[:, None]).T
    return np.column_stack((slopes, found.columns))


def slopes_of(function: Callable[[Reals], Reals], at: Reals, searched: int) -> Reals:
    """The derivatives of a function by central differences, shape (values, parameters).

    at: the point; its first `searched` values are logarithms and times in samples, the others linear coefficients.
    """
    columns = []
    for i in range(len(at)):
        move = np.zeros(len(at))
        move[i] = LOG_STEP * (abs(at[i]) + 1e-12 if i >= searched else 1.0)
        columns.append((function(at + move) - function(at - move)) / (2.0 * move[i]))
    return np.stack(columns, axis=1)
