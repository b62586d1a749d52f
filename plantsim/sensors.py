"""What lies between a plant and the PV that is sent: noise, rounding, a value that is renewed seldom, and a sensor that
lies within its limits from some time on."""

from __future__ import annotations

import random
from enum import StrEnum

from loopwright.plantsim.plant import SimulatedProcess


class SensorFault(StrEnum):
    """What a false sensor sends."""

    FROZEN = "frozen"
    """Its last value, exactly."""
    ZERO = "zero"
    HALF = "half"
    """Half of its last value, exactly."""
    HALVED = "halved"
    """Half of what it should send, noise and all."""
    RAISED = "raised"
    """A fifth more than it should send, noise and all."""
    QUIET = "quiet"
    """Its last value, with a quarter of its noise."""
    LOUD = "loud"
    """Its last value, with four times its noise."""


PART = {SensorFault.HALVED: 0.5, SensorFault.RAISED: 1.2}
NOISE = {SensorFault.QUIET: 0.25, SensorFault.LOUD: 4.0}


class SensedPlant:
    """A plant seen through a sensor.

    plant: without noise of its own.  noise_std: of the white noise, PV units.  quantum: what PV is rounded to, PV
    units; 0 for not at all.  renewal: the number of samples from one new value to the next.
    """

    def __init__(
        self, plant: SimulatedProcess, noise_std: float, quantum: float = 0.0, renewal: int = 1, seed: int = 1
    ) -> None:
        self.plant = plant
        self._noise, self._quantum, self._renewal = noise_std, quantum, renewal
        self._random = random.Random(seed)
        self._samples = 0
        self._fault: SensorFault | None = None
        self._at_fault = 0.0
        self._pv = self._read()

    @property
    def pv(self) -> float:
        return self._pv

    @property
    def true_pv(self) -> float:
        """PV units, without noise."""
        return self.plant.pv

    def fail(self, fault: SensorFault | None) -> None:
        """Begins to send what is false; None: what is true again."""
        self._fault, self._at_fault = fault, self._pv

    def step(self, mv: float) -> float:
        self.plant.step(mv)
        self._samples += 1
        if self._samples % self._renewal == 0:
            self._pv = self._read()
        return self._pv

    def _read(self) -> float:
        match self._fault:
            case None:
                value = self.plant.pv + self._drawn()
            case SensorFault.FROZEN:
                return self._at_fault
            case SensorFault.ZERO:
                return 0.0
            case SensorFault.HALF:
                return 0.5 * self._at_fault
            case SensorFault.HALVED | SensorFault.RAISED:
                value = PART[self._fault] * (self.plant.pv + self._drawn())
            case SensorFault.QUIET | SensorFault.LOUD:
                value = self._at_fault + NOISE[self._fault] * self._drawn()
        return round(value / self._quantum) * self._quantum if self._quantum else value

    def _drawn(self) -> float:
        return self._random.gauss(0.0, self._noise) if self._noise else 0.0
