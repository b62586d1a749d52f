"""A plant as the I/O device sees it: one MV in, one PV out, one sampling period at a time.

What a plant can have besides: a valve that is no straight line (`loopwright.plantsim.valves`), a sine on PV, a gain
that is changed while it runs.
"""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from loopwright.plantsim.models import sampled

LONGEST_DELAY = 10_000_000
"""Largest dead time, samples: each of them takes 8 bytes."""


class SimulatedProcess(Protocol):
    """A process that is simulated sample by sample."""

    @property
    def pv(self) -> float:
        """Returns the present measured value, PV units, noise included."""
        ...

    def step(self, mv: float) -> float:
        """Holds `mv` for one sampling period; returns the PV at its end."""
        ...


class Plant(SimulatedProcess, Protocol):
    """A simulated process with a load disturbance and measurement noise."""

    disturbance: float
    """Load disturbance at the plant's input, added after the actuator's limits, MV units."""
    noise_std: float
    """Standard deviation of the white measurement noise, PV units."""
    gain: float
    """What its gain is multiplied by, for MV and for a load: 1 unless the plant changes."""


class LinearPlant:
    """A linear plant that starts at rest: pv = pv_nominal + G(s) exp(-L s) * (mv - mv_nominal) / mv_per_unit.

    num, den: coefficients of G from the highest power down, time in s.
    mv_low, mv_high: limits of the actuator, MV units. A MV that is not a number leaves the actuator where it is.
    Raises ValueError.
    """

    def __init__(
        self,
        num: Sequence[float],
        den: Sequence[float],
        dead_time_s: float,
        sample_time_s: float,
        mv_nominal: float = 0.0,
        pv_nominal: float = 0.0,
        mv_per_unit: float = 1.0,
        noise_std: float = 0.0,
        seed: int = 1,
        mv_low: float = -math.inf,
        mv_high: float = math.inf,
    ) -> None:
        if mv_low > mv_high:
            raise ValueError("mv_low must not exceed mv_high")
        if mv_per_unit == 0:
            raise ValueError("mv_per_unit must not be zero")
        model = sampled(num, den, dead_time_s, sample_time_s)
        if model.delay > LONGEST_DELAY:
            text = f"a dead time of {dead_time_s:g} s is more than {LONGEST_DELAY} samples of {sample_time_s:g} s"
            raise ValueError(text)
        order = len(model.C)
        # The vector is [x, y, u_old, u_new]; one product advances it by one sample.
        matrix = np.zeros((order + 3, order + 3))
        into_x = matrix[:order]
        into_x[:, :order] = model.A
        into_x[:, order + 1] = model.B1
        into_x[:, order + 2] = model.B0
        matrix[order] = model.C @ into_x
        matrix[order, order + 2] += model.D
        matrix[order + 1, order + 2] = 1.0
        self._matrix = matrix
        self._state = np.zeros(order + 3)
        self._next = np.zeros(order + 3)
        self._at_output = order
        self._at_u = order + 2
        self._line = deque([0.0] * model.delay)
        self._low = mv_low
        self._high = mv_high
        self._mv = mv_nominal
        self._mv_nominal = mv_nominal
        self._pv_nominal = pv_nominal
        self._scale = 1.0 / mv_per_unit
        self._random = random.Random(seed)
        self.noise_std = noise_std
        self.disturbance = 0.0
        self.gain = 1.0
        self._pv = pv_nominal + (self._random.gauss(0.0, noise_std) if noise_std else 0.0)

    @property
    def pv(self) -> float:
        return self._pv

    def step(self, mv: float) -> float:
        if mv == mv:
            self._mv = mv = self._low if mv < self._low else self._high if mv > self._high else mv
        else:
            mv = self._mv
        line = self._line
        line.append((mv + self.disturbance - self._mv_nominal) * self._scale * self.gain)
        state = self._state
        state[self._at_u] = line.popleft()
        following = self._matrix.dot(state, self._next)
        self._state = following
        self._next = state
        pv: float = self._pv_nominal + following.item(self._at_output)
        if self.noise_std:
            pv += self._random.gauss(0.0, self.noise_std)
        self._pv = pv
        return pv


class TwoPaths:
    """A linear plant on which MV acts twice: what it does by a first path comes again later, by a second one.

    first: the plant of the first path, with the measurement noise.
    second: that of the second path, without noise, around a PV of 0.
    """

    def __init__(self, first: LinearPlant, second: LinearPlant) -> None:
        self._first, self._second = first, second

    @property
    def pv(self) -> float:
        return self._first.pv + self._second.pv

    @property
    def disturbance(self) -> float:
        return self._first.disturbance

    @disturbance.setter
    def disturbance(self, value: float) -> None:
        self._first.disturbance = self._second.disturbance = value

    @property
    def noise_std(self) -> float:
        return self._first.noise_std

    @noise_std.setter
    def noise_std(self, value: float) -> None:
        self._first.noise_std = value

    @property
    def gain(self) -> float:
        return self._first.gain

    @gain.setter
    def gain(self, value: float) -> None:
        self._first.gain = self._second.gain = value

    def step(self, mv: float) -> float:
        return self._first.step(mv) + self._second.step(mv)
