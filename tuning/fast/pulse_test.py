"""Pulses of the set-point under the present gains, and the set-point step home under new ones, with their record.

The loop never leaves automatic. The set-point moves up, down and up again; each pulse turns while PV still moves, so
that the record shows the plant around its ultimate frequency and PV stays near the permitted set-point step. The fit
goes from MV to PV, so that the controller need not be known.
"""

from __future__ import annotations

import numpy as np

from loopwright.tuning.experiments.primitives import Facts, OperatingPoint, Trace
from loopwright.tuning.experiments.step_test import KICK_OF_ROOM
from loopwright.tuning.fast.experiment import STEP_BACK_FRACTION, VERIFICATION_PERIODS, Experiment
from loopwright.tuning.fast.proposal import PulseFigures
from loopwright.tuning.fast.record import Excitation, ExperimentRecord
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Reals
from loopwright.tuning.plan import Command, Plan, Sample, SetGains, SetSetpoint
from loopwright.tuning.reasons import Reason, Refused

PULSES = (1.0, -1.0, 1.0)
"""The levels of the set-point, in sizes of a pulse; the last level is held until the step home."""
MIN_FOLLOWED, MIN_FOLLOWED_NOISES = 0.2, 5.0
"""A pulse turns when PV has followed this fraction of the set-point's move, and this many standard deviations of the
noise."""
SAMPLES_AVERAGED = 3
LEVELS_APART = 2.0
"""The swing of the set-point from one level to the other, in sizes of a pulse."""
MAX_T95 = 10.0
"""Longest time for PV to follow a pulse, in T95."""


class PulseTest(Experiment):
    """The pulses of the set-point, and the set-point step home that follows them.

    facts, point: what is known of the loop, and the operating point at rest.
    listened: the samples at rest, with which the record begins.
    """

    def __init__(self, facts: Facts, point: OperatingPoint, listened: Trace) -> None:
        super().__init__(facts, point, listened)
        self.size = pulse_size(facts.sp_deviation, point.room, facts.old_gains)
        self.turns: list[int] = []  # samples at which the set-point moved; the first one is the start
        self.period = 0.0
        """The time scale of the record, in samples, from `first_period`."""

    def start(self) -> Plan[None]:
        """Makes the first move of the set-point."""
        self.listened = self.excited = len(self.trace)
        self.turns.append(self.listened)
        self._commands = (SetSetpoint(self.point.sp + PULSES[0] * self.size),)
        yield from self.sample()

    def sample(self) -> Plan[None]:
        """Lets one sample pass."""
        self._commands = self._on_sample((yield self._commands))

    def until_turned(self, turns: int) -> Plan[None]:
        """Goes on until the set-point has turned this number of times. Raises Refused, NO_RESPONSE or WRONG_SIGN: PV
        does not follow."""
        Ts = self.facts.sample_time_s
        while len(self.turns) <= turns:
            yield from self.sample()
            passed = (len(self.trace) - self.turns[-1]) * Ts
            if passed > max(MAX_T95 * self.facts.T95_s, 40 * Ts):
                raise self._not_followed(passed)

    def lasting(self, samples: float) -> Plan[None]:
        """Goes on until the record has lasted this number of samples since the first pulse."""
        while self.elapsed < samples:
            yield from self.sample()

    @property
    def elapsed(self) -> int:
        """The number of samples since the first pulse."""
        return len(self.trace) - self.listened

    def step(self, gains: Gains, model_period: float) -> Plan[None]:
        """Puts the new gains in effect without a bump, and the set-point back to where the test began.

        model_period: the ultimate period of the model, s.
        """
        point = self.point
        self._follow_s = VERIFICATION_PERIODS * model_period
        output_range = self.experiment_record().output_range
        self._step = point.sp - self.trace.sp[-1]
        self.excited = len(self.trace)
        self._commands = ()
        yield from self._follow((SetGains(gains), SetSetpoint(point.sp)), output_range)

    def step_again(self) -> Plan[None]:
        """Steps the set-point by half a pulse under the new gains and follows PV for half as long as after the first
        step."""
        self._follow_s *= STEP_BACK_FRACTION
        target = self.point.sp + STEP_BACK_FRACTION * self.size
        yield from self._follow((SetSetpoint(target),), self.experiment_record().output_range)

    def experiment_record(self) -> ExperimentRecord:
        """The record so far, as deviations from rest; `period` must be known. Raises Refused as `ExperimentRecord`."""
        u, y = self._deviations()
        return ExperimentRecord(
            Ts=self.facts.sample_time_s,
            u=u,
            y=y,
            direction=self._direction,
            listened=self.listened,
            excited=self.excited if self._stepping else len(self.trace),
            turns=len(self.turns) - 1,
            period=self.period,
            steps=tuple(self._steps),
            excitation=Excitation.SETPOINT,
        )

    def figures(self) -> PulseFigures:
        """The figures of the pulses so far."""
        record = self.experiment_record()
        return PulseFigures(
            turns=record.turns,
            size=self.size,
            period_s=record.period * record.Ts,
            output_range=record.output_range,
            noise=self.noise,
            samples=len(record.y),
        )

    def columns(self) -> tuple[Reals, Reals]:
        """MV and PV since the first pulse, as deviations from rest."""
        u, y = self._deviations()
        return u[self.listened :], y[self.listened :]

    def _on_sample(self, sample: Sample) -> tuple[Command, ...]:
        self._add(sample)
        if self._stepping or not self.turns or len(self.turns) == len(PULSES):
            return ()
        since = self.turns[-1]
        if len(self.trace) < since + SAMPLES_AVERAGED:
            return ()
        level = PULSES[len(self.turns) - 1]
        move = self.size * (LEVELS_APART if len(self.turns) > 1 else 1.0)
        begun = float(np.mean(self.trace.pv[max(since - SAMPLES_AVERAGED, 0) : since]))
        followed = level * (float(np.mean(self.trace.pv[-SAMPLES_AVERAGED:])) - begun)
        if followed < max(MIN_FOLLOWED * move, MIN_FOLLOWED_NOISES * self.noise):
            return ()
        self.turns.append(len(self.trace))
        return (SetSetpoint(self.point.sp + PULSES[len(self.turns) - 1] * self.size),)

    def _not_followed(self, passed: float) -> Refused:
        moved = float(np.mean(self.trace.pv[-SAMPLES_AVERAGED:])) - self.point.pv
        text = f"{passed:.3g} s after the set-point moved by {self.size:.3g} PV is {moved:+.3g} away"
        if abs(moved) < MIN_FOLLOWED_NOISES * self.noise:
            return Refused(Reason.NO_RESPONSE, text)
        return Refused(Reason.STALLED, text)


def pulse_size(sp_deviation: float, room: float, gains: Gains) -> float:
    """The size of the pulses, PV units. Under the proportional action of the present gains, a swing from one level to
    the other takes a part of MV's room, and leaves the rest to what PV and the integral add.

    sp_deviation: the largest permitted set-point step, PV units. room: the largest permitted move of MV, MV units.
    """
    kick = LEVELS_APART * gains.b * gains.Kp
    return min(sp_deviation, KICK_OF_ROOM * room / kick) if kick > 0.0 else sp_deviation
