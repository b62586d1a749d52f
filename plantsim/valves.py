"""What a valve makes of MV: slack, friction, a characteristic. All in percent of MV, in deviations from rest."""

from __future__ import annotations

import math
from typing import Protocol


class Valve(Protocol):
    """Something between MV and the process."""

    def step(self, value: float) -> float:
        """Returns where the valve is, or what flows through it, after MV was `value` for a sampling period."""
        ...


class Backlash:
    """Follows MV half of the slack behind.

    slack_pct: the whole slack, percent of MV.  at: where in it the valve starts, -1 (wholly below MV) to 1.
    """

    def __init__(self, slack_pct: float, at: float = 0.0) -> None:
        self._half = 0.5 * slack_pct
        self._position = self._half * at

    def step(self, value: float) -> float:
        away = value - self._position
        self._position += math.copysign(max(abs(away) - self._half, 0.0), away)
        return self._position


class Stiction:
    """Stays until MV is off by more than `band_pct`, then jumps there (Choudhury et al. 2005, with S = J)."""

    def __init__(self, band_pct: float) -> None:
        self._band, self._position = band_pct, 0.0

    def step(self, value: float) -> float:
        if abs(value - self._position) > self._band:
            self._position = value
        return self._position


class EqualPercentage:
    """The flow goes with R^(opening/100); its gain at rest is 1.

    R: the rangeability, flow at 100 % over flow at 0 %; above 1.
    """

    def __init__(self, R: float) -> None:
        self._rate = math.log(R) / 100.0

    def step(self, value: float) -> float:
        return math.expm1(self._rate * value) / self._rate

    def slope(self, value: float) -> float:
        """Returns the gain at this deviation from rest."""
        return math.exp(self._rate * value)


class TwoGains:
    """The gain below rest is so many times that above it, which is 1: a heater that cools in another way."""

    def __init__(self, below: float) -> None:
        self._below = below

    def step(self, value: float) -> float:
        return value if value > 0.0 else self._below * value
