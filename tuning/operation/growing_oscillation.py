"""Whether a loop oscillates near its crossover with an amplitude that grows from period to period.

The half periods of PV are those between its extremes, smoothed over an eighth of the ultimate period, that are as far
apart as the noise asks for. What operators and loads move dies out in a stable loop; what the set-point moves is left
out by looking only at the time since.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from loopwright.tuning.identification.oscillation import fit_growth
from loopwright.tuning.identification.output_error import averaged
from loopwright.tuning.models import Reals
from loopwright.tuning.operation.history import Stretch

PERIODS = 3
"""Periods over which an oscillation must grow."""
PERIOD_RANGE = (0.6, 3.0)
"""Shortest and longest period of an oscillation near the crossover, in ultimate periods: the integral of a PI makes
the period longer, and a second path that acts later yet more."""
EVEN = 0.5
"""Largest difference of a half period from the median of all, as a fraction of it."""
GROWTH = 1.12
"""Smallest ratio of a height, from one extreme to the next, to that of a period before, as measured and by the fit."""
MIN_NOISES = 10.0
"""Smallest last height, in standard deviations of the noise."""
MIN_EXPLAINED = 0.85
"""Smallest part of the variance of PV that one oscillation explains."""
SMOOTHED = 0.125
"""Time over which PV is averaged, in ultimate periods."""


@dataclass(frozen=True, slots=True)
class Growing:
    """An oscillation that grows.

    period_s: its period, s. peak_to_peak: from the last extreme but one to the last, PV units.
    per_period: the ratio of the heights of one period and the period before.
    """

    period_s: float
    peak_to_peak: float
    per_period: float


def growing(stretch: Stretch, period_s: float) -> Growing | None:
    """The oscillation that grows in the latest time of a stretch; None where there is none.

    period_s: the ultimate period, s.
    """
    longest = round((PERIODS + 1) * PERIOD_RANGE[1] * period_s / stretch.Ts)
    moves = stretch.moves
    first = max(len(stretch.pv) - longest, moves[-1] if moves else 0)
    pv = np.asarray(stretch.pv[first:], dtype=np.float64)
    block = max(1, round(SMOOTHED * period_s / stretch.Ts / 3.0))
    rows = len(pv) // block
    if rows < 3 * 2 * PERIODS:
        return None
    y = averaged(pv[len(pv) - rows * block :], block)
    noise = 0.5 * float(np.sqrt(np.mean(np.diff(y, 2) ** 2) / 1.5))
    T = block * stretch.Ts
    return _growing(y, T, noise, period_s)


def _growing(y: Reals, T: float, noise: float, period_s: float) -> Growing | None:
    wanted = 2 * PERIODS + 1
    at = _extremes(y, max(MIN_NOISES / 2.0 * noise, 1e-12))
    if len(at) < wanted:
        return None
    at = at[-wanted:]
    halves, heights = np.diff(at) * T, np.abs(np.diff(y[at]))
    period = 2.0 * float(np.median(halves))
    low, high = PERIOD_RANGE
    even = np.all(np.abs(halves / (0.5 * period) - 1.0) <= EVEN)
    if not (even and low * period_s <= period <= high * period_s):
        return None
    if not np.all(heights[2:] >= GROWTH * heights[:-2]) or heights[-1] < MIN_NOISES * noise:
        return None
    part = y[at[0] : at[-1] + 1]
    found = fit_growth(np.asarray(T * np.arange(len(part))), part, period)
    variance = float(np.var(part))
    explained = 1.0 - found.noise**2 / variance if variance > 0.0 else 0.0
    ratio = math.exp(found.log_per_period)
    if explained < MIN_EXPLAINED or ratio < GROWTH or found.log_per_period < 3.0 * found.error:
        return None
    return Growing(period, float(heights[-1]), ratio)


def _extremes(y: Reals, apart: float) -> list[int]:
    """The extremes of a signal, each at least this far from the one before, in turn a maximum and a minimum."""
    found: list[int] = []
    high = low = 0
    rising = 0
    for k, value in enumerate(y.tolist()):
        high = k if value > y[high] else high
        low = k if value < y[low] else low
        if rising >= 0 and y[high] - value > apart:
            found.append(high)
            rising, low = -1, k
        elif rising <= 0 and value - y[low] > apart:
            found.append(low)
            rising, high = 1, k
    return found
