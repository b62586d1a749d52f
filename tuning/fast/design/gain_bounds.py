"""The largest gains under a bound on Ms (and on Mt) are computed in closed form, without a search along the gain.

At one frequency |1 + Kp*g| >= 1/Ms is a quadratic inequality in Kp and forbids an interval of gains. The gains that all
frequencies permit form one or several intervals; the upper end of each is a candidate. Several intervals exist where
small gains are forbidden too (integrating plants with a short integral time). The bound on Ms holds for unstable loops
as well, so the encirclements of -1 decide which candidate is stable.
"""

from __future__ import annotations

import math

import numpy as np

from loopwright.tuning.models import Complexes, Reals

HIGHEST_END, LOWEST_END = math.radians(45.0), math.radians(-225.0)
"""Limits of the phase of 1 + L at the lowest frequency, unwrapped from the highest: the phase is -90 degrees for a loop
with one integrator and -180 degrees for a loop with two."""

MIN_LOW = 10.0
"""Smallest size, at the lowest frequency, of a loop with two integrators whose encirclements can be counted."""


def largest_gains(g: Complexes, Ms: float, Mt: float | None = None, maximum: float = math.inf) -> list[float]:
    """The gains Kp > 0 at the upper ends of the permitted intervals, in ascending order.

    g: the frequency response of the loop for Kp = 1 on a frequency grid, shape (points,).
    Ms, Mt: the bounds; None for no bound on Mt.
    maximum: a bound on Kp itself. Where it lies inside a permitted interval, it is the upper end of that interval;
    intervals above it are left out.

    The last interval has no upper end on the grid and is left out.
    """
    intervals = [_forbidden(g, 1.0 - 1.0 / Ms**2, 1.0)]
    if Mt is not None:
        # |Kp g| <= Mt |1 + Kp g|
        room = 1.0 - 1.0 / Mt**2
        intervals.append(_forbidden(g, 1.0, room))
    low, high = np.concatenate(intervals, axis=1)
    order = np.argsort(low)
    low = low[order]
    # up to where the intervals that begin before this one reach
    covered = np.maximum.accumulate(np.append(0.0, high[order]))[:-1]
    return [min(float(end), maximum) for end in low[(low > covered) & (maximum > covered)]]


def _forbidden(g: Complexes, minimum: float, leading: float) -> Reals:
    """The forbidden intervals of Kp, shape (2, intervals): their lower and upper ends.

    An interval is where leading*|g|^2 Kp^2 + 2 Re(g) Kp + minimum < 0; only frequencies with such a Kp > 0 have one.
    """
    x, size = g.real, np.abs(g) ** 2
    root = x**2 - leading * size * minimum
    there = (x < 0.0) & (root > 0.0)
    x, size, root = x[there], leading * size[there], np.sqrt(root[there])
    return np.array([(-x - root) / size, (-x + root) / size])


def does_not_encircle(loop: Complexes) -> bool:
    """Whether the Nyquist curve does not encircle -1, so that the closed loop of a stable or integrating plant is
    stable.

    loop: the open loop on a rising frequency grid, shape (points,).
    The result is False as well where a loop with two integrators crosses over too near to the low end of the grid.
    """
    first = loop[0]
    if first.real < -abs(first.imag) and abs(first) < MIN_LOW:
        return False
    phase = np.unwrap(np.angle(1.0 + loop[::-1]))
    return bool(LOWEST_END <= phase[-1] - 2.0 * math.pi * round(float(phase[0]) / (2.0 * math.pi)) <= HIGHEST_END)
