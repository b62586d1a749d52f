"""Loads at the plant's inlet, over time, in percent of MV; sines and steps at the sensor are the same elsewhere."""

from __future__ import annotations

import math
from collections.abc import Callable

from benchmarks.trouble.chain import Part, Setting
from loopwright.tuning.models import Reals

Size = Callable[[float], float]
"""Over time in Pu."""


class Added(Part):
    """A load at the plant's inlet, percent of MV, by the fine step.

    of: its size so many Pu from the first step, or where `from_test` from the beginning of the test (0 before).
    """

    def __init__(self, setting: Setting, of: Size, from_test: bool) -> None:
        self._of, self._each, self._n = of, 1.0 / setting.steps(1.0), 0
        self._runs = not from_test

    def begin(self) -> None:
        self._runs = True

    def step(self, value: float) -> float:
        if not self._runs:
            return value
        self._n += 1
        return value + self._of(self._n * self._each)


def random_walk(setting: Setting, after_a_period: float, most: float) -> Size:
    """The size over time of a load that walks: its standard deviation after 1 Pu, drawn for so many Pu."""
    count, per = setting.steps(most), setting.steps(1.0)
    moves: Reals = setting.random(3).standard_normal(count).cumsum() * after_a_period / math.sqrt(per)
    return lambda t: float(moves[min(round(t * per), count - 1)])


def sine(amplitude: float, frequency: float) -> Size:
    """frequency: in ultimate frequencies."""
    return lambda t: amplitude * math.sin(2.0 * math.pi * frequency * t)


def ramp(rate: float) -> Size:
    """rate: percent in Pu."""
    return lambda t: rate * t


def lagged_step(size: float, at: float, lag: float) -> Size:
    """A step at a time, through a lag, both in Pu."""
    return lambda t: size * -math.expm1(-(t - at) / lag) if t > at else 0.0
