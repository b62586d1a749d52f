"""Euler's method on a PI loop without dead time: the integration that the ME-PSO paper's numbers betray."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

BAND = 0.05


@dataclass(frozen=True, slots=True)
class Rational:
    """num(s)/den(s), coefficients from the highest power down, num of first order at most."""

    num: list[float]
    den: list[float]


def euler_indices(plant: Rational, Kp: float, Ti: float, step_s: float, end_s: float) -> tuple[float, ...]:
    """(MIE, MIC, overshoot in percent, ts in s) of a unit set-point step; Ti is the reciprocal of the integral gain.

    A zero acts on the backward difference of MV, which leaves out its jump at t = 0.
    """
    order = len(plant.den) - 1
    lowest = [c / plant.den[0] for c in plant.den[1:]]
    slope = plant.num[0] / plant.den[0] if len(plant.num) > 1 else 0.0
    gain = plant.num[-1] / plant.den[0]
    steps = round(end_s / step_s)
    x = [0.0] * order
    integral, before = 0.0, Kp
    e_of, u_of = np.zeros(steps + 1), np.zeros(steps + 1)
    for k in range(steps + 1):
        e = 1.0 - x[0]
        u = Kp * e + integral
        e_of[k], u_of[k] = e, u
        top = gain * u + slope * (u - before) / step_s - sum(c * v for c, v in zip(reversed(lowest), x, strict=True))
        x = [v + step_s * rate for v, rate in zip(x, [*x[1:], top], strict=True)]
        integral += step_s * e / Ti
        before = u
    last = int(np.flatnonzero(np.abs(e_of) > BAND)[-1]) + 1
    error, control = (float(np.mean(np.abs(each[:last]))) for each in (e_of, u_of))
    return error, control, 100.0 * max(0.0, -float(e_of.min())), step_s * last
