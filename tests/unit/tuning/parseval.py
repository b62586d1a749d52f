"""Integrals of squares by frequency alone: (1/pi) * integral of |F(jw)|^2, the independent oracle of the criteria."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Complexes, Model, Reals, sign
from tests.unit.tuning.isa import response


def error_squares(model: Model, gains: Gains, low: float, high: float) -> tuple[float, float]:
    """(integral of e^2, of e'^2 after t = 0) of a unit set-point step; low, high: rad/s between which all happens.

    For strictly proper loops. Below `low` the integrands are flat, above `high` they fall as e does: 1/w^2.
    """

    def loop(w: Reals) -> Complexes:
        return sign(model) * model.frequency_response(w) * response(gains, 1j * w)

    def error(w: Reals) -> Complexes:
        return 1.0 / (1j * w * (1.0 + loop(w)))

    def rate(w: Reals) -> Complexes:
        # s*E - e(0+)
        return -loop(w) / (1.0 + loop(w))

    e2, rate2 = (_integral(f, low, high) for f in (error, rate))
    return e2 + 1.0 / (math.pi * high), rate2


def _integral(f: Callable[[Reals], Complexes], low: float, high: float) -> float:
    points, weights = np.polynomial.legendre.leggauss(20)
    edges = np.unique(np.concatenate((np.geomspace(low, high, 400), np.linspace(low, high, 4000))))
    half, middle = 0.5 * np.diff(edges), 0.5 * (edges[1:] + edges[:-1])
    w = middle[:, None] + half[:, None] * points
    inside = float(np.sum(half[:, None] * weights * np.abs(f(w)) ** 2))
    return (inside + low * float(abs(f(np.array([low]))[0])) ** 2) / math.pi
