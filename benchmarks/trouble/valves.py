"""What a valve or another actuator makes of MV: its speed, its slack, its characteristic, its cycle. All in percent."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

from benchmarks.trouble.chain import Part, Setting
from benchmarks.trouble.response import Response, delayed, gain
from loopwright.plantsim.valves import Backlash, EqualPercentage, Stiction, TwoGains, Valve

STROKE = 15.0
"""The move that a speed is given by, percent."""
HALF = 50.0
"""Where a time-proportioned output is at rest, percent: on for half of its cycle."""


class RateLimit(Part):
    """Goes no faster than STROKE in so many Pu, and within `dead_zone` of MV not at all.

    For small moves it is a straight line (but for the dead zone).
    """

    def __init__(self, setting: Setting, stroke: float, dead_zone: float = 0.0) -> None:
        self._most, self._dead_zone = STROKE / setting.steps(1.0) / stroke, dead_zone
        self._position = 0.0

    def step(self, value: float) -> float:
        away = value - self._position
        if abs(away) > self._dead_zone:
            self._position += math.copysign(min(abs(away), self._most), away)
        return self._position


class Actuator(Part):
    """A valve of the simulator's that is a straight line for moves large beside its slack or its friction."""

    def __init__(self, valve: Valve) -> None:
        self._valve = valve

    def step(self, value: float) -> float:
        return self._valve.step(value)


def backlash(setting: Setting, slack: float) -> Actuator:
    """It starts anywhere in its slack."""
    return Actuator(Backlash(slack, float(setting.random(2).uniform(-1.0, 1.0))))


def stiction(setting: Setting, band: float) -> Actuator:
    return Actuator(Stiction(band))


class Characteristic(Part):
    """A static curve through rest.

    curve: what it makes of a deviation of its entry.  slopes: of the curve at the least and the largest deviation seen
    and at what lies between, at the gain of the test.
    """

    def __init__(self, curve: Callable[[float], float], slopes: Callable[[float, float], list[float]]) -> None:
        self._curve, self._slopes = curve, slopes
        self._low = self._high = 0.0

    def step(self, value: float) -> float:
        self._low, self._high = min(self._low, value), max(self._high, value)
        return self._curve(value)

    def linearisations(self) -> list[Response]:
        return [gain(each) for each in self._slopes(self._low, self._high)]


def broken(at: float, below: float, above: float) -> Characteristic:
    """Straight on both sides of a deviation, where its slope changes; `at` may be on either side of rest."""
    rest = above if at < 0.0 else below
    there = at * rest

    def curve(value: float) -> float:
        return there + (value - at) * (above if value > at else below)

    def slopes(low: float, high: float) -> list[float]:
        return [*([below] if low < at else []), *([above] if high > at else [])] or [rest]

    return Characteristic(curve, slopes)


def two_gains(below: float) -> Characteristic:
    """The gain below rest is so many times that above."""
    return Characteristic(
        TwoGains(below).step,
        lambda low, high: [*([below] if low < 0.0 else []), *([1.0] if high > 0.0 else [])] or [below],
    )


def ends(low: float, high: float) -> Characteristic:
    """Goes no further than these deviations. Beyond them it answers nothing, which no loop is judged by."""
    return Characteristic(lambda value: min(max(value, low), high), lambda *seen: [1.0])


def equal_percentage(R: float) -> Characteristic:
    """Of this rangeability; its gain at rest is 1."""
    valve = EqualPercentage(R)
    return Characteristic(valve.step, lambda low, high: [valve.slope(low), valve.slope(high)])


def root(opening: float) -> Characteristic:
    """The flow goes with the root of the opening, which is so many percent at rest; its gain there is 1."""

    def curve(value: float) -> float:
        return 2.0 * opening * (math.sqrt(max(1.0 + value / opening, 0.0)) - 1.0)

    def slope(value: float) -> float:
        return 1.0 / math.sqrt(max(1.0 + value / opening, 1e-3))

    return Characteristic(curve, lambda low, high: [slope(low), slope(high)])


def steeper_both_ways(at_10: float) -> Characteristic:
    """Gain 1 at rest, and so many times that 10 % from rest, on either side."""

    def slope(value: float) -> float:
        return 1.0 + (at_10 - 1.0) * (value / 10.0) ** 2

    return Characteristic(
        lambda value: value * (2.0 + slope(value)) / 3.0, lambda low, high: [1.0, slope(low), slope(high)]
    )


def steep_middle(slope: float, width: float, off: float) -> Characteristic:
    """Of a titration: so steep within `width` of its middle, 1 outside; rest is `off` from the middle."""

    def whole(value: float) -> float:
        inside = min(max(value, -width), width)
        return value + (slope - 1.0) * inside

    def slopes(low: float, high: float) -> list[float]:
        seen = []
        if low + off <= width and high + off >= -width:
            seen.append(slope)
        if low + off <= -width or high + off >= width:
            seen.append(1.0)
        return seen

    return Characteristic(lambda value: whole(value + off) - whole(off), slopes)


class TimeProportioned(Part):
    """On or off: on for the first part of each cycle, as large as MV at its beginning.

    Its mean is MV; on average it comes half a cycle late, which replaces the half sample of the held MV.
    """

    def __init__(self, setting: Setting, cycle: float) -> None:
        self._cycle, self._n, self._on = setting.steps(cycle), 0, 0.0
        self._late_s = 0.5 * (cycle * setting.plant.Pu - setting.plant.Ts)

    def step(self, value: float) -> float:
        if self._n % self._cycle == 0:
            self._on = (HALF + value) / 100.0 * self._cycle
        into = self._n % self._cycle
        self._n += 1
        return 100.0 * min(max(self._on - into, 0.0), 1.0) - HALF

    def linearisations(self) -> list[Response]:
        return [delayed(self._late_s)]


class Switched(Part):
    """On or off, on for the first part of each window of so many Pu, as large as MV at its beginning.

    rest: MV at rest, percent. For small moves it comes as late as it is switched off at rest.
    """

    def __init__(self, setting: Setting, length: float, rest: float) -> None:
        self._window, self._rest, self._n, self._on = setting.steps(length), rest, 0, 0.0
        self._late_s = rest / 100.0 * length * setting.plant.Pu

    def step(self, value: float) -> float:
        into = self._n % self._window
        if into == 0:
            self._on = (self._rest + value) / 100.0 * self._window
        self._n += 1
        return 100.0 * min(max(self._on - into, 0.0), 1.0) - self._rest

    def linearisations(self) -> list[Response]:
        return [delayed(self._late_s)]


class Stepped(Part):
    """In steps of this size. rest: MV at rest, percent."""

    def __init__(self, setting: Setting, step: float, rest: float) -> None:
        self._step, self._rest = step, rest

    def step(self, value: float) -> float:
        return self._step * round((value + self._rest) / self._step) - self._rest


class Transport(Part):
    """What enters leaves when as much has followed; MV moves the flow, so the dead time falls by `fall` for 10 %."""

    def __init__(self, setting: Setting, fall: float) -> None:
        self._L, self._fall, self._h = setting.plant.L, fall, setting.h
        # size and value of what is on its way, oldest first
        self._way = deque([(self._L, 0.0)])
        self._low = self._high = 0.0

    def step(self, value: float) -> float:
        self._low, self._high = min(self._low, value), max(self._high, value)
        entered = self._h * self._L / self._dead_time(value)
        self._way.append((entered, value))
        left, out = entered, 0.0
        while left > 0.0:
            size, held = self._way.popleft()
            taken = min(size, left)
            out += taken / entered * held
            left -= taken
            if size > taken:
                self._way.appendleft((size - taken, held))
            if left < 1e-12 * entered:
                break
        return out

    def linearisations(self) -> list[Response]:
        return [delayed(self._dead_time(each)) for each in (self._low, 0.0, self._high)]

    def _dead_time(self, mv: float) -> float:
        return self._L * min(max(1.0 - self._fall * mv / 10.0, 0.2), 5.0)
