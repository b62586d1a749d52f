"""The growth of an oscillation is fitted to the whole record instead of being read off its peaks.

    y(t) = c0 + c1 t + c2 t^2 + exp(sigma t) (a cos wt + b sin wt)

c0..c2 and a, b are eliminated by linear least squares (variable projection); sigma and w are searched. The trend
absorbs the transient of a slow pole, so a drifting mean is not mistaken for growth (the peak heights of the paper's
procedure mix the two), and noise averages out over every sample. The guards of Stage 2 of the five-stage procedure need
this.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Array = NDArray[np.float64]
PER_PERIOD = 24
"""Samples per period that the fit uses; faster records are averaged in bins, which loses no useful information."""


@dataclass(frozen=True, slots=True)
class Growth:
    """The growth of an oscillation.

    log_per_period: the logarithm of the ratio of the amplitudes of one period and the period before.
    error: the standard error of log_per_period.
    period: the period, s.
    amplitude: the amplitude at the middle of the record, PV units.
    mean: the trend at the middle of the record, PV units.
    noise: the standard deviation of the residual, PV units.
    """

    log_per_period: float
    error: float
    period: float
    amplitude: float
    mean: float
    noise: float


def fit_growth(t: Array, y: Array, period_guess: float) -> Growth:
    """Fits the model above to a record of at least about 1.5 periods.

    t: the times of the samples, s, evenly spaced.
    y: PV, shape (N,).
    period_guess: a rough period, s.
    """
    bins = max(1, int(period_guess / (t[1] - t[0]) / PER_PERIOD))
    if bins > 1:
        count = len(t) // bins
        t = t[: count * bins].reshape(count, bins).mean(axis=1)
        y = y[: count * bins].reshape(count, bins).mean(axis=1)
    centre = 0.5 * (t[0] + t[-1])
    x = (t - centre) / period_guess
    trend = np.stack([np.ones_like(x), x, x * x], axis=1)

    def solve(p: Array) -> tuple[Array, Array]:
        envelope = np.exp(np.clip(p[0] * x, -30.0, 30.0))
        basis = np.column_stack([trend, envelope * np.cos(p[1] * x), envelope * np.sin(p[1] * x)])
        coefficients = np.linalg.lstsq(basis, y, rcond=None)[0]
        return coefficients, basis @ coefficients - y

    def residuals(p: Array) -> Array:
        return solve(p)[1]

    best = least_squares(residuals, np.array([0.0, 2 * math.pi]), method="lm", xtol=1e-9, max_nfev=60)
    coefficients, residual = solve(best.x)
    sigma, w = float(best.x[0]), abs(float(best.x[1]))
    freedom = max(1, len(y) - 7)
    variance = float(residual @ residual) / freedom
    jacobian = np.asarray(best.jac, dtype=np.float64)
    try:
        spread = math.sqrt(abs(variance * float(np.linalg.inv(jacobian.T @ jacobian)[0, 0])))
    except np.linalg.LinAlgError:
        spread = math.inf
    return Growth(
        log_per_period=sigma * 2 * math.pi / w,
        error=spread * 2 * math.pi / w,
        period=2 * math.pi / w * period_guess,
        amplitude=float(np.hypot(coefficients[3], coefficients[4])),
        mean=float(coefficients[0]),
        noise=math.sqrt(variance * bins),
    )


def harmonic(t: Array, y: Array, period: float) -> complex:
    """The first harmonic of y at this period (s) as a phasor in y's unit, by least squares over whole periods."""
    w = 2 * math.pi / period
    basis = np.stack([np.ones_like(t), np.cos(w * t), -np.sin(w * t)], axis=1)
    c = np.linalg.lstsq(basis, y, rcond=None)[0]
    return complex(c[1], c[2])
