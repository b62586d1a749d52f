"""A plan: an experiment as a generator. It receives one sample per sampling period and answers with commands.

    def settle(...) -> Plan[Rest]:
        sample = yield ()                      # nothing to command: just the next sample
        sample = yield (SetMode(Mode.MANUAL),) # commands take effect before the next sample
        return Rest(...)

Rules of the house. A plan owns no clock, no bus and no thread: time is `Sample.t`. A command may take effect a few
samples late (a live bus), so a plan looks at what the samples say (`mode`, `sp`) rather than counting. A plan never
restores the loop: the runner does, on every way out. A plan that cannot go on raises `Refused` or `Failed` from
`tuning.reasons`. What a plan wants to tell (stages, results) it yields among the commands, as events.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Generic, NamedTuple, TypeVar, cast

from loopwright.tuning.gains import Gains

T = TypeVar("T")


class Mode(IntEnum):
    """What drives the MV; the numbers are those of the controller's object dictionary."""

    OFF = 0
    MANUAL = 1
    AUTOMATIC = 2
    EXPERIMENT = 3


class Sample(NamedTuple):
    """One sampling period: t in plant seconds; sp, pv in PV units; mv in MV units; the mode in effect."""

    t: float
    sp: float
    pv: float
    mv: float
    mode: int


@dataclass(frozen=True, slots=True)
class SetMode:
    mode: Mode


@dataclass(frozen=True, slots=True)
class SetGains:
    """Put these gains on trial, all in one sample, bumplessly."""

    gains: Gains


@dataclass(frozen=True, slots=True)
class SetSetpoint:
    value: float


@dataclass(frozen=True, slots=True)
class SetOutput:
    """The output for manual mode, MV units."""

    value: float


@dataclass(frozen=True, slots=True)
class SetRelay:
    """Arm and start the relay inside the controller (mode experiment).

    u = working_output +- amplitude, switching on the action-signed error, with hysteresis.
    amplitude_low: of the lower side, if it is not the same.  average: the mean of so many samples switches.
    While a relay is running it goes on from the side it is on.
    """

    amplitude: float
    hysteresis: float
    working_output: float
    amplitude_low: float | None = None
    average: int = 1


@dataclass(frozen=True, slots=True)
class StageStarted:
    """expected_s: expected plant time of this stage; remaining_s: of all stages after it."""

    stage: str
    expected_s: float
    remaining_s: float


@dataclass(frozen=True, slots=True)
class StageDone:
    """result: a frozen dataclass with plain fields (numbers, strings, tuples)."""

    stage: str
    result: object


@dataclass(frozen=True, slots=True)
class Note:
    """Something worth telling the operator that is neither a stage's start nor its end."""

    text: str


class Work(Generic[T]):
    """A computation too long to do between two samples: the runner does it beside them, and goes on pumping.

    compute: to be done in this process or another; what can be pickled.
    """

    def __init__(self, compute: Callable[[], T]) -> None:
        self.compute = compute
        self._value: T | None = None
        self._error: BaseException | None = None
        self.done = False

    def run(self) -> None:
        """Called once, by whoever pumps the plan, in a thread of its own or not."""
        try:
            value = self.compute()
        except BaseException as error:
            self.fail(error)
        else:
            self.finish(value)

    def finish(self, value: T) -> None:
        """It came to this."""
        self._value = value
        self.done = True

    def fail(self, error: BaseException) -> None:
        """It raised this."""
        self._error = error
        self.done = True

    def result(self) -> T:
        """What it came to; raises what it raised."""
        if self._error is not None:
            raise self._error
        return cast(T, self._value)


Command = SetMode | SetGains | SetSetpoint | SetOutput | SetRelay
Event = StageStarted | StageDone | Note
Plan = Generator[Sequence[Command | Event | Work[Any]], Sample, T]


def worked(compute: Callable[[], T]) -> Plan[T]:
    """The result of a long computation, while the loop goes on under guard."""
    work = Work(compute)
    yield (work,)
    while not work.done:
        yield ()
    return work.result()
