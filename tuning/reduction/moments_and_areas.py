"""The reduction of a model to FOPDT by moments or by two areas; the gain stays the same."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from scipy.linalg import companion, expm, matrix_balance

from loopwright.tuning.models import FOPDT, AnyModel, Model, as_model, integrators, monic
from loopwright.tuning.reasons import Reason, Refused


def moments(model: AnyModel) -> FOPDT:
    """The FOPDT model with the mean and the variance of the model's impulse response: T = sqrt(variance), L = mean - T.

    The reduction reproduces the FOPDT models of Romasevych et al., PI-controller tuning optimization via PSO-based
    technique. Raises Refused: NOT_SELF_REGULATING; BAD_INPUT for unstable poles, or moments that no FOPDT model has.
    """
    model = as_model(model)
    _require_self_regulating(model)
    mean, variance = _moments(model)
    return fopdt_of_moments(model.static_gain, mean, variance)


def two_areas(model: AnyModel) -> FOPDT:
    """The FOPDT model by the areas above and below the step response (area method), computed exactly.

    A0 = integral of 1 - y/K = T + L;  A1 = integral of y/K from 0 to A0 = T/e. Source: K. J. Astrom, T. Hagglund, PID
    Controllers: Theory, Design and Tuning (1995), section 2.4. Raises Refused as `moments`.
    """
    model = as_model(model)
    _require_self_regulating(model)
    mean, _ = _moments(model)
    return fopdt_of_areas(model.static_gain, mean, _area_to(model, max(mean - model.L, 0.0)))


def _area_to(model: Model, until: float) -> float:
    """The integral of the step response without its dead time, divided by K, from 0 to `until`, s."""
    num, den = monic(model)
    order = len(den) - 1
    # in units of `until`, and balanced: in seconds the coefficients of slow or of many lags are powers too far apart
    unit = until ** np.arange(order + 1.0)
    num, den = num * unit, den * unit
    # states of the plant, its step, and the integral of its output
    a = np.zeros((order + 2, order + 2))
    a[:order, :order] = companion(den)
    a[0, order] = 1.0
    a[order + 1, :order] = num[1:] - den[1:] * num[0]
    a[order + 1, order] = num[0]
    balanced, (scale, _) = matrix_balance(a, permute=False, separate=True)
    area = float(expm(balanced)[-1, order] * scale[-1] / scale[order])
    return until * area / model.static_gain


def fopdt_of_moments(K: float, mean: float, variance: float) -> FOPDT:
    """The FOPDT model with this mean (s) and variance (s^2) of the impulse response. Raises Refused, BAD_INPUT: moments
    that no FOPDT model has."""
    T = math.sqrt(max(variance, 0.0))
    return _fopdt(K, T, mean - T, f"a mean of {mean:.4g} s and a variance of {variance:.4g} s^2")


def fopdt_of_areas(K: float, A0: float, A1: float) -> FOPDT:
    """The FOPDT model with these areas A0, A1 (s) of the step response divided by K. Raises Refused, BAD_INPUT: areas
    that no FOPDT model has."""
    T = math.e * A1
    return _fopdt(K, T, A0 - T, f"areas of {A0:.4g} s and {A1:.4g} s")


def _fopdt(K: float, T: float, L: float, found: str) -> FOPDT:
    # a first-order lag itself comes out with a dead time that is 0 but for rounding
    if -1e-9 * T <= L < 0.0:
        L = 0.0
    if not (T > 0.0 and L >= 0.0):
        raise Refused(Reason.BAD_INPUT, f"{found} would need T = {T:.4g} s and L = {L:.4g} s: no FOPDT model has them")
    return FOPDT(K, T, L)


def _moments(model: Model) -> tuple[float, float]:
    """The mean (s) and the variance (s^2) of the impulse response."""

    def of(p: tuple[float, ...]) -> tuple[float, float]:
        low = [*reversed(p), 0.0, 0.0]
        first, second = low[1] / low[0], low[2] / low[0]
        return first, first * first - 2.0 * second

    mean, variance = (d - n for d, n in zip(of(model.den), of(model.num), strict=True))
    return model.L + mean, variance


def _require_self_regulating(model: Model) -> None:
    if integrators(model):
        raise Refused(Reason.NOT_SELF_REGULATING, "the model has a pole at the origin: its step response has no end")
    _require_stable(np.roots(model.den))


def _require_stable(poles: Iterable[complex]) -> None:
    right = [complex(p) for p in poles if p.real >= 0.0]
    if right:
        raise Refused(Reason.BAD_INPUT, f"an unstable pole, {right[0]:.4g} rad/s: reductions need a stable model")
