"""Pulses of the manual output of a loop in manual, with their record.

A pulse takes MV away from the manual output found, and back to it. Nothing is computed while MV is away, so that no
computation prolongs a pulse; if everything of ours dies meanwhile, the controller takes the manual output back.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar

import numpy as np

from loopwright.tuning.experiments.half_wave import has_moved
from loopwright.tuning.experiments.primitives import Facts, OperatingPoint, Trace, held
from loopwright.tuning.fast.evaluation.record_evaluation import MIN_PERIOD
from loopwright.tuning.fast.manual.self_regulation import comes_to_rest
from loopwright.tuning.fast.manual.sizes import ManualRecord, first_pulse, largest_pulse, next_pulse, pv_bounds
from loopwright.tuning.fast.pulses.levels import PulseBounds
from loopwright.tuning.fast.pulses.pulse_test import MAX_BEYOND, SAMPLES_AVERAGED, PulseExperiment
from loopwright.tuning.fast.record import Excitation, ExperimentRecord
from loopwright.tuning.models import Model
from loopwright.tuning.plan import Command, Note, Plan, Sample, SetOutput, SetPvLimits
from loopwright.tuning.reasons import Reason, Refused

T = TypeVar("T")
TURN_STEPS, TURN_NOISES = 0.2, 8.0
"""The first pulse ends when PV has moved by this part of the permitted step, and by so many standard deviations of the
noise. Where MV permits no larger pulse, PV has to move by the latter alone."""
LONGEST_PULSE_T95 = 0.5
"""The longest pulse, in T95."""
ANSWER_T95 = 1.0
"""How long after the first pulse PV may take to answer at all, in T95."""
CAME_BACK = 0.5
"""Part of the way that PV comes back by itself, before a plant counts as self-regulating."""
MIN_BACK_NOISES = 4.0
"""Smallest way back, in standard deviations of the noise."""
BACK_T95, BACK_PULSES = 2.0, 6.0
"""The longest wait for that, the longer of so many T95 and so many times the first pulse."""
RAISE, MAX_RAISES = 4.0, 3
"""Factor by which a pulse is raised that PV has hardly answered, and how often. One that has not moved PV beyond its
noise is not raised: a sensor that has ended, or a valve that does not move, is not told from it."""
MIN_STEPS = 1e-3
"""Smallest move of a PV without noise, in permitted steps."""
SAMPLES_TO_FOLLOW = 30
"""Number of samples after which MV has to have followed the manual output, or to be on its way."""
HAIR = 1e-4
"""Distance from the manual output at which MV has followed, as a fraction of MV's range."""


class ManualTest(PulseExperiment):
    """The pulses of the manual output.

    facts, point: what is known of the loop, and the operating point at rest.
    listened: the samples at rest, with which the record begins.
    Raises Refused, SATURATED: MV has no room for a pulse.
    """

    def __init__(self, facts: Facts, point: OperatingPoint, listened: Trace) -> None:
        super().__init__(facts, point, listened)
        self.home = listened.mv[-1]
        self.side = facts.side * self._direction
        """The side of the next pulse: +1 up, -1 down."""
        only = self.side if facts.one_sided else None
        self.largest = largest_pulse(self.home, facts.mv_low, facts.mv_high, facts.mv_step_max, only)
        if not self.largest > 0.0:
            raise Refused(Reason.SATURATED, f"MV {self.home:.4g} leaves no room for a pulse")
        self.size = first_pulse(facts.previous_gains.Kp * facts.sp_deviation, self.largest)
        self._begun = len(self.trace)
        """The sample at which the first pulse, or its larger repetition, began."""
        self._farthest = 0.0
        """The largest deviation of PV from rest since then, PV units, of the mean of the last samples."""
        self._ordered = self.home
        self._follows_at = 0
        self._waited = 0

    def start(self) -> Plan[None]:
        """Hands the limits of PV to the controller, which ends the test by itself where PV leaves them."""
        facts = self.facts
        self.listened = self.excited = len(self.trace)
        if math.isfinite(facts.pv_low) and math.isfinite(facts.pv_high):
            self._commands = (SetPvLimits(facts.pv_low, facts.pv_high),)
        yield from self.sample()

    def first(self) -> Plan[None]:
        """Makes the first pulse, and waits until PV has come back by half by itself.

        Raises Refused: NO_RESPONSE, and as `_until_back`.
        """
        for raised in range(MAX_RAISES + 1):
            self._begun, self._farthest = len(self.trace), 0.0
            yield from self._turn(self.home + self.side * self.size)
            longest = self._samples(LONGEST_PULSE_T95 * self.facts.T95_s)
            while len(self.trace) - self._begun < longest and abs(self._moved()) < self._turns_at:
                yield from self.sample()
            width = len(self.trace) - self._begun
            yield from self._turn(self.home)
            answered = self._begun + width + self._samples(ANSWER_T95 * self.facts.T95_s)
            while len(self.trace) < answered and self._farthest < self._turns_at:
                yield from self.sample()
            is_largest = raised == MAX_RAISES or self.size >= self.largest
            if self._farthest >= (TURN_NOISES * self.noise if is_largest else self._turns_at):
                return (yield from self._until_back(width))
            moved = has_moved(self.trace.pv[self._begun :], self.noise, MIN_STEPS * self.facts.sp_deviation)
            if not is_largest and moved:
                size = min(RAISE * self.size, self.largest)
                yield from self.report(
                    Note(f"PV hardly answers a pulse of {self.size:.3g} of MV: the next one has {size:.3g}")
                )
                self.size = size
                continue
            break
        text = (
            f"a pulse of {self.size:.4g} of MV, {width * self.facts.sample_time_s:.3g} s long, moved PV by "
            f"{self._farthest:.3g}, and {TURN_NOISES:g} times the noise of {self.noise:.3g} are needed"
        )
        if not is_largest:
            text += "; a PV that has not moved beyond its noise gets no larger pulse"
        raise Refused(Reason.NO_RESPONSE, text)

    def pulse(self, width: int, models: Sequence[Model] = ()) -> Plan[bool]:
        """Makes a pulse of this length, in samples, to the side whose turn it is, as large as PV and MV permit. Returns
        False where PV has to come nearer to rest first.

        models: those that it is sized by, in place of those that explain the record."""
        sizing = partial(next_pulse, self._past(), self.side, width, self._bounds(), self.size, self.largest, models)
        size = yield from self.computed(sizing)
        if not size:
            return False
        self.size = size
        yield from self._turn(self.home + self.side * size)
        for _ in range(min(width, self._samples(LONGEST_PULSE_T95 * self.facts.T95_s)) - 1):
            yield from self.sample()
        yield from self._turn(self.home)
        if not self.facts.one_sided:
            self.side = -self.side
        return True

    def resting(self, samples: float) -> Plan[None]:
        """Lets PV go on for so many samples, with MV at home."""
        until = len(self.trace) + samples
        while len(self.trace) < until:
            yield from self.sample()

    def sample(self) -> Plan[None]:
        """Lets one sample pass."""
        self._commands = self._on_sample((yield self._commands))

    def computed(self, compute: Callable[[], T]) -> Plan[T]:
        """As of every experiment, with the samples counted that it takes."""
        begun = len(self.trace)
        result = yield from super().computed(compute)
        self._waited += len(self.trace) - begun
        return result

    @property
    def elapsed(self) -> int:
        """The number of samples since the first pulse."""
        return len(self.trace) - self.listened

    @property
    def spent(self) -> int:
        """The number of samples since the first pulse that pulses and rests have taken: a slow computation is no
        reason to end them."""
        return self.elapsed - self._waited

    def experiment_record(self) -> ExperimentRecord:
        """The record so far, as deviations from rest; `period` must be known. Raises Refused as `ExperimentRecord`."""
        return self._manual_record(self.period)

    def _manual_record(self, period: float) -> ExperimentRecord:
        return self._record(len(self.turns) - 1, period, Excitation.MANUAL)

    def _until_back(self, width: int) -> Plan[None]:
        """Waits until PV has come back by half from its farthest point of this pulse. Raises Refused
        where it does not, see `held`; otherwise NOT_SELF_REGULATING: it would stay away, or run away, at the manual
        output found."""
        facts = self.facts
        longest = max(self._samples(BACK_T95 * facts.T95_s), BACK_PULSES * width)
        back = len(self.trace)
        while True:
            farthest, away = self._farthest, abs(self._moved())
            if farthest - away >= max(CAME_BACK * farthest, MIN_BACK_NOISES * self.noise):
                return
            if len(self.trace) - back > longest:
                if (yield from self.computed(partial(comes_to_rest, self._manual_record(MIN_PERIOD)))):
                    text = "PV has not come back, but a load disturbance explains that"
                    return (yield from self.report(Note(text)))
                passed = (len(self.trace) - back) * facts.sample_time_s
                text = (
                    f"{passed:.3g} s after a pulse of {self.size:.4g} of MV, PV is {self._moved():+.4g} away, of "
                    f"{farthest:.4g} at most: it does not come back by itself within {BACK_T95:g} T95"
                )
                raise held(facts, self.point, self._tested(), text, Reason.NOT_SELF_REGULATING)
            yield from self.sample()

    def _turn(self, output: float) -> Plan[None]:
        """Sets the manual output."""
        self.turns.append(len(self.trace))
        self._ordered, self._follows_at = output, len(self.trace) + SAMPLES_TO_FOLLOW
        self._commands = (SetOutput(output),)
        yield from self.sample()

    def _on_sample(self, sample: Sample) -> tuple[Command, ...]:
        self._add(sample)
        return ()

    def _add(self, sample: Sample) -> None:
        super()._add(sample)
        facts, trace = self.facts, self.trace
        if len(trace) - self._begun >= SAMPLES_AVERAGED:
            self._farthest = max(self._farthest, abs(self._moved()))
        hair = HAIR * (facts.mv_high - facts.mv_low)
        if len(trace) <= self._follows_at or not self.turns or abs(sample.mv - self._ordered) <= hair:
            return
        if abs(sample.mv - trace.mv[-1 - SAMPLES_TO_FOLLOW]) <= hair:
            text = f"MV stays at {sample.mv:.4g}, and the manual output is {self._ordered:.4g}"
            raise Refused(Reason.MV_LIMIT, f"{text}: a limit of the controller holds it")

    def _moved(self) -> float:
        """By how much PV is away from rest, the mean of the last samples, PV units."""
        return float(np.mean(self.trace.pv[-SAMPLES_AVERAGED:])) - self.point.pv

    @property
    def _turns_at(self) -> float:
        """The deviation of PV at which the first pulse ends, PV units."""
        return max(TURN_STEPS * self.facts.sp_deviation, TURN_NOISES * self.noise)

    def _samples(self, seconds: float) -> int:
        return max(1, math.ceil(seconds / self.facts.sample_time_s))

    def _past(self) -> ManualRecord:
        u, y = self._deviations()
        return ManualRecord(self.facts.sample_time_s, u, y, self.listened, self._direction)

    def _bounds(self) -> PulseBounds:
        return pv_bounds(self.facts, self.point, self.noise, MAX_BEYOND)
