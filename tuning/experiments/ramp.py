"""No test moves the set-point faster than its loop permits: the moves of a plan become ramps, sample by sample.

The plan commands a move at once, as without a limit, and sees in the samples how far the set-point has come. What the
plan computes of the record needs no step: MV and PV are as measured.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import closing
from typing import Any, TypeVar

from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.plan import Command, Event, Note, Plan, Sample, SetSetpoint, Work
from loopwright.tuning.reasons import Reason, Refused

T = TypeVar("T")
Items = Sequence[Command | Event | Work[Any]]

AT_ONCE = (Reason.DIVERGES, Reason.MV_LIMIT, Reason.WRONG_SIGN)
"""Refusals after which the loop is not left a moment longer: the set-point goes home with the session, in one step."""
MIN_NOISES = 1.0
"""Smallest excitation that may tell something: the step of the set-point that excites a loop around its ultimate
frequency as much as the ramp does, in standard deviations of the noise. Half of the loops tell enough then."""
MIN_NOISES_OF_TRIAL = 10.0
"""The same for a step under new gains that is the only check of a plant known from operation."""
MAX_RAMP_T95 = 10.0
"""Longest time for a move by the permitted step, in T95: the pulses make five of them at most."""
LONGEST_PERIOD_T95 = 0.95
"""Ultimate period, in T95, that few loops exceed."""


def ramped(facts: Facts, plan: Plan[T]) -> Plan[T]:
    """The plan with its moves of the set-point at the permitted rate; at its end the set-point goes home likewise.

    A move that is commanded while another one goes on takes its place. Raises what the plan raises.
    """
    if not math.isfinite(facts.sp_rate_max_per_s):
        return (yield from plan)
    ramp = _Ramp(facts.sp_rate_max_per_s * facts.sample_time_s)
    refused: Refused | None = None
    value: T | None = None
    with closing(plan):
        items: Items = next(plan)
        while True:
            sample = yield ramp.of(items)
            ramp.see(sample)
            try:
                items = plan.send(sample)
            except StopIteration as end:
                value = end.value
                break
            except Refused as raised:
                refused = raised
                break
    if refused is None or refused.reason not in AT_ONCE:
        yield from _home(facts, ramp)
    if refused is not None:
        raise refused
    return value  # type: ignore[return-value]  # the plan has returned it


def equivalent_step(facts: Facts, period_s: float) -> float:
    """The step of the set-point that excites a loop around its ultimate frequency as much as one ramp does, PV units.

    The amplitude density of a step of size s is s/w, that of a corner of a ramp of rate r is r/w^2.
    period_s: the ultimate period, s.
    """
    return facts.sp_rate_max_per_s * period_s / (2.0 * math.pi)


def too_slow(facts: Facts, noise: float, period_s: float, noises: float = MIN_NOISES) -> str | None:
    """Why ramps tell nothing of a loop, in words with the numbers; None where they may.

    noise: the standard deviation of PV, PV units. period_s: the ultimate period, s, or the longest that it may be.
    noises: the smallest excitation, see `MIN_NOISES`.
    """
    takes = slow_words(facts)
    longest = MAX_RAMP_T95 * facts.T95_s
    if facts.ramp_s(facts.sp_deviation) > longest:
        rate = facts.sp_deviation / longest
        return f"{takes}, more than {MAX_RAMP_T95:g} T95 ({longest:.4g} s): a rate of {rate:.3g} at least is needed"
    step = equivalent_step(facts, period_s)
    if not step < noises * noise:
        return None
    rate = noises * noise * 2.0 * math.pi / period_s
    return (
        f"{takes}, and excites a loop of an ultimate period of {period_s:.4g} s as much as a step of {step:.3g}, which "
        f"is {step / noise:.2g} times the noise of {noise:.3g}: a rate of {rate:.3g} at least is needed"
    )


def slow_words(facts: Facts) -> str:
    """How long a move by the permitted step takes at the permitted rate, in words."""
    return (
        f"at sp_rate_max_per_s {facts.sp_rate_max_per_s:.4g} the set-point takes "
        f"{facts.ramp_s(facts.sp_deviation):.4g} s for a move by {facts.sp_deviation:.4g}"
    )


def check_ramp(facts: Facts, noise: float) -> None:
    """Raises Refused, UNCERTAIN, where ramps at the permitted rate tell nothing of a loop of this T95.

    noise: the standard deviation of PV, PV units.
    """
    why = too_slow(facts, noise, LONGEST_PERIOD_T95 * facts.T95_s)
    if why is not None:
        raise Refused(Reason.UNCERTAIN, why)


class _Ramp:
    """The set-point between two of its commanded values. step: its largest move within one sample, PV units."""

    def __init__(self, step: float) -> None:
        self._step = step
        self._at: float | None = None
        self.target: float | None = None
        self.home: float | None = None

    def see(self, sample: Sample) -> None:
        """Takes the set-point from the first sample; later ones may be late."""
        if self._at is None:
            self._at = self.home = sample.sp

    @property
    def away(self) -> float:
        """How far the set-point is from where it was at first, PV units."""
        return 0.0 if self._at is None or self.home is None else self._at - self.home

    def of(self, items: Items) -> list[Command | Event | Work[Any]]:
        """The items with the next part of a move in place of the whole of it."""
        kept: list[Command | Event | Work[Any]] = []
        for item in items:
            if isinstance(item, SetSetpoint):
                self.target = item.value
            else:
                kept.append(item)
        if self.target is None or self._at is None:
            return kept
        left = self.target - self._at
        if abs(left) <= self._step * (1.0 + 1e-9):
            self._at, self.target = self.target, None
        else:
            self._at += math.copysign(self._step, left)
        return [*kept, SetSetpoint(self._at)]


def _home(facts: Facts, ramp: _Ramp) -> Plan[None]:
    if ramp.home is None or not ramp.away:
        return
    items: Items = (
        Note(f"the set-point returns within {facts.ramp_s(ramp.away):.4g} s"),
        SetSetpoint(ramp.home),
    )
    while ramp.away:
        yield ramp.of(items)
        items = ()
