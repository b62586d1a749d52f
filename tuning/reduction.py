"""Simpler models for a given one: the half rule, moments and two areas. The gain is always kept."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from scipy.linalg import expm

from tuning.models import FOPDT, SOPDT, Integrating, Model, integrators
from tuning.reasons import Reason, Refused

SAME_ROOT = 0.01
"""Roots nearer to each other than this, relative to their size, are one multiple root split by rounding."""


def half_rule(model: Model) -> FOPDT | Integrating:
    """FOPDT (of an integrating model: Integrating without lag) by the half rule.

    The largest lag plus half the second is T; the other half, the smaller lags and the time constants of zeros in the
    right half plane go to the dead time. For an integrating model the integrator takes the place of the largest lag, so
    half of its largest lag has nowhere to go and all of it counts as dead time.

    Source: S. Skogestad, Simple analytic rules for model reduction and PID controller tuning, J. Process Control 13
    (2003), eq. (10) and (11). Raises Refused, BAD_INPUT: complex or unstable poles, zeros in the left half plane.
    """
    lags, inverse = _lags(model)
    if integrators(model):
        return Integrating(_slope(model), model.L + sum(lags) + inverse)
    second = lags[1] if len(lags) > 1 else 0.0
    return FOPDT(model.static_gain, lags[0] + second / 2.0, model.L + second / 2.0 + sum(lags[2:]) + inverse)


def half_rule_second_order(model: Model) -> SOPDT | Integrating:
    """SOPDT (of an integrating model: Integrating with a lag) by the half rule; source and errors as `half_rule`.

    A model of first order is refused: it has no second lag.
    """
    lags, inverse = _lags(model)
    if integrators(model):
        second = lags[1] if len(lags) > 1 else 0.0
        lag = lags[0] + second / 2.0 if lags else 0.0
        return Integrating(_slope(model), model.L + second / 2.0 + sum(lags[2:]) + inverse, lag)
    if len(lags) < 2:
        raise Refused(Reason.BAD_INPUT, f"one lag only, {lags[0]:.4g} s: two at least make a second-order model")
    third = lags[2] if len(lags) > 2 else 0.0
    dead = model.L + third / 2.0 + sum(lags[3:]) + inverse
    return SOPDT.of_time_constants(model.static_gain, lags[0], lags[1] + third / 2.0, dead)


def moments(model: Model) -> FOPDT:
    """FOPDT with the mean and the variance of the model's impulse response: T = sqrt(variance), L = mean - T.

    Reproduces the FOPDT models of Romasevych et al., PI-controller tuning optimization via PSO-based technique. Raises
    Refused: NOT_SELF_REGULATING; BAD_INPUT: unstable poles, or moments that no FOPDT has.
    """
    _require_self_regulating(model)
    mean, variance = _moments(model)
    return fopdt_of_moments(model.static_gain, mean, variance)


def two_areas(model: Model) -> FOPDT:
    """FOPDT by the areas above and below the step response (area method), computed exactly.

    A0 = integral of 1 - y/K = T + L;  A1 = integral of y/K from 0 to A0 = T/e. Source: K. J. Astrom, T. Hagglund, PID
    Controllers: Theory, Design and Tuning (1995), section 2.4. Raises Refused as `moments`.
    """
    _require_self_regulating(model)
    mean, _ = _moments(model)
    den = np.asarray(model.den) / model.den[0]
    num = np.concatenate((np.zeros(len(den) - len(model.num)), model.num)) / model.den[0]
    order = len(den) - 1
    # states of the plant, its step, and the integral of its output
    a = np.zeros((order + 2, order + 2))
    a[0, :order] = -den[1:]
    a[1:order, : order - 1] = np.eye(order - 1)
    a[0, order] = 1.0
    a[order + 1, :order] = num[1:] - den[1:] * num[0]
    a[order + 1, order] = num[0]
    until = max(mean - model.L, 0.0)
    return fopdt_of_areas(model.static_gain, mean, float(expm(a * until)[-1, order]) / model.static_gain)


def fopdt_of_moments(K: float, mean: float, variance: float) -> FOPDT:
    """mean: s.  variance: s^2, of the impulse response. Raises Refused, BAD_INPUT: moments that no FOPDT has."""
    T = math.sqrt(max(variance, 0.0))
    return _fopdt(K, T, mean - T, f"a mean of {mean:.4g} s and a variance of {variance:.4g} s^2")


def fopdt_of_areas(K: float, A0: float, A1: float) -> FOPDT:
    """A0, A1: s, of the step response divided by K. Raises Refused, BAD_INPUT: areas that no FOPDT has."""
    T = math.e * A1
    return _fopdt(K, T, A0 - T, f"areas of {A0:.4g} s and {A1:.4g} s")


def _fopdt(K: float, T: float, L: float, found: str) -> FOPDT:
    # a first-order lag itself comes out with a dead time that is 0 but for rounding
    if -1e-9 * T <= L < 0.0:
        L = 0.0
    if not (T > 0.0 and L >= 0.0):
        raise Refused(Reason.BAD_INPUT, f"{found} would need T = {T:.4g} s and L = {L:.4g} s: no FOPDT model has them")
    return FOPDT(K, T, L)


def _slope(model: Model) -> float:
    """Of an integrating model: PV units per MV unit and second, signed."""
    return model.num[-1] / model.den[-2]


def _moments(model: Model) -> tuple[float, float]:
    """(mean in s, variance in s^2) of the impulse response."""

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


def _lags(model: Model) -> tuple[list[float], float]:
    """(lags in s from the largest down, without the integrator; sum of the right zeros' time constants in s)."""
    poles = _clustered(np.roots(np.trim_zeros(np.asarray(model.den), "b")))
    _require_stable(poles)
    for p in poles:
        if p.imag:
            raise Refused(Reason.BAD_INPUT, f"complex poles, {p:.4g} rad/s: the half rule needs real ones")
    inverse = 0.0
    for z in _clustered(np.roots(model.num)):
        if z.imag or z.real < 0.0:
            raise Refused(Reason.BAD_INPUT, f"a zero at {z:.4g} rad/s: the half rule takes right real zeros only")
        inverse += 1.0 / z.real
    return sorted((-1.0 / p.real for p in poles), reverse=True), inverse


def _clustered(roots: Iterable[complex]) -> list[complex]:
    """Roots with the clusters into which rounding splits a multiple root put back on their mean."""
    left = [complex(r) for r in roots]
    found: list[complex] = []
    while left:
        first = left.pop()
        near = [r for r in left if abs(r - first) < SAME_ROOT * abs(first)]
        left = [r for r in left if r not in near]
        mean = sum([first, *near]) / (len(near) + 1)
        if abs(mean.imag) < 1e-6 * abs(mean):
            mean = complex(mean.real)
        found += [mean] * (len(near) + 1)
    return found
