"""The record of a fast experiment, in the units of its fit."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from loopwright.tuning.identification.output_error import averaged
from loopwright.tuning.models import Reals
from loopwright.tuning.reasons import Reason, Refused

MIN_LISTENED = 60
"""Averages in which the time at rest must still be told, for noise and offset."""
AVERAGES_PER_PERIOD = 80
LONGEST_DEAD_TIME = 0.75  # periods
MIN_SWITCHES = 4


@dataclass(frozen=True, slots=True, eq=False)
class ExperimentRecord:
    """What a fast experiment has shown so far: time at rest first, then the relay, then perhaps a set-point step.

    Ts: s.  u: MV that held from each sample to the next, y: PV at it, both shape (N,) and as deviations from rest.
    direction: +1 where PV finally rises with MV, else -1: known from the controller's action.
    listened: samples at rest.  relayed: samples up to the end of the relay.  switches: samples at which it switched,
    its start not among them.  steps: samples at which the set-point stepped under the new gains.
    """

    Ts: float
    u: Reals
    y: Reals
    direction: float
    listened: int
    relayed: int
    switches: tuple[int, ...]
    steps: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if len(self.switches) < MIN_SWITCHES:
            raise Refused(
                Reason.CANNOT_OSCILLATE, f"the relay switched {len(self.switches)} times; {MIN_SWITCHES} are needed"
            )
        if self.listened < MIN_LISTENED:
            raise Refused(Reason.BAD_INPUT, f"{self.listened} samples at rest; at least {MIN_LISTENED} are needed")
        if not self.output_range > 0.0:
            raise Refused(Reason.NO_RESPONSE, "PV did not move at all under the relay")

    @property
    def period(self) -> float:
        """Samples: half the sum of the last four half periods of the relay (of the last two, if there are no more)."""
        return float(period(self.switches))

    @property
    def output_range(self) -> float:
        """Of PV under the relay, PV units."""
        return float(np.ptp(self.y[self.listened : self.relayed]))

    @property
    def input_range(self) -> float:
        """The largest move of MV, MV units."""
        return float(np.max(np.abs(self.u)))

    @property
    def max_dead_time(self) -> float:
        """Samples."""
        return LONGEST_DEAD_TIME * self.period

    @property
    def block(self) -> int:
        """Samples averaged into one for the fit: sampling faster than this tells nothing more."""
        return max(1, min(int(self.period / AVERAGES_PER_PERIOD), self.listened // MIN_LISTENED))

    @property
    def noise(self) -> float:
        """Standard deviation of what cannot be fitted, PV units: the noise at rest, and what rounding takes."""
        rest = averaged(self.y[: self.listened], self.block)
        return math.hypot(noise_of(rest), self.rounding)

    @property
    def rounding(self) -> float:
        """Standard deviation of what a coarse sensor rounds away, PV units: at rest it may not show at all."""
        steps = np.diff(np.unique(np.round(self.y / self.output_range, 9)))
        return float(steps.min()) * self.output_range / math.sqrt(12.0)

    @property
    def durbin_watson_ratio_at_rest(self) -> float:
        """Variance at rest over that of the fast part: about 1 for white noise."""
        rest = averaged(self.y[: self.listened], self.block)
        fast = 0.5 * float(np.mean(np.diff(rest) ** 2))
        return float(np.var(rest)) / fast if fast > 0.0 else 1.0


def period(switches: tuple[int, ...]) -> float:
    """Samples, see `Evidence.period`."""
    halves = np.diff(switches)[-4:]
    return float(np.sum(halves)) / 2.0 if len(halves) == 4 else float(np.sum(halves[-2:]))


def noise_of(rest: Reals) -> float:
    """Standard deviation: the larger of that of neighbours' differences and of what a parabola leaves."""
    fast = float(np.sqrt(0.5 * np.mean(np.diff(rest) ** 2)))
    t = np.linspace(-1.0, 1.0, len(rest))
    slow = rest - np.polyval(np.polyfit(t, rest, 2), t)
    return max(fast, float(np.std(slow, ddof=3)))
