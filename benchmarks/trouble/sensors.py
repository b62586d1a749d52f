"""What lies between the plant and the PV that the controller gets: noise, and sensors that hold, send late or end."""

from __future__ import annotations

import math

import numpy as np

from benchmarks.trouble.chain import Part, Setting
from benchmarks.trouble.response import Response


class Noise(Part):
    """White, normally distributed."""

    def __init__(self, setting: Setting) -> None:
        self._random, self._size = setting.random(1), setting.noise

    def step(self, value: float) -> float:
        return value + self._size * float(self._random.standard_normal())


class Coloured(Part):
    """Noise of a first-order autoregression with this pole, per sample."""

    def __init__(self, setting: Setting, pole: float) -> None:
        self._random, self._pole = setting.random(1), pole
        self._fresh = math.sqrt(1.0 - pole**2) * setting.noise
        self._now = setting.noise * float(self._random.standard_normal())

    def step(self, value: float) -> float:
        self._now = self._pole * self._now + self._fresh * float(self._random.standard_normal())
        return value + self._now


class Held(Part):
    """An analyser: a new value in so many samples. What a controller takes is 0 to count - 1 samples old."""

    def __init__(self, setting: Setting, count: int) -> None:
        self._count, self._n, self._value, self._Ts = count, 0, 0.0, setting.plant.Ts

    def step(self, value: float) -> float:
        if self._n % self._count == 0:
            self._value = value
        self._n += 1
        return self._value

    def linearisations(self) -> list[Response]:
        ages = self._Ts * np.arange(self._count)
        # the sum of the delays, without what the sampling folds
        return [Response(lambda s: np.mean(np.exp(-np.multiply.outer(ages, s)), axis=0), float(ages[-1]))]


class OnChange(Part):
    """Sends a value that differs from the last by so much."""

    def __init__(self, band: float) -> None:
        self._band, self._value = band, 0.0

    def step(self, value: float) -> float:
        if abs(value - self._value) >= self._band:
            self._value = value
        return self._value


class Clipped(Part):
    """Goes no higher than this."""

    def __init__(self, top: float) -> None:
        self._top = top

    def step(self, value: float) -> float:
        return min(value, self._top)


class Quantised(Part):
    """In steps of this size."""

    def __init__(self, quantum: float) -> None:
        self._quantum = quantum

    def step(self, value: float) -> float:
        return round(value / self._quantum) * self._quantum


class Wrong(Part):
    """Single samples, one in so many, that are wrong by a third of `by` to all of it, to either side."""

    def __init__(self, setting: Setting, one_in: int, by: float) -> None:
        self._random, self._one_in, self._by = setting.random(4), one_in, by
        self._last = 0

    def step(self, value: float) -> float:
        self._last += 1
        if self._last < 3 or self._random.random() * self._one_in > 1.0:
            return value
        self._last = 0
        return value + self._by * float(self._random.uniform(0.33, 1.0)) * float(self._random.choice((-1.0, 1.0)))
