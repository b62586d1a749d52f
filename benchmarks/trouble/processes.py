"""What lies between the valve and the sensor: the linear plant, a second path, what comes back to the inlet."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import numpy as np

from benchmarks.trouble.chain import Part, Setting
from benchmarks.trouble.response import Response, controller, gain, rational
from loopwright.plantsim.plant import LinearPlant
from loopwright.tuning.gains import Gains
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


class Lag(Part):
    """A first-order lag, by the fine step.

    T_s: its time constant while PV rises.  falls: so many times that while it falls.  changed: so many times that since
    the new gains took over.
    """

    def __init__(self, h: float, T_s: float, falls: float = 1.0, changed: float = 1.0) -> None:
        self._h, self._T, self._falls, self._changed = h, T_s, falls, changed
        self._set_shares()
        self._value = 0.0

    def change(self) -> None:
        self._T *= self._changed
        self._set_shares()

    def step(self, value: float) -> float:
        away = value - self._value
        self._value += away * (self._up if away > 0.0 else self._down)
        return self._value

    def linearisations(self) -> list[Response]:
        times = sorted({self._T, self._T * self._falls})
        return [rational((1.0,), (each, 1.0)) for each in times]

    def _set_shares(self) -> None:
        self._up, self._down = (-math.expm1(-self._h / each) for each in (self._T, self._T * self._falls))


class SensorLag(Part):
    """A lag at the sensor, of a time constant before the new gains take over and another afterwards; 0 is none."""

    def __init__(self, setting: Setting, before: float, after: float) -> None:
        Pu = setting.plant.Pu
        self._share, self._share_after = (-math.expm1(-setting.h / (T * Pu)) if T else 1.0 for T in (before, after))
        self._after_s, self._value = after * Pu, 0.0

    def change(self) -> None:
        self._share = self._share_after

    def step(self, value: float) -> float:
        self._value += self._share * (value - self._value)
        return self._value

    def linearisations(self) -> list[Response]:
        return [rational((1.0,), (self._after_s, 1.0)) if self._after_s else gain(1.0)]


class ChangedGain(Part):
    """So many times as large since the new gains took over."""

    def __init__(self, size: float) -> None:
        self._size, self._now = size, 1.0

    def change(self) -> None:
        self._now = self._size

    def step(self, value: float) -> float:
        return self._now * value

    def linearisations(self) -> list[Response]:
        return [gain(self._size)]


class Neighbour(Part):
    """Two inlets and two outlets: y1 = G (u1 + u2), y2 = G (u2 + coupling u1), and a tight PI from y2 to u2.

    What the loop sees is G - coupling G^2 C2/(1 + G C2), as long as the neighbour is in automatic.
    steps: of the neighbour's set-point, 1 Pu after the beginning of the test.  to_manual: it goes there as the new
    gains take over.
    """

    GAIN, INTEGRAL = 0.4, 1.0
    """Kp in Ku, Ti in Pu."""

    def __init__(self, setting: Setting, coupling: float, steps: float = 0.0, to_manual: bool = False) -> None:
        plant = setting.plant
        self._coupling, self._steps, self._to_manual, self._Ts = coupling, steps, to_manual, plant.Ts
        self._mine, self._other = linear(setting), linear(setting)
        self._gains = Gains(self.GAIN * plant.Ku, self.INTEGRAL * plant.Pu)
        self._sum = self._u2 = self._sp = 0.0
        self._until, self._automatic = -1, True
        self._period = plant.samples

    def begin(self) -> None:
        self._until = self._period

    def change(self) -> None:
        self._automatic = not self._to_manual

    def step(self, value: float) -> float:
        mine = self._mine.step(value + self._u2)
        other = self._other.step(self._u2 + self._coupling * value)
        if self._until >= 0:
            self._until -= 1
            self._sp = self._steps if self._until < 0 else 0.0
        if self._automatic:
            error = self._sp - other
            self._sum += error * self._Ts / self._gains.Ti
            self._u2 = self._gains.Kp * (error + self._sum)
        return mine

    def linearisations(self) -> list[Response]:
        [G] = self._mine.linearisations()
        if self._to_manual:
            return [G]
        control = controller(self._gains)

        def at(s: Complexes) -> Complexes:
            alone = G.at(s)
            loop = alone * control.at(s) * np.exp(-0.5 * self._Ts * s)
            return alone * (1.0 - self._coupling * loop / (1.0 + loop))

        return [Response(at, 2.0 * G.delay_s)]
