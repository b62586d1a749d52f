"""What the tests of the fast procedure share: the record that goes on sample by sample, and steps of the set-point."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np

from loopwright.tuning.analysis.pv_faults import without_wrong_samples
from loopwright.tuning.experiments.control_record import ControlRecord, control_record
from loopwright.tuning.experiments.primitives import Facts, OperatingPoint, Trace
from loopwright.tuning.fast.record import Excitation, ExperimentRecord, noise_of
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Reals
from loopwright.tuning.plan import Command, Event, Plan, Sample, SetSetpoint, Work
from loopwright.tuning.reasons import Reason, Refused

T = TypeVar("T")
VERIFICATION_PERIODS = 3.0
STEP_BACK_FRACTION = 0.5
"""Duration of the step back as a fraction of the duration of the first step."""
DIVERGED = 20.0
"""Deviation of PV, in ranges of PV under the excitation, at which the step under the new gains is ended."""


def on_trial(gains: Gains) -> Gains:
    """The gains designed, as the set-point step is made with them: with a set-point weight of at most one.

    b has no part in what the step is to prove, the model and Ms. With b above one MV would be kicked further than a
    dead band or stiction of the valve was ever found under; below one the step is the answer that is proposed.
    """
    return replace(gains, b=min(gains.b, 1.0))


class Experiment:
    """The experiment of the fast procedure on one loop: its plans move the loop and extend its record.

    facts, point: what is known of the loop, and the operating point at rest.
    record: the samples so far, with which the record begins.
    at_rest: the number of samples at rest at its beginning; None where all of them are.
    """

    def __init__(self, facts: Facts, point: OperatingPoint, record: Trace, at_rest: int | None = None) -> None:
        self.facts, self.point, self.trace = facts, point, record
        self.listened = len(record) if at_rest is None else at_rest
        self.excited = 0
        self.noise = noise_of(np.asarray(record.pv[: self.listened]))
        self._follow_s = 0.0
        self._steps: list[int] = []
        self._commands: tuple[Command, ...] = ()
        self._step = 0.0
        self._gains_tried: Gains | None = None

    @property
    def stepped(self) -> tuple[float, float]:
        """The size of the set-point step, PV units, and the time since that step, s."""
        return self._step, self.trace.t[-1] - self.trace.t[self.excited]

    def report(self, *events: Event) -> Plan[None]:
        """Hands events to the runner; the sample that comes back belongs to the record."""
        self._commands = self._on_sample((yield (*self._commands, *events)))

    def computed(self, compute: Callable[[], T]) -> Plan[T]:
        """The result of a long computation; the record goes on meanwhile."""
        work = Work(compute)
        self._commands = self._on_sample((yield (*self._commands, work)))
        while not work.done:
            self._commands = self._on_sample((yield self._commands))
        return work.result()

    def step_back(self) -> Plan[None]:
        """Steps the set-point back under the same gains and follows PV for half as long as after the first step."""
        self._follow_s *= STEP_BACK_FRACTION
        yield from self._follow((SetSetpoint(self.point.sp),), self.experiment_record().output_range)

    def experiment_record(self) -> ExperimentRecord:
        """The record so far, as deviations from rest."""
        raise NotImplementedError

    def _record(
        self, turns: int, period: float, excitation: Excitation, control: ControlRecord | None = None
    ) -> ExperimentRecord:
        """The record so far. turns, period, excitation, control: see `ExperimentRecord`. Raises Refused as it does."""
        u, y = self._deviations()
        return ExperimentRecord(
            Ts=self.facts.sample_time_s,
            u=u,
            y=y,
            direction=self._direction,
            listened=self.listened,
            excited=self.excited if self._stepping else len(self.trace),
            turns=turns,
            period=period,
            steps=tuple(self._steps),
            excitation=excitation,
            one_sided=self.facts.one_sided and excitation is not Excitation.RELAY,
            control=control,
        )

    def _deviations(self) -> tuple[Reals, Reals]:
        """MV and PV of the record as deviations from their means at rest. Single wrong samples of PV are interpolated,
        as lost ones are: what the controller made of them is in MV."""
        rest = slice(0, self.listened)
        mv, pv = np.asarray(self.trace.mv), without_wrong_samples(np.asarray(self.trace.pv))
        return mv - float(np.mean(mv[rest])), pv - float(np.mean(pv[rest]))

    def _tested(self) -> Trace:
        """The record since its rest."""
        trace, at = self.trace, self.listened
        return Trace(trace.t[at:], trace.sp[at:], trace.pv[at:], trace.mv[at:])

    def _control(self) -> ControlRecord:
        """What the record so far shows of the controller.

        New gains are in effect once the set-point, which is commanded after them, has moved: a command may be late.
        """
        facts, trace, samples = self.facts, self.trace, len(self.trace)
        if self._gains_tried is None or not self._steps:
            return control_record(facts, trace, [(0, samples, facts.previous_gains)])
        moved = np.flatnonzero(np.diff(trace.sp[self._steps[0] - 1 :]))
        begun = self._steps[0] + int(moved[0]) if len(moved) else samples
        return control_record(
            facts, trace, [(0, self.excited, facts.previous_gains), (begun, samples, self._gains_tried)]
        )

    @property
    def _direction(self) -> float:
        return 1.0 if self.facts.reverse else -1.0

    @property
    def _stepping(self) -> bool:
        return self.excited > self.listened

    def _follow(self, commands: tuple[Command, ...], output_range: float, diverged: float = DIVERGED) -> Plan[None]:
        """Follows PV after a set-point step.

        output_range: by how much the test has moved PV, PV units. diverged: how many times that PV may go from rest.
        Raises Refused, DIVERGES.
        """
        self._steps.append(len(self.trace))
        moves = [each.value - self.trace.sp[-1] for each in commands if isinstance(each, SetSetpoint)]
        sample = yield commands
        self._add(sample)
        end = sample.t + self._follow_s + self.facts.ramp_s(moves[-1] if moves else 0.0)
        while sample.t < end:
            sample = yield ()
            self._add(sample)
            if abs(sample.pv - self.point.pv) > diverged * output_range:
                raise Refused(
                    Reason.DIVERGES,
                    f"PV is {sample.pv - self.point.pv:+.4g} away; the test had moved it by {output_range:.4g}",
                )

    def _add(self, sample: Sample) -> None:
        """Adds a sample to the record. Missing samples before it are filled: PV interpolated, MV held."""
        trace, Ts = self.trace, self.facts.sample_time_s
        lost = round((sample.t - trace.t[-1]) / Ts) - 1
        t, pv = trace.t[-1], trace.pv[-1]
        for k in range(1, lost + 1):
            between = pv + (sample.pv - pv) * k / (lost + 1)
            trace.filled.append(len(trace))
            trace.add(sample._replace(t=t + k * Ts, pv=between, mv=trace.mv[-1]))
        trace.add(sample)

    def _on_sample(self, sample: Sample) -> tuple[Command, ...]:
        """Records one sample and returns the commands that follow from it."""
        raise NotImplementedError
