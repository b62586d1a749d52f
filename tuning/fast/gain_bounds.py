"""The largest gains under a bound on Ms (and on Mt), in closed form: no search along the gain.

At one frequency |1 + Kp*g| >= 1/Ms is a quadratic inequality in Kp and forbids an interval. What all frequencies leave
falls into pieces; the upper end of each is a candidate, and several exist where small gains are forbidden too
(integrating plants with a short integral time). Which of them is stable, the encirclements tell: the bound on Ms alone
holds for unstable loops as well.
"""

from __future__ import annotations

import math

import numpy as np

from loopwright.tuning.models import Complexes, Reals

HIGHEST_END, LOWEST_END = math.radians(45.0), math.radians(-225.0)
"""Phase of 1 + L at the lowest frequency, unwrapped from the highest: -90 degrees for one integrator, -180 for two."""

MIN_LOW = 10.0
"""Of a loop with two integrators at the lowest frequency."""


def largest_gains(g: Complexes, Ms: float, Mt: float | None = None, maximum: float = math.inf) -> list[float]:
    """Kp > 0 at the upper end of each permitted piece, ascending. g: the loop for Kp = 1 on a grid, shape (points,).

    maximum: a bound on Kp itself. It may lie where smaller gains are forbidden too, and then leaves those below alone.

    The last piece, which has no end, is left out: the grid ends before its gains do.
    """
    intervals = [_forbidden(g, 1.0 - 1.0 / Ms**2, 1.0)]
    if Mt is not None:
        # |Kp g| <= Mt |1 + Kp g|
        room = 1.0 - 1.0 / Mt**2
        intervals.append(_forbidden(g, 1.0, room))
    low, high = np.concatenate(intervals, axis=1)
    order = np.argsort(low)
    found: list[float] = []
    covered = 0.0
    for a, b in zip(low[order], high[order], strict=True):
        if a > covered and maximum > covered:
            found.append(min(float(a), maximum))
        covered = max(covered, float(b))
    return found


def _forbidden(g: Complexes, minimum: float, leading: float) -> Reals:
    """(low, high) of leading*|g|^2 Kp^2 + 2 Re(g) Kp + least < 0 at each frequency where there is such a Kp > 0."""
    x, size = g.real, np.abs(g) ** 2
    root = x**2 - leading * size * minimum
    there = (x < 0.0) & (root > 0.0)
    x, size, root = x[there], leading * size[there], np.sqrt(root[there])
    return np.array([(-x - root) / size, (-x + root) / size])


def does_not_encircle(loop: Complexes) -> bool:
    """The closed loop is stable, for a plant without poles in the right half plane; loop on a rising grid.

    False as well where two integrators cross over too near to the grid's low end to tell.
    """
    first = loop[0]
    if first.real < -abs(first.imag) and abs(first) < MIN_LOW:
        return False
    phase = np.unwrap(np.angle(1.0 + loop[::-1]))
    return bool(LOWEST_END <= phase[-1] - 2.0 * math.pi * round(float(phase[0]) / (2.0 * math.pi)) <= HIGHEST_END)
