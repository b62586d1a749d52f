"""The pole-placement paper's own equations, order by order, as the independent oracle of the general form.

Misprints are corrected: the coefficients of the closed loop and of J's denominators follow from the derivation.
"""

from __future__ import annotations

import numpy as np

from loopwright.tuning.models import Reals


def first_order(k: float, T: float, alpha: float, mu: float) -> tuple[float, float]:
    """(Kp, Ki) for k/(T s + 1)."""
    return (2.0 * alpha * T - 1.0) / k, alpha**2 * (1.0 + mu**2) * T / k


def second_order(a: tuple[float, ...], b: tuple[float, ...], alpha: float, mu: float) -> Reals:
    """(Kp, Ki) for (b0 s + b1)/(a0 s^2 + a1 s + a2)."""
    (a0, a1, a2), (b0, b1), r = a, b, 1.0 + mu**2
    matrix = [[2.0 * alpha * b0 - b1, -b0], [-b0 * alpha**2 * r, b1]]
    side = [a2 + a0 * alpha**2 * (4.0 - r) - 2.0 * alpha * a1, alpha**2 * r * (a1 - 2.0 * a0 * alpha)]
    return np.linalg.solve(matrix, side)


def third_order(a: tuple[float, ...], b: tuple[float, ...], alpha: float, mu: float, k1: float) -> Reals:
    """(Kd, Kp, Ki) for (b0 s + b1)/(a0 s^3 + a1 s^2 + a2 s + a3)."""
    (a0, a1, a2, a3), (b0, b1), r, kg = a, b, 1.0 + mu**2, k1 + 2.0
    matrix = [
        [alpha * b0 * kg - b1, -b0, 0.0],
        [b0 * alpha**2 * (r + 2.0 * k1), -b1, -b0],
        [alpha**3 * r * b0 * k1, 0.0, -b1],
    ]
    side = [
        a0 * alpha**2 * (4.0 + kg * k1 - r) - kg * alpha * a1 + a2,
        2.0 * a0 * alpha**3 * (k1 * kg + r) - alpha**2 * (r + 2.0 * k1) * a1 + a3,
        alpha**3 * r * k1 * (a0 * alpha * kg - a1),
    ]
    return np.linalg.solve(matrix, side)


def square(c: Reals, d: Reals) -> float:
    """Integral of the square of c(s)/d(s), d stable of degree 2 to 4 (Newton, Gould and Kaiser's table)."""
    if len(d) == 3:
        (c0, c1), (d0, d1, d2) = c, d
        return float((c0**2 * d2 + c1**2 * d0) / (2.0 * d0 * d1 * d2))
    if len(d) == 4:
        (c0, c1, c2), (d0, d1, d2, d3) = c, d
        upper = c0**2 * d2 * d3 + (c1**2 - 2.0 * c0 * c2) * d0 * d3 + c2**2 * d0 * d1
        return float(upper / (2.0 * d0 * d3 * (d1 * d2 - d0 * d3)))
    (c0, c1, c2, c3), (d0, d1, d2, d3, d4) = c, d
    upper = c0**2 * (d2 * d3 * d4 - d1 * d4**2) + (c1**2 - 2.0 * c0 * c2) * d0 * d3 * d4
    upper += (c2**2 - 2.0 * c1 * c3) * d0 * d1 * d4 + c3**2 * (d0 * d1 * d2 - d0**2 * d3)
    return float(upper / (2.0 * d0 * d4 * (d1 * d2 * d3 - d1**2 * d4 - d0 * d3**2)))


def J0_J1(a: Reals, b: Reals, n: Reals) -> tuple[float, float]:
    """Of plant b/a and controller n/s, the loop strictly proper: E = a/P and E1 = (s*a - P)/P."""
    sa = np.append(a, 0.0)
    P = np.polyadd(sa, np.polymul(n, b))
    return square(np.asarray(a), P), square((sa - P)[1:], P)
