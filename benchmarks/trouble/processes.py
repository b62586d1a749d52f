"""What lies between the valve and the sensor: the linear plant, a second path, what comes back to the inlet."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from benchmarks.trouble.chain import Part, Setting
from benchmarks.trouble.response import Response, gain, rational
from loopwright.plantsim.plant import LinearPlant
from loopwright.tuning.models import Complexes


class Linear(Part):
    """num(s)/den(s) exp(-L s), exact between the steps."""

    def __init__(self, num: Sequence[float], den: Sequence[float], L: float, h: float) -> None:
        self._plant = LinearPlant(num, den, L, h)
        self._response = rational(num, den, L)

    def step(self, value: float) -> float:
        return self._plant.step(value)

    def linearisations(self) -> list[Response]:
        return [self._response]


def linear(setting: Setting) -> Linear:
    """The plant without trouble."""
    plant = setting.plant
    return Linear(plant.num, plant.den, plant.L, setting.h)


class SecondPath(Part):
    """The same effect once more, `share` times as large, so many Pu later: G(s) (1 + share exp(-later s))."""

    def __init__(self, setting: Setting, share: float, later: float) -> None:
        plant, self._share, self._later_s = setting.plant, share, later * setting.plant.Pu
        self._first = linear(setting)
        self._second = Linear(plant.num, plant.den, plant.L + self._later_s, setting.h)

    def step(self, value: float) -> float:
        return self._first.step(value) + self._share * self._second.step(value)

    def linearisations(self) -> list[Response]:
        [first] = self._first.linearisations()

        def at(s: Complexes) -> Complexes:
            return first.at(s) * (1.0 + self._share * np.exp(-self._later_s * s))

        return [Response(at, first.delay_s + self._later_s, first.unstable)]


class Recirculation(Part):
    """`share` of the outlet comes back to the inlet, so many Pu later: G(s)/(1 - share G(s) exp(-later s)).

    It is stable for |share| < 1 where |G(jw)| <= 1, as it is for lags of gain 1.
    """

    def __init__(self, setting: Setting, share: float, later: float) -> None:
        self._share, self._later_s = share, later * setting.plant.Pu
        self._process = linear(setting)
        # what is on its way, oldest first; it is held for a step, which comes half a step late
        self._way = deque([0.0] * setting.steps(later))

    def step(self, value: float) -> float:
        outlet = self._process.step(value + self._share * self._way.popleft())
        self._way.append(outlet)
        return outlet

    def linearisations(self) -> list[Response]:
        [once] = self._process.linearisations()

        def at(s: Complexes) -> Complexes:
            G = once.at(s)
            return G / (1.0 - self._share * G * np.exp(-self._later_s * s))

        return [Response(at, once.delay_s + self._later_s, once.unstable)]


class DriftingGain(Part):
    """From the beginning of the test on the gain moves evenly to `end` times its size, for so many Pu, and stays."""

    def __init__(self, setting: Setting, end: float, over: float) -> None:
        self._end, self._left = end, setting.steps(over)
        self._each = (end - 1.0) / self._left
        self._gain, self._moves = 1.0, False

    def begin(self) -> None:
        self._moves = True

    def step(self, value: float) -> float:
        if self._moves and self._left:
            self._left -= 1
            self._gain += self._each
        return self._gain * value

    def linearisations(self) -> list[Response]:
        return [gain(self._end)]
