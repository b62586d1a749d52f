"""What every stage shares: the facts about the loop, its operating point, and the small plans they are made of."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Command, Event, Mode, Plan, Sample, SetMode, SetOutput, SetSetpoint
from loopwright.tuning.reasons import Reason, Refused

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Facts:
    """What is known of the loop before the experiment.

    sample_time_s, T95_s: s.  mv_low, mv_high: permitted MV, absolute, MV units.
    sp_deviation: largest permitted set-point step, PV units, > 0.  old_gains: the accepted set.
    reverse: True when MV must fall as PV rises (positive plant gain).
    """

    sample_time_s: float
    T95_s: float
    mv_low: float
    mv_high: float
    sp_deviation: float
    old_gains: Gains
    reverse: bool = True

    def __post_init__(self) -> None:
        for name in ("sample_time_s", "T95_s", "sp_deviation"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise Refused(Reason.BAD_INPUT, f"{name} must be a positive number, not {value!r}")
        if not self.mv_low < self.mv_high:
            raise Refused(Reason.BAD_LIMITS, f"mv_low {self.mv_low:g} must be below mv_high {self.mv_high:g}")
        if self.T95_s < 5 * self.sample_time_s:
            raise Refused(
                Reason.SAMPLING_TOO_SLOW, f"T95 {self.T95_s:g} s is under five sample times of {self.sample_time_s:g} s"
            )


@dataclass(frozen=True, slots=True)
class OperatingPoint:
    """Where the loop rests: sp, pv, mv (means), noise (standard deviation of PV), room: permitted +-MV around mv."""

    sp: float
    pv: float
    mv: float
    noise: float
    room: float


@dataclass(slots=True)
class Trace:
    """Samples of a stretch, as columns; t in plant seconds."""

    t: list[float] = field(default_factory=list)
    sp: list[float] = field(default_factory=list)
    pv: list[float] = field(default_factory=list)
    mv: list[float] = field(default_factory=list)

    def add(self, sample: Sample) -> None:
        self.t.append(sample.t)
        self.sp.append(sample.sp)
        self.pv.append(sample.pv)
        self.mv.append(sample.mv)

    def __len__(self) -> int:
        return len(self.t)

    def tail(self, seconds: float) -> slice:
        """The samples of the last so many seconds (at least ten, if there are)."""
        dt = (self.t[-1] - self.t[0]) / (len(self.t) - 1) if len(self.t) > 1 else 1.0
        return slice(-min(len(self.t), max(10, round(seconds / dt))), None)


def same(a: float, b: float) -> bool:
    """Equal as far as a REAL32 on the bus can tell."""
    return abs(a - b) <= 1e-6 * max(abs(a), abs(b))


def record(seconds: float, commands: Sequence[Command | Event] = (), *, into: Trace | None = None) -> Plan[Trace]:
    """Carries out the commands, then listens for so long."""
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
    """Listens until `done` (asked every so many seconds) or the time is over; tells which."""
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
    """Listens until PV has stayed around target for stay_s: its mean over each third of that time within the band."""

    def done(trace: Trace) -> bool:
        if trace.t[-1] - trace.t[0] < stay_s:
            return False
        thirds = np.array_split(np.asarray(trace.pv[trace.tail(stay_s)]) - target, 3)
        return all(abs(float(part.mean())) <= band + 3 * noise / math.sqrt(len(part)) for part in thirds)

    return (yield from until(done, stay_s / 8, max_s, commands))


def to_rest(facts: Facts, point: OperatingPoint, band: float) -> Plan[None]:
    """Manual at the nominal output, set-point back, until PV is home again (at most 2 T95, then it must be near)."""
    home = (SetMode(Mode.MANUAL), SetOutput(point.mv), SetSetpoint(point.sp))  # manual first: entering it is bumpless
    trace, rested = yield from settle(point.pv, band, facts.T95_s / 5, 2 * facts.T95_s, point.noise, home)
    if not rested:
        away = float(np.mean(trace.pv[trace.tail(facts.T95_s / 5)])) - point.pv
        if abs(away) > max(0.2 * facts.sp_deviation, 2 * band):
            moved = trace.pv[0] - point.pv
            stayed = f"held in manual at MV {point.mv:.4g}, PV stayed {away:+.4g} off {point.pv:.4g}"
            if away * moved > 0.5 * moved * moved > 0.5 * (0.2 * facts.sp_deviation) ** 2:
                text = f"{stayed}, where the test had left it ({moved:+.4g}): it integrates, or the load has moved"
                raise Refused(Reason.NOT_SELF_REGULATING, text)
            raise Refused(Reason.NOT_AT_REST, f"{stayed}: the load has moved")


def no_oscillation(facts: Facts, point: OperatingPoint, trace: Trace, switches: int) -> Refused:
    """Why the relay has made PV swing by nothing that is steady: for a procedure to raise."""
    moved = float(np.mean(trace.pv[trace.tail(facts.T95_s / 5)])) - point.pv
    expected = 1.0 if facts.reverse else -1.0
    after = f"{trace.t[-1] - trace.t[0]:.3g} s of relay (+-{point.room:.3g}, {switches} cycles) PV is {moved:+.3g} away"
    if abs(moved) < max(5 * point.noise, 1e-3 * facts.sp_deviation):
        return Refused(Reason.NO_RESPONSE, "after " + after)
    if switches == 0 and moved * expected < 0:
        return Refused(Reason.WRONG_SIGN, f"PV went the wrong way: after {after}")
    return Refused(Reason.CANNOT_OSCILLATE, "no steady oscillation: after " + after)
