"""What an ideal plant leaves out: loads, drift, noise with a colour, spikes, a coarse sensor, a valve that sticks or is
curved."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loopwright.plantsim.plant import Plant

SPIKE = 10.0
"""Standard deviations of the noise."""


@dataclass(frozen=True, slots=True)
class Disturbance:
    """loads: steps of 10 to 50 % of the relay (the second and further ones of 10 to 30 %).  unrest: the first load
    steps while the loop is listened to.

    drift: PV spans in Pu.  pole: of the noise's colour, per sample.  quantum: of PV, spans.  spikes: share of
    samples.  stiction: the valve stays where it is until MV is off by so much, then jumps there; dead_band: it follows
    so far behind; both in amplitudes of the relay.  ends: how far the actuator goes, amplitudes.

    below: the plant's gain below rest over that above.  rangeability: of a valve with an equal-percentage
    characteristic.  opening: of a valve at rest, percent, whose flow goes with the root of its opening.  Of these two,
    MV is in percent, and the gain at rest stays that of the plant.

    gain, later: as the new gains take over, the plant's gain becomes so many times what it was, its dead time longer
    by so many Pu.
    """

    loads: int = 0
    unrest: bool = False
    drift: float = 0.0
    pole: float = 0.0
    quantum: float = 0.0
    spikes: float = 0.0
    stiction: float = 0.0
    dead_band: float = 0.0
    ends: float = math.inf
    below: float = 1.0
    rangeability: float = 1.0
    opening: float = math.inf
    gain: float = 1.0
    later: float = 0.0

    def flow(self, mv: float) -> float:
        """What the characteristic makes of MV, both as deviations from rest, MV units."""
        if self.below != 1.0:
            return mv if mv > 0.0 else self.below * mv
        if self.rangeability != 1.0:
            rate = math.log(self.rangeability) / 100.0
            return math.expm1(rate * mv) / rate
        if self.opening < math.inf:
            return 2.0 * self.opening * (math.sqrt(max(1.0 + mv / self.opening, 0.0)) - 1.0)
        return mv

    def steepest(self, low: float, high: float) -> float:
        """The largest slope of the characteristic between two values of MV, over that at rest; above rest it is 1 for
        a gain that differs below."""
        if self.opening < math.inf:
            return 1.0 / math.sqrt(max(1.0 + low / self.opening, 1e-3))
        return max(1.0, self.below, math.exp(math.log(self.rangeability) / 100.0 * high))


class Disturbed:
    """A plant with a disturbance, in deviations from `nominal` (MV, PV).

    noise: its standard deviation; a white one is the plant's own.  loads: (sample, size) of each, MV units, from the
    relay's start (from the very beginning where the loop is not at rest).
    span: of PV.  period: samples.  amplitude: MV units.
    """

    def __init__(
        self,
        plant: Plant,
        how: Disturbance,
        noise: float,
        loads: Sequence[tuple[int, float]],
        span: float,
        period: float,
        amplitude: float,
        seed: int,
        nominal: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self._plant, self._how, self._loads = plant, how, tuple(loads)
        self._mv_nominal, self._pv_nominal = nominal
        self._drift, self._quantum = how.drift * span / period, how.quantum * span
        self._stiction, self._dead_band, self._ends = (
            amplitude * each for each in (how.stiction, how.dead_band, how.ends)
        )
        self._random = np.random.default_rng([seed, 1])
        self._spike = SPIKE * noise
        self._coloured = noise if how.pole else 0.0
        self._colour = self._coloured * self._random.standard_normal()
        plant.noise_std = self.noise_std = 0.0 if how.pole else noise
        # where in its slack the valve stands
        self._slack = self._dead_band * self._random.uniform(-1.0, 1.0)
        self._n, self._position = 0, 0.0
        self._relay_at = 0 if how.unrest else -1
        self._gain, self._line = 1.0, deque([0.0])
        self._later = round(how.later * period)
        self._pv = self._measured(plant.pv)

    @property
    def disturbance(self) -> float:
        return self._plant.disturbance

    @disturbance.setter
    def disturbance(self, value: float) -> None:
        self._plant.disturbance = value

    @property
    def pv(self) -> float:
        return self._pv

    def step(self, mv: float) -> float:
        for at, size in self._loads:
            if self._relay_at >= 0 and at == self._n - self._relay_at:
                self._plant.disturbance += size
        self._n += 1
        self._pv = self._measured(self._plant.step(self._mv_nominal + self._moved(mv)))
        return self._pv

    def relay(self) -> None:
        """The relay starts."""
        if self._relay_at < 0:
            self._relay_at = self._n

    def change(self) -> None:
        """The new gains take over."""
        self._gain = self._how.gain
        self._line.extendleft([self._line[0]] * self._later)

    def _moved(self, mv: float) -> float:
        """Where the valve is, as the plant feels it."""
        away = mv + self._slack - self._position
        if abs(away) > self._stiction:
            self._position += away if self._stiction else math.copysign(max(abs(away) - self._dead_band, 0.0), away)
        self._line.append(self._gain * self._how.flow(min(max(self._position, -self._ends), self._ends)))
        self._line.popleft()
        return self._line[0]

    def _measured(self, pv: float) -> float:
        how, random = self._how, self._random
        if how.pole:
            fresh = math.sqrt(1.0 - how.pole**2) * self._coloured
            self._colour = how.pole * self._colour + fresh * random.standard_normal()
        pv += self._colour - self._pv_nominal + self._drift * self._n
        if how.spikes and random.random() < how.spikes:
            pv += self._spike * random.choice((-1.0, 1.0))
        return round(pv / self._quantum) * self._quantum if self._quantum else pv
