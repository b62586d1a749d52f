"""The types and small plans that all stages share: facts about the loop, operating point, samples, settling."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from loopwright.tuning.experiments.what_moved import WhatMoved, what_moved
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Command, Event, Mode, Plan, Sample, SetMode, SetOutput, SetSetpoint, worked
from loopwright.tuning.reasons import Reason, Refused

T = TypeVar("T")

Array = NDArray[np.float64]


class Directions(StrEnum):
    """To which sides of its rest a test may move the set-point."""

    BOTH = "both"
    UP = "up"
    DOWN = "down"


@dataclass(frozen=True, slots=True)
class Facts:
    """What is known of the loop before the experiment.

    sample_time_s: the sample time, s.
    T95_s: the time in which the plant covers 95 % of a step, s, as given by the user.
    mv_low, mv_high: the limits of MV, absolute, MV units.
    sp_deviation: the largest permitted set-point step, PV units, positive.
    previous_gains: the accepted gains.
    reverse: True when MV must fall as PV rises (positive plant gain).
    pv_low, pv_high: the limits within which PV must stay, absolute, PV units.
    mv_step_max: the largest jump of MV that the test may make from one sample to the next, MV units.
    directions: to which sides of its rest the test may move the set-point.
    sp_rate_max_per_s: the largest rate at which the test may move the set-point, PV units per s.
    Raises Refused: BAD_INPUT, BAD_LIMITS, SAMPLING_TOO_SLOW.
    """

    sample_time_s: float
    T95_s: float
    mv_low: float
    mv_high: float
    sp_deviation: float
    previous_gains: Gains
    reverse: bool = True
    pv_low: float = -math.inf
    pv_high: float = math.inf
    mv_step_max: float = math.inf
    directions: Directions = Directions.BOTH
    sp_rate_max_per_s: float = math.inf

    def __post_init__(self) -> None:
        for name in ("sample_time_s", "T95_s", "sp_deviation"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise Refused(Reason.BAD_INPUT, f"{name} must be a positive number, not {value!r}")
        if not self.sp_rate_max_per_s > 0:
            text = f"sp_rate_max_per_s must be a positive number, not {self.sp_rate_max_per_s!r}"
            raise Refused(Reason.BAD_INPUT, text)
        if not self.mv_low < self.mv_high:
            raise Refused(Reason.BAD_LIMITS, f"mv_low {self.mv_low:g} must be below mv_high {self.mv_high:g}")
        if self.T95_s < 5 * self.sample_time_s:
            raise Refused(
                Reason.SAMPLING_TOO_SLOW, f"T95 {self.T95_s:g} s is under five sample times of {self.sample_time_s:g} s"
            )

    @property
    def one_sided(self) -> bool:
        """Whether the set-point may go to one side of its rest only."""
        return self.directions is not Directions.BOTH

    @property
    def side(self) -> float:
        """The side to which the set-point goes first: +1 up, -1 down."""
        return -1.0 if self.directions is Directions.DOWN else 1.0

    def ramp_s(self, move: float) -> float:
        """The time that a move of the set-point takes at the permitted rate, s. move: PV units."""
        return abs(move) / self.sp_rate_max_per_s


@dataclass(frozen=True, slots=True)
class OperatingPoint:
    """The operating point of a loop at rest.

    sp, pv, mv: the set-point and the means of PV and MV.
    noise: the standard deviation of PV, PV units.
    room: the largest move of MV around `mv` that is permitted in both directions, MV units: up to the nearer limit, and
    half of the largest permitted jump, because a relay jumps from one side to the other.
    """

    sp: float
    pv: float
    mv: float
    noise: float
    room: float


@dataclass(slots=True)
class Trace:
    """Consecutive samples as columns; t is plant time in s.

    mode: the mode of the controller. filled: the samples that were lost, and are interpolated.
    """

    t: list[float] = field(default_factory=list)
    sp: list[float] = field(default_factory=list)
    pv: list[float] = field(default_factory=list)
    mv: list[float] = field(default_factory=list)
    mode: list[int] = field(default_factory=list)
    filled: list[int] = field(default_factory=list)

    def add(self, sample: Sample) -> None:
        """Appends a sample."""
        self.t.append(sample.t)
        self.sp.append(sample.sp)
        self.pv.append(sample.pv)
        self.mv.append(sample.mv)
        self.mode.append(sample.mode)

    def extend(self, later: Trace) -> None:
        """Appends the samples of another trace."""
        for name in ("t", "sp", "pv", "mv", "mode"):
            getattr(self, name).extend(getattr(later, name))
        self.filled.extend(len(self) - len(later) + at for at in later.filled)

    def __len__(self) -> int:
        return len(self.t)

    def tail(self, seconds: float) -> slice:
        """The slice of the samples of the last `seconds`, but at least ten samples where there are as many."""
        dt = (self.t[-1] - self.t[0]) / (len(self.t) - 1) if len(self.t) > 1 else 1.0
        return slice(-min(len(self.t), max(10, round(seconds / dt))), None)


def same(a: float, b: float) -> bool:
    """Whether two numbers are equal to the precision of a REAL32 on the bus."""
    return abs(a - b) <= 1e-6 * max(abs(a), abs(b))


def record(seconds: float, commands: Sequence[Command | Event] = (), *, into: Trace | None = None) -> Plan[Trace]:
    """Carries out the commands and records the samples of this time (s). into: the samples are appended to this
    trace."""
    trace = Trace() if into is None else into
    sample = yield commands
    end = sample.t + seconds
    trace.add(sample)
    while sample.t < end:
        sample = yield ()
        trace.add(sample)
    return trace


def until(
    done: Callable[[Trace], bool], every_s: float, max_s: float, commands: Sequence[Command | Event] = ()
) -> Plan[tuple[Trace, bool]]:
    """Records samples until `done` is true or the time is over; returns the samples and whether `done` was true.

    done: the condition, evaluated every `every_s` seconds.
    max_s: the longest time, s.
    """
    trace = Trace()
    sample = yield commands
    start = sample.t
    trace.add(sample)
    ask = start + every_s
    while True:
        sample = yield ()
        trace.add(sample)
        if sample.t >= ask:
            ask = sample.t + every_s
            if done(trace):
                return trace, True
        if sample.t - start >= max_s:
            return trace, False


def settle(
    target: float, band: float, stay_s: float, max_s: float, noise: float, commands: Sequence[Command | Event] = ()
) -> Plan[tuple[Trace, bool]]:
    """Records samples until PV has stayed around the target, and returns them and whether it has.

    target, band: PV units; the mean of PV over each third of `stay_s` must be within the band, widened for the noise.
    stay_s, max_s: the time for which PV must stay, and the longest time, s.
    noise: the standard deviation of PV, PV units.
    """

    def done(trace: Trace) -> bool:
        if trace.t[-1] - trace.t[0] < stay_s:
            return False
        thirds = np.array_split(np.asarray(trace.pv[trace.tail(stay_s)]) - target, 3)
        return all(abs(float(part.mean())) <= band + 3 * noise / math.sqrt(len(part)) for part in thirds)

    return (yield from until(done, stay_s / 8, max_s, commands))


def to_rest(facts: Facts, point: OperatingPoint, band: float, tested: Trace | None = None) -> Plan[None]:
    """Brings the loop back to rest in manual at the output of the operating point, with the set-point put back.

    The plan waits at most 2 T95 for PV to be within the band (PV units) of the operating point.
    tested: the record of the test before, if it tells whether PV answers MV.
    Raises Refused: NOT_SELF_REGULATING or NOT_AT_REST if PV is then still far away, or as `held`.
    """
    home = (SetMode(Mode.MANUAL), SetOutput(point.mv), SetSetpoint(point.sp))  # manual first: entering it is bumpless
    trace, rested = yield from settle(point.pv, band, facts.T95_s / 5, 2 * facts.T95_s, point.noise, home)
    if not rested:
        away = float(np.mean(trace.pv[trace.tail(facts.T95_s / 5)])) - point.pv
        if abs(away) > max(0.2 * facts.sp_deviation, 2 * band):
            moved = trace.pv[0] - point.pv
            stayed = f"held in manual at MV {point.mv:.4g}, PV stayed {away:+.4g} off {point.pv:.4g}"
            if away * moved > 0.5 * moved * moved > 0.5 * (0.2 * facts.sp_deviation) ** 2:
                text = f"{stayed}, where the test had left it ({moved:+.4g}): it integrates, or the load has moved"
                if tested is None:
                    raise Refused(Reason.NOT_SELF_REGULATING, text)
                tested.extend(trace)
                raise (yield from worked(held(facts, point, tested, text, Reason.NOT_SELF_REGULATING).search))
            raise Refused(Reason.NOT_AT_REST, f"{stayed}: the load has moved")


def what_moved_pv(facts: Facts, point: OperatingPoint, trace: Trace) -> WhatMoved:
    """What has moved PV in the whole of a record. trace: from the first move of the test on."""
    t, mv, pv = (np.asarray(each) for each in (trace.t, trace.mv, trace.pv))
    return what_moved(t, mv - point.mv, pv - point.pv, facts.T95_s, point.noise)


class Unexplained(Refused):
    """The refusal of a test that does not go on, before what has moved PV is looked for in its record, see `explained`.

    search: finds the refusal by the whole of the record. It takes a second, while heartbeats have to go on.
    """

    def __init__(self, reason: Reason, text: str, search: Callable[[], Refused]) -> None:
        super().__init__(reason, text)
        self.search = search


def held(
    facts: Facts, point: OperatingPoint, trace: Trace, text: str, otherwise: Reason, load: Reason = Reason.STALLED
) -> Unexplained:
    """The refusal of a test that does not go on, for a procedure to raise, by the whole of its record and not by its
    last moments: NO_RESPONSE, WRONG_SIGN, STALLED by a load disturbance, DISTURBED by a drift, or another reason.

    trace: from the first move of the test on. text: what has not come to pass.
    otherwise: the reason where PV has answered MV, and nothing else has moved it. load: that of a load disturbance.
    """
    return Unexplained(otherwise, text, partial(_by_whole_record, facts, point, trace, text, otherwise, load))


def explained(plan: Plan[T]) -> Plan[T]:
    """The plan, whose refusal as of `held` has the reason that the whole record gives."""
    try:
        return (yield from plan)
    except Unexplained as unexplained:
        raise (yield from worked(unexplained.search)) from None


def _by_whole_record(
    facts: Facts, point: OperatingPoint, trace: Trace, text: str, otherwise: Reason, load: Reason
) -> Refused:
    found = what_moved_pv(facts, point, trace)
    reason = otherwise
    # a plant that integrates or runs away looks like one that a load or a drift moves: the words name that
    looks_alike = found.answered and otherwise is Reason.NOT_SELF_REGULATING
    if found.load and not looks_alike:
        reason = load
    elif not found.answered:
        reason = Reason.NO_RESPONSE
    elif found.drift and not looks_alike:
        reason = Reason.DISTURBED
    elif (found.gain > 0.0) != facts.reverse:
        reason, text = Reason.WRONG_SIGN, f"PV went the wrong way: {text}"
    return Refused(reason, f"{text}; {found.in_words}")


def no_oscillation(facts: Facts, point: OperatingPoint, trace: Trace, switches: int) -> Unexplained:
    """The refusal of a relay test without a steady oscillation, for a procedure to raise, see `held`; CANNOT_OSCILLATE
    where nothing but MV has moved PV.

    trace: the samples since the start of the relay.
    switches: the number of cycles of the relay.
    """
    away = float(np.mean(trace.pv[trace.tail(facts.T95_s / 5)])) - point.pv
    cycles = f"{switches} cycle{'' if switches == 1 else 's'}"
    after = f"after {trace.t[-1] - trace.t[0]:.3g} s of relay (+-{point.room:.3g}, {cycles}) PV is {away:+.3g} away"
    return held(facts, point, trace, f"no steady oscillation: {after}", Reason.CANNOT_OSCILLATE)
