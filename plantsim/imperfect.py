"""A linear plant with what a real one has besides: a valve that is no straight line, a sine on PV."""

from __future__ import annotations

import math
from dataclasses import dataclass

from loopwright.plantsim.plant import Plant
from loopwright.plantsim.valves import Valve


@dataclass(frozen=True, slots=True)
class Sine:
    """What another process, or the mains, adds to PV. amplitude: PV units.  period_s: plant time, s."""

    amplitude: float
    period_s: float


class ImperfectPlant:
    """A plant behind a valve, with a sine on its PV.

    plant: starts at rest at `mv_nominal`, percent, and has no limits of MV; these are the valve's, 0 to 100 %.
    valve: between MV and the plant; None for a valve that is a straight line.  sine: None for none.
    A load disturbance acts behind the valve.
    """

    def __init__(
        self, plant: Plant, mv_nominal: float, sample_time_s: float, valve: Valve | None, sine: Sine | None
    ) -> None:
        self._plant, self._mv_nominal, self._valve = plant, mv_nominal, valve
        self._amplitude = 0.0 if sine is None else sine.amplitude
        self._turn = 0.0 if sine is None else 2.0 * math.pi * sample_time_s / sine.period_s
        self._samples = 0
        self._mv = mv_nominal

    @property
    def pv(self) -> float:
        return self._plant.pv + self._amplitude * math.sin(self._turn * self._samples)

    @property
    def disturbance(self) -> float:
        return self._plant.disturbance

    @disturbance.setter
    def disturbance(self, value: float) -> None:
        self._plant.disturbance = value

    @property
    def noise_std(self) -> float:
        return self._plant.noise_std

    @noise_std.setter
    def noise_std(self, value: float) -> None:
        self._plant.noise_std = value

    @property
    def gain(self) -> float:
        return self._plant.gain

    @gain.setter
    def gain(self, value: float) -> None:
        self._plant.gain = value

    def step(self, mv: float) -> float:
        if mv == mv:  # a MV that is not a number leaves the valve where it is
            self._mv = min(max(mv, 0.0), 100.0)
        away = self._mv - self._mv_nominal
        if self._valve is not None:
            away = self._valve.step(away)
        self._samples += 1
        self._plant.step(self._mv_nominal + away)
        return self.pv
