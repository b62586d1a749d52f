"""Runs a plan on a loop, checks every sample, and always restores the loop: the second clause of the safety contract.

Whatever ends the run - the plan's result, a refusal, a limit, a lost node, an operator, a defect - the end is the same:
the session is closed, the controller restores the loop, and its state is read back. Where PV is false the controller is
told first to hold the loop in manual.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from loopwright.service.execution.guard import Guard, RunLimits
from loopwright.service.loops.loop import Loop
from loopwright.service.states.loop_state import LoopState, after_false_pv
from loopwright.tuning.plan import (
    Command,
    Event,
    Mode,
    Note,
    Plan,
    Sample,
    SetGains,
    SetMode,
    SetOutput,
    SetPvLimits,
    SetRelay,
    SetSetpoint,
    StageDone,
    StageStarted,
    Work,
)
from loopwright.tuning.reasons import Aborted, Ended, Failed, FalsePv, Reason

T = TypeVar("T")
_UNREACHED = (Reason.NODE_LOST, Reason.NODE_NOT_ANSWERING, Reason.BUS_LOST)
CHUNK = 200
CHUNK_S = 1.0
"""Plant time after which samples are passed on, s, if there are fewer than CHUNK: a service that dies loses no more."""


@dataclass(slots=True)
class RunResult(Generic[T]):
    """The end of a run.

    value: the plan's result; None where there is none.
    ended: why there is no result; None where there is one.
    restored: the loop as read back; None if it could not be read.
    plant_time_s: plant time by stage, s.
    """

    value: T | None = None
    ended: Ended | None = None
    restored: LoopState | None = None
    plant_time_s: dict[str, float] = field(default_factory=dict)


def run(
    plan: Plan[T],
    loop: Loop,
    *,
    limits: RunLimits,
    on_event: Callable[[Event], None] = lambda event: None,
    on_samples: Callable[[list[Sample]], None] = lambda samples: None,
    stop: Callable[[], Reason | None] = lambda: None,
    start_work: Callable[[Work[Any]], None] = Work.run,
    note_session: Callable[[int], None] = lambda session: None,
    on_home: Callable[[LoopState], None] = lambda home: None,
) -> RunResult[T]:
    """Runs the plan to its end and restores the loop. Raises no error of the loop or plan; see `ended`.

    limits: the limits of the run.
    stop: asked once a sample and in every wait; a reason that it returns ends the run as Aborted.
    start_work: starts a plan's long computation: for a live loop in a thread, because the loop must be stepped
    meanwhile; by default at once, where no loop waits.
    note_session: receives the number of the session before it is opened.
    on_home: receives the state of the loop before the test.
    """
    return _Run(plan, loop, limits, on_event, on_samples, stop, start_work, note_session, on_home).to_the_end()


class _Run(Generic[T]):
    """Carries out one run of a plan on a loop; the arguments are those of `run`."""

    def __init__(
        self,
        plan: Plan[T],
        loop: Loop,
        limits: RunLimits,
        on_event: Callable[[Event], None],
        on_samples: Callable[[list[Sample]], None],
        stop: Callable[[], Reason | None],
        start_work: Callable[[Work[Any]], None],
        note_session: Callable[[int], None],
        on_home: Callable[[LoopState], None],
    ) -> None:
        self._plan, self._loop, self._limits = plan, loop, limits
        self._on_event, self._on_samples, self._on_home = on_event, on_samples, on_home
        self._stop, self._start_work, self._note_session = stop, start_work, note_session
        self._result: RunResult[T] = RunResult()
        self._samples: list[Sample] = []
        self._home: LoopState | None = None
        self._guard: Guard | None = None
        self._stage, self._since, self._now = "", 0.0, 0.0

    def to_the_end(self) -> RunResult[T]:
        self._until_something_ends_it()
        self._enter("")
        self._doubt_pv()
        if self._home is not None:
            if isinstance(self._result.ended, FalsePv):
                self._hold()
            self._restore(self._home)
        self._hand_on()
        return self._result

    def _until_something_ends_it(self) -> None:
        """Steps the loop until the run ends, and notes the reason in the result; errors that are no Exception pass
        through."""
        result = self._result
        try:
            self._pump(self._begin())
        except StopIteration as end:
            result.value = end.value
        except Ended as ended:
            result.ended = ended
        except MemoryError:
            result.ended = Failed(Reason.COMPUTATION_LIMIT, f"no memory was left {self._when()}")
        except Exception as defect:
            result.ended = Failed(Reason.INTERNAL, f"{type(defect).__name__}: {defect}")
            self._on_event(Note(f"defect in stage {self._stage}: {defect!r}"))
        finally:
            self._plan.close()

    def _begin(self) -> LoopState:
        """Opens the session. From now on the loop has to be restored."""
        home = self._home = self._loop.begin(self._stop, self._note_session)
        self._on_home(home)
        if home.fail_action:
            self._on_event(Note(f"if the controller fails, the plant's I/O {home.fail_action}"))
        return home

    def _pump(self, home: LoopState) -> None:
        """Steps the loop until the plan, the guard, the loop or a stop request ends it, each by an exception."""
        guard = self._guard = Guard(self._limits, home)
        chunk = min(CHUNK, max(1, round(CHUNK_S / home.sample_time_s)))
        answer = next(self._plan)
        while True:
            commands = self._take(answer) if answer else []
            if commands:
                guard.commanded()
            sample = self._loop.step(commands)
            if not self._now:
                self._since = sample.t - home.sample_time_s
            self._now = sample.t
            self._samples.append(sample)
            if len(self._samples) >= chunk:
                self._hand_on()
            guard.check(sample)
            reason = self._stop()
            if reason is not None:
                raise Aborted(reason, self._when())
            answer = self._plan.send(sample)

    def _take(self, answer: Sequence[Command | Event | Work[Any]]) -> list[Command]:
        """Starts the computation and passes on the events of the plan's answer; returns its commands for the next
        step."""
        commands: list[Command] = []
        for item in answer:
            if isinstance(item, SetMode | SetGains | SetSetpoint | SetOutput | SetRelay | SetPvLimits):
                commands.append(item)
            elif isinstance(item, Work):
                self._start_work(item)
            else:
                if isinstance(item, StageStarted):
                    self._enter(item.stage)
                elif isinstance(item, StageDone):
                    self._hand_on()  # a finished stage never runs again, so its samples are passed on first
                self._on_event(item)
        return commands

    def _enter(self, stage: str) -> None:
        """Enters a stage and adds up the plant time of the previous one.

        stage: "" where no stage follows.
        """
        if self._stage:
            times = self._result.plant_time_s
            times[self._stage] = times.get(self._stage, 0.0) + self._now - self._since
        self._stage, self._since = stage, self._now

    def _hand_on(self) -> None:
        if self._samples:
            self._on_samples(self._samples)
            self._samples = []

    def _when(self) -> str:
        return f"at {self._now:.3f} s of plant time, in stage {self._stage or 'start'}"

    def _doubt_pv(self) -> None:
        """A test that ends without a result may have ended so by a PV that is false: the loop is not given back to
        automatic on it. Where others have changed the loop, or it is not reached, it ends as that."""
        ended = self._result.ended
        others = isinstance(ended, Aborted) and ended.reason not in (Reason.OPERATOR, Reason.SERVICE_STOPPED)
        if self._guard is None or ended is None or others or ended.reason in _UNREACHED or isinstance(ended, FalsePv):
            return
        try:
            self._look_on(self._guard)
            self._guard.check_end()
        except FalsePv as false:
            self._result.ended = FalsePv(false.reason, f"{false.detail} (without that: {ended})")
        except Exception as defect:  # the loop is restored all the same
            self._on_event(Note(f"whether PV is false was not found out, by a defect: {defect!r}"))

    def _look_on(self, guard: Guard) -> None:
        """Looks at a few more samples with MV as it was before the test, where PV has just jumped: whether it stays.
        Raises FalsePv."""
        commands: list[Command] = [SetMode(Mode.MANUAL), SetOutput(self._home.mv)] if self._home is not None else []
        looks, until = guard.undecided, self._now + self._limits.max_frozen_s  # longer than any dead time
        while looks and self._now <= until:
            try:
                sample = self._loop.step(commands)
            except Ended as ended:
                self._on_event(Note(f"PV could not be looked at any longer: {ended}"))
                return
            self._samples.append(sample)
            self._now = sample.t
            commands, looks = [], guard.look_on(sample)

    def _hold(self) -> None:
        """Holds the loop at the MV before the test: no control law may answer a false PV."""
        self._on_event(Note(f"PV is false: {self._result.ended.detail if self._result.ended else ''}"))
        try:
            self._loop.hold()
        except Ended as ended:
            self._on_event(Note(f"the loop could not be held: {ended.detail}"))
        except Exception as defect:  # it is restored all the same
            self._on_event(Note(f"the loop could not be held, by a defect: {defect!r}"))

    def _restore(self, home: LoopState) -> None:
        """Restores the loop. A loop whose restoration is not confirmed leaves no proposal."""
        result = self._result
        try:
            restored = self._loop.restore(home)
        except Ended as ended:
            self._on_event(Note(f"restore: {ended}"))
            lost = result.ended is not None and result.ended.reason in _UNREACHED
            if not lost and not isinstance(result.ended, FalsePv):
                result.value, result.ended = None, ended
        else:
            result.restored = restored.state
            if isinstance(result.ended, FalsePv):
                self._on_event(Note(after_false_pv(restored.state)))
            if restored.changed:
                self._on_event(Note(f"not as before the test, and left so: {'; '.join(restored.changed.values())}"))
