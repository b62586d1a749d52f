"""A record fitted without load disturbances and with something else instead, that may explain it as well."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from loopwright.tuning.fast.record import ExperimentRecord
from loopwright.tuning.identification.output_error import FLOOR, Fit, Fitted
from loopwright.tuning.identification.regressors import Regressors
from loopwright.tuning.identification.variable_projection import SearchBounds, descend, solve
from loopwright.tuning.models import Reals

MAX_STEPS, RELATIVE_DECREASE = 12, 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class WithoutLoads:
    """A fit without load disturbances.

    at: the searched parameters. coefficients: those of the columns, with MV in units of its range and PV of its.
    bic_gain: by how much the fit lowers BIC below the model with load disturbances; negative where it raises BIC.
    rms: the rms of the residual that it leaves, as a fraction of the range of PV.
    """

    at: Reals
    coefficients: Reals
    bic_gain: float
    rms: float


def fit_without_loads(
    fit: Fit[ExperimentRecord],
    best: Fitted,
    regressors: Callable[[Reals], Regressors],
    starts: Reals,
    bounds: SearchBounds,
    chosen_among_many: int = 0,
) -> WithoutLoads:
    """The fit that is reached from these starts.

    regressors: gives a set of regressors for each point of the searched parameters.
    starts: shape (starts, searched parameters).
    chosen_among_many: how many of the parameters were chosen among many first guesses: those count twice in BIC, as
    the time of a load disturbance does.
    """
    points, left = descend(regressors, fit.y, starts, bounds, MAX_STEPS, RELATIVE_DECREASE)
    at = points[int(np.argmin(left))]
    columns = regressors(at[None]).dense()[0]
    linear = solve(columns, fit.y)
    parameters = len(at) + columns.shape[1] + chosen_among_many
    bic = fit.samples * math.log(linear.rss / fit.samples + FLOOR**2) + parameters * math.log(fit.samples)
    rms = math.sqrt(linear.rss / len(linear.residual))
    return WithoutLoads(at, linear.coefficients, best.bic - bic, rms)


def at_the_ultimate_period(fit: Fit[ExperimentRecord], best: Fitted, theta: Reals, coefficients: Reals) -> complex:
    """The frequency response at the ultimate period of these parameters of the structure of the best model."""
    w = np.array([2.0 * math.pi / (fit.period * fit.record.Ts)])
    return complex(fit.transfer(best.structure, theta, coefficients).frequency_response(w)[0])
