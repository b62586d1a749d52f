"""A plant as a chain of parts from MV to PV, each with its equations and its linearisations, in deviations from rest.

Parts before the sensor run in fine steps, so many in a sample, with exact dead time (`loopwright.plantsim.plant`);
those of the sensor run once in a sample. What each part saw is where it is linearised: the loop that is judged is the
worst of all.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from benchmarks.plants import Plant
from benchmarks.trouble.response import Judged, Response, gain, judged, series
from loopwright.tuning.gains import Gains


class Part:
    """Passes on what it gets; a kind of trouble overrides what it changes."""

    def step(self, value: float) -> float:
        """What leaves the part after its step, of what was held at its entry since the step before."""
        return value

    def begin(self) -> None:
        """The test begins."""

    def change(self) -> None:
        """The new gains take over."""

    def linearisations(self) -> list[Response]:
        """For small moves, at the operating points that were visited; of a part that changes, as it is afterwards."""
        return [gain(1.0)]


@dataclass(frozen=True, slots=True)
class Setting:
    """What a part is made for.

    plant: the one that is tuned, without trouble; its gain is 1, and MV and PV are in percent.
    substeps: of the parts before the sensor, in a sample.  noise: its standard deviation, PV.  seed: of all chance.
    """

    plant: Plant
    substeps: int
    noise: float
    seed: int

    @property
    def h(self) -> float:
        """A fine step, s."""
        return self.plant.Ts / self.substeps

    def random(self, number: int) -> np.random.Generator:
        """Chance, of each number another."""
        return np.random.default_rng([self.seed, number])

    def steps(self, periods: float) -> int:
        """Fine steps in so many Pu."""
        return round(periods * self.plant.samples * self.substeps)


@dataclass(frozen=True, slots=True)
class Parts:
    """fine: in their order from MV on, the process among them.  sensor: in their order up to PV, the noise among them;
    once a sample."""

    fine: Sequence[Part]
    sensor: Sequence[Part]


Build = Callable[[Setting], Parts]


class Chain:
    """The simulated process (`loopwright.plantsim.plant.SimulatedProcess`)."""

    def __init__(self, setting: Setting, build: Build) -> None:
        self._setting = setting
        parts = build(setting)
        self._fine, self._sensor = parts.fine, parts.sensor
        self._pv = self._measured(0.0)

    @property
    def pv(self) -> float:
        return self._pv

    @property
    def noise(self) -> float:
        """The standard deviation of the noise of PV."""
        return self._setting.noise

    def step(self, mv: float) -> float:
        value = mv
        for _ in range(self._setting.substeps):
            value = mv
            for part in self._fine:
                value = part.step(value)
        self._pv = self._measured(value)
        return self._pv

    def begin(self) -> None:
        """The test begins."""
        for part in (*self._fine, *self._sensor):
            part.begin()

    def change(self) -> None:
        """The new gains take over."""
        for part in (*self._fine, *self._sensor):
            part.change()

    def linearisations(self) -> list[Response]:
        """Of the whole plant, the sampled controller's half sample with it."""
        plant = self._setting.plant
        half = Response(lambda s: np.exp(-0.5 * plant.Ts * s), 0.5 * plant.Ts)
        each = (part.linearisations() for part in (*self._fine, *self._sensor))
        return [series(*parts, half) for parts in product(*each)]

    def worst(self, gains: Gains) -> Judged:
        """Of all the linearisations: an unstable one, else that of the largest Ms."""
        found = [judged(each, gains, self._setting.plant.Pu) for each in self.linearisations()]
        return max(found, key=lambda each: (each.unstable, each.Ms))

    def _measured(self, value: float) -> float:
        for part in self._sensor:
            value = part.step(value)
        return value
