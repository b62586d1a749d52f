"""The record of a fast experiment, with the figures that scale its fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from loopwright.tuning.experiments.control_record import ControlRecord
from loopwright.tuning.identification.output_error import averaged
from loopwright.tuning.models import Reals
from loopwright.tuning.reasons import Reason, Refused


class Excitation(StrEnum):
    """What moves the loop so that its plant shows: a test, or (observe) operators before it."""

    RELAY = "relay"
    SETPOINT = "setpoint"
    OBSERVE = "observe"
    MANUAL = "manual"

    @property
    def in_words(self) -> str:
        """The excitation in the words of a sentence."""
        return {
            "relay": "relay",
            "setpoint": "pulses",
            "observe": "step under the new gains",
            "manual": "pulses of the manual output",
        }[self]

    @property
    def record(self) -> str:
        """The record of this excitation, before any step under new gains, in the words of a sentence."""
        if self is Excitation.OBSERVE:
            return "the record of normal operation"
        return "the relay's record" if self is Excitation.RELAY else "the pulses' record"


MIN_LISTENED = 60
"""Smallest number of averages of the time at rest, from which noise and offset are estimated."""
AVERAGES_PER_PERIOD = 80
LONGEST_DEAD_TIME = 0.75  # periods
MIN_SWITCHES = 4


@dataclass(frozen=True, slots=True, eq=False)
class ExperimentRecord:
    """The record of a fast experiment so far: time at rest, then the excitation (the relay, or pulses of the
    set-point or of the manual output), then possibly set-point steps under new gains.

    Ts: the sample time, s.
    u: MV as a deviation from rest, held from each sample to the next, MV units, shape (N,).
    y: PV as a deviation from rest at each sample, PV units, shape (N,).
    direction: +1 if PV finally rises with MV, else -1; the action of the controller tells which.
    listened: the number of samples at rest.
    excited: the number of samples up to the end of the excitation.
    turns: the number of switches of the relay, or of turns of the set-point or the manual output.
    period: the time scale, in samples: the period of the relay oscillation, or the ultimate period of a first model.
    steps: the samples at which the set-point stepped under the new gains.
    excitation: what moved the loop.
    lengths: the number of samples of each piece of the record, where there are several: the time at rest, then each
    set-point change of normal operation. MV and PV are deviations from the rest before each change.
    one_sided: whether the set-point went to one side of its rest only.
    control: what the record shows of the controller; None where it is not known.
    held_s: the time for which the controller holds MV, s; None where it is the sample time.
    u_earlier: MV before each piece of several, as long as the longest dead time, as a deviation from the same rest as
    its u; empty where MV was at rest.
    Raises Refused: BAD_INPUT, NO_RESPONSE.
    """

    Ts: float
    u: Reals
    y: Reals
    direction: float
    listened: int
    excited: int
    turns: int
    period: float
    steps: tuple[int, ...] = ()
    excitation: Excitation = Excitation.RELAY
    lengths: tuple[int, ...] = ()
    held_s: float | None = None
    one_sided: bool = False
    control: ControlRecord | None = None
    u_earlier: tuple[Reals, ...] = ()

    @property
    def sampling_delay_s(self) -> float:
        """The delay that the sampling of the controller adds to the loop, s."""
        return 0.5 * (self.Ts if self.held_s is None else self.held_s)

    @property
    def begun(self) -> int:
        """The sample from which times in the record count: the start of the excitation, or (observe) of the step."""
        return self.steps[0] if self.excitation is Excitation.OBSERVE and self.steps else self.listened

    @property
    def pieces(self) -> tuple[int, ...]:
        """The number of samples of each piece."""
        return self.lengths or (len(self.y),)

    def __post_init__(self) -> None:
        if self.listened < MIN_LISTENED:
            raise Refused(Reason.BAD_INPUT, f"{self.listened} samples at rest; at least {MIN_LISTENED} are needed")
        if not self.output_range > 0.0:
            raise Refused(Reason.NO_RESPONSE, "PV did not move at all under the test")

    @property
    def output_range(self) -> float:
        """The range of PV (maximum less minimum) under the excitation, PV units."""
        return float(np.ptp(self.y[self.listened : self.excited]))

    @property
    def input_range(self) -> float:
        """The largest deviation of MV from rest, MV units."""
        return float(np.max(np.abs(self.u)))

    @property
    def max_dead_time(self) -> float:
        """The longest dead time that is searched, in samples."""
        return LONGEST_DEAD_TIME * self.period

    @property
    def block(self) -> int:
        """The number of samples averaged into one for the fit: faster sampling adds no information."""
        return max(1, min(int(self.period / AVERAGES_PER_PERIOD), self.listened // MIN_LISTENED))

    @property
    def noise(self) -> float:
        """The standard deviation of what no model can explain, PV units: noise at rest and rounding errors together."""
        rest = averaged(self.y[: self.listened], self.block)
        return math.hypot(noise_of(rest), self.rounding)

    @property
    def rounding(self) -> float:
        """The standard deviation of the rounding error of a coarse sensor, PV units. At rest this error may not
        show."""
        steps = np.diff(np.unique(np.round(self.y / self.output_range, 9)))
        return float(steps.min()) * self.output_range / math.sqrt(12.0)

    @property
    def durbin_watson_ratio_at_rest(self) -> float:
        """2/d of PV at rest, with the Durbin-Watson statistic d: about 1 for white noise, larger for slow noise.

        The ratio is the variance of PV at rest divided by half the mean square of the differences of neighbours.
        """
        rest = averaged(self.y[: self.listened], self.block)
        fast = 0.5 * float(np.mean(np.diff(rest) ** 2))
        return float(np.var(rest)) / fast if fast > 0.0 else 1.0


def oscillation_period(switches: Sequence[int]) -> float:
    """The period of the relay oscillation of a record, in samples, see `period`. Raises Refused, CANNOT_OSCILLATE: the
    relay switched too rarely."""
    if len(switches) < MIN_SWITCHES:
        raise Refused(Reason.CANNOT_OSCILLATE, f"the relay switched {len(switches)} times; {MIN_SWITCHES} are needed")
    return period(tuple(switches))


def period(switches: tuple[int, ...]) -> float:
    """The period of a relay oscillation, in samples: half the sum of its last four half periods, or the sum of the last
    two if there are fewer than four. switches: the samples at which the relay switched."""
    halves = np.diff(switches)[-4:]
    return float(np.sum(halves)) / 2.0 if len(halves) == 4 else float(np.sum(halves[-2:]))


def noise_of(rest: Reals) -> float:
    """The standard deviation of the noise of PV at rest, PV units.

    The result is the larger of two estimates: one from the differences of neighbouring samples, one from the residual
    of a fitted parabola.
    """
    fast = float(np.sqrt(0.5 * np.mean(np.diff(rest) ** 2)))
    t = np.linspace(-1.0, 1.0, len(rest))
    slow = rest - np.polyval(np.polyfit(t, rest, 2), t)
    return max(fast, float(np.std(slow, ddof=3)))
