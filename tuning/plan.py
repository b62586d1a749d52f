"""A plan: an experiment as a generator. It receives one sample per sampling period and answers with commands.

    def settle(...) -> Plan[Rest]:
        sample = yield ()                      # nothing to command: just the next sample
        sample = yield (SetMode(Mode.MANUAL),) # commands take effect before the next sample
        return Rest(...)

A plan owns no clock, no bus and no thread: time is `Sample.t`. A command may take effect a few samples late (on a live
bus), so a plan reads the state from the samples (`mode`, `sp`) instead of counting them. A plan never restores the
loop: the runner does, however the plan ends. A plan that cannot go on raises `Refused` or `Failed` from
`tuning.reasons`. A plan reports stages and results by yielding events among the commands.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Generic, NamedTuple, TypeVar, cast

from loopwright.tuning.gains import Gains

T = TypeVar("T")


class Mode(IntEnum):
    """The mode of the controller, which says what drives MV; the numbers are those of its object dictionary."""

    OFF = 0
    MANUAL = 1
    AUTOMATIC = 2
    EXPERIMENT = 3


class Sample(NamedTuple):
    """One sample.

    t: the plant time, s.
    sp, pv: set-point and PV, PV units.
    mv: MV, MV units.
    mode: the mode in effect.
    """

    t: float
    sp: float
    pv: float
    mv: float
    mode: int


@dataclass(frozen=True, slots=True)
class SetMode:
    """Sets the mode of the controller."""

    mode: Mode


@dataclass(frozen=True, slots=True)
class SetGains:
    """Puts these gains on trial, all in one sample, without a bump of MV."""

    gains: Gains


@dataclass(frozen=True, slots=True)
class SetSetpoint:
    """Sets the set-point, PV units."""

    value: float


@dataclass(frozen=True, slots=True)
class SetOutput:
    """Sets the output for manual mode, MV units."""

    value: float


@dataclass(frozen=True, slots=True)
class SetRelay:
    """Arms and starts the relay inside the controller (mode experiment). A relay that is running keeps its present
    side.

    The output is working_output + amplitude or working_output - amplitude_low; the relay switches on the error, signed
    by the controller's action, with hysteresis.

    amplitude: the amplitude of the higher side, MV units.
    hysteresis: the hysteresis, PV units.
    working_output: the output around which the relay switches, MV units.
    amplitude_low: the amplitude of the lower side, MV units; None for the same as `amplitude`.
    average: the number of samples of PV whose mean switches the relay.
    """

    amplitude: float
    hysteresis: float
    working_output: float
    amplitude_low: float | None = None
    average: int = 1


@dataclass(frozen=True, slots=True)
class SetPvLimits:
    """Sets the limits at which the controller by itself ends the test and restores the loop, PV units; in force until
    the test ends."""

    low: float
    high: float


@dataclass(frozen=True, slots=True)
class StageStarted:
    """A stage has started.

    stage: the name of the stage.
    expected_s: the expected plant time of this stage, s.
    remaining_s: the expected plant time of all stages after it, s.
    """

    stage: str
    expected_s: float
    remaining_s: float


@dataclass(frozen=True, slots=True)
class StageDone:
    """A stage has ended.

    stage: the name of the stage.
    result: its result, a frozen dataclass whose fields are numbers, strings and tuples.
    """

    stage: str
    result: object


@dataclass(frozen=True, slots=True)
class Note:
    """A message for the operator that is neither the start nor the end of a stage."""

    text: str


class Work(Generic[T]):
    """A computation that takes longer than a sampling period. The runner carries it out while the samples go on.

    compute: the computation, a callable that can be pickled, for this process or another.
    """

    def __init__(self, compute: Callable[[], T]) -> None:
        self.compute = compute
        self._value: T | None = None
        self._error: BaseException | None = None
        self.done = False

    def run(self) -> None:
        """Carries out the computation and keeps its result or its exception; the runner calls this once."""
        try:
            value = self.compute()
        except BaseException as error:
            self.fail(error)
        else:
            self.finish(value)

    def finish(self, value: T) -> None:
        """Ends the computation with this result."""
        self._value = value
        self.done = True

    def fail(self, error: BaseException) -> None:
        """Ends the computation with this exception."""
        self._error = error
        self.done = True

    def result(self) -> T:
        """The result of the computation; raises the exception that it ended with."""
        if self._error is not None:
            raise self._error
        return cast(T, self._value)


Command = SetMode | SetGains | SetSetpoint | SetOutput | SetRelay | SetPvLimits
Event = StageStarted | StageDone | Note
Plan = Generator[Sequence[Command | Event | Work[Any]], Sample, T]


def worked(compute: Callable[[], T]) -> Plan[T]:
    """The plan of a long computation alone: the loop goes on, and the plan returns the result."""
    work = Work(compute)
    yield (work,)
    while not work.done:
        yield ()
    return work.result()
