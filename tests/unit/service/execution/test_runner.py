"""The runner on a rehearsed loop: each way out ends with its reason, and the loop as it was."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import pytest

from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant
from loopwright.service.execution.guard import Guard, RunLimits
from loopwright.service.execution.rehearsal import RehearsedLoop
from loopwright.service.execution.runner import RunResult, run
from loopwright.service.loops.loop import Restored
from loopwright.service.states.loop_state import LoopState, differences
from loopwright.tuning.gains import Gains
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
    SetRelay,
    SetSetpoint,
    StageDone,
    StageStarted,
    Work,
    worked,
)
from loopwright.tuning.reasons import Aborted, Failed, FalsePv, Reason, Refused

TS = 0.1
OLD = Gains(Kp=0.15, Ti=5.0)


class Meddled(RehearsedLoop):
    """A rehearsed loop in which something happens at a given sample."""

    def __init__(self, at: int = 10**9, change: Callable[[Sample], Sample] = lambda s: s) -> None:
        settings = Settings(mv_low=-1.0, mv_high=1.0, safe_output=0.0, pv_low=-10.0, pv_high=10.0)
        parameters = Parameters(OLD.Kp, OLD.Ti, 0.0, 0.0, 1.0, 0.0)
        self.channel = Channel(TS, settings, parameters, 0.0, int(Mode.AUTOMATIC), 0.0)
        super().__init__(LinearPlant([2.0], [5.0, 1.0], 1.0, TS), self.channel, TS)
        self._at, self._change, self._count = at, change, 0

    def step(self, commands: Sequence[Command]) -> Sample:
        sample = super().step(commands)
        self._count += 1
        return self._change(sample) if self._count >= self._at else sample


def trial(seconds: float = 60.0) -> Plan[str]:
    """Leaves everything changed: gains, mode, set-point, output."""
    sample = yield (StageStarted("trial", seconds, 0.0), SetGains(Gains(Kp=0.5, Ti=3.0)), SetSetpoint(0.3))
    start = sample.t
    while sample.t - start < seconds / 2:
        sample = yield ()
    sample = yield (SetMode(Mode.MANUAL), SetOutput(0.1))
    while sample.t - start < seconds:
        sample = yield ()
    return "done"


def relay() -> Plan[None]:
    yield (SetRelay(0.5, 0.0, 0.0), SetMode(Mode.EXPERIMENT))
    while True:
        yield ()


def assert_home(loop: Meddled, result: RunResult[Any]) -> None:
    state = loop.read()
    assert result.restored == state
    assert (state.mode, state.sp, state.gains, state.on_trial) == (Mode.AUTOMATIC, 0.0, OLD, False)


def test_success_gives_the_value_and_the_stage_times() -> None:
    loop = Meddled()
    result = run(trial(), loop, limits=RunLimits())
    assert (result.value, result.ended) == ("done", None)
    assert result.plant_time_s == {"trial": pytest.approx(60.0, abs=3 * TS)}
    assert_home(loop, result)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda s: s._replace(pv=math.nan), Reason.BAD_SAMPLE),
        (lambda s: s._replace(mv=math.inf), Reason.BAD_SAMPLE),
        (lambda s: s._replace(t=s.t + 1.0), Reason.SAMPLES_LOST),
        (lambda s: s._replace(pv=s.pv + 2.0 * (s.t - 9.8)), Reason.PV_LIMIT),
    ],
)
@pytest.mark.parametrize("plan", [trial, relay])
def test_a_bad_sample_ends_the_run(
    change: Callable[[Sample], Sample], reason: Reason, plan: Callable[[], Plan[Any]]
) -> None:
    loop = Meddled(100, change)
    result = run(plan(), loop, limits=RunLimits(pv_low=-4.0, pv_high=4.0))
    assert result.ended is not None
    assert result.ended.reason is reason
    assert_home(loop, result)


class Pressed(Meddled):
    """The controller sees another's hand at that sample, ends the test by itself, and says so."""

    def __init__(self, at: int, mode: Mode) -> None:
        super().__init__()
        self._pressed_at, self._mode = at, mode

    def step(self, commands: Sequence[Command]) -> Sample:
        sample = super().step(commands)
        if self._count == self._pressed_at:
            self.channel.go_home(self._home)
            self.channel.command_mode(int(self._mode))
            raise Aborted(Reason.MODE_CHANGED, "another hand on the loop: mode")
        return sample

    def restore(self, home: LoopState, session: int | None = None) -> Restored:
        state = self.read()
        return Restored(state, "the controller had ended the session", differences(state, home))


@pytest.mark.parametrize("plan", [trial, relay])
@pytest.mark.parametrize("mode", [Mode.OFF, Mode.MANUAL])
def test_the_mode_that_somebody_else_chose_stays(mode: Mode, plan: Callable[[], Plan[Any]]) -> None:
    notes: list[str] = []
    loop = Pressed(100, mode)
    result = run(
        plan(), loop, limits=RunLimits(), on_event=lambda e: notes.append(e.text) if isinstance(e, Note) else None
    )
    assert result.ended is not None
    assert result.ended.reason is Reason.MODE_CHANGED
    state = loop.read()
    assert result.restored == state
    assert (state.mode, state.sp, state.gains, state.on_trial) == (mode, 0.0, OLD, False)
    assert notes == [f"not as before the test, and left so: mode is {mode.name.lower()}, was automatic"]


def test_what_is_opened_and_what_must_come_back_is_told() -> None:
    told: list[Any] = []

    class Numbered(Meddled):
        def begin(
            self,
            stop: Callable[[], Reason | None] = lambda: None,
            note_session: Callable[[int], None] = lambda session: None,
        ) -> LoopState:
            note_session(7)
            return replace(super().begin(), fail_action="holds MV where it is")

    loop = Numbered()
    home = loop.read()
    run(
        trial(), loop, limits=RunLimits(), note_session=told.append, on_home=told.append,
        on_event=lambda e: told.append(e.text) if isinstance(e, Note) else None,
    )  # fmt: skip
    silent = "if the controller fails, the plant's I/O holds MV where it is"
    assert told == [7, replace(home, fail_action="holds MV where it is"), silent]


def test_a_stop_ends_the_wait_for_the_loop() -> None:
    class Busy(Meddled):
        def begin(
            self,
            stop: Callable[[], Reason | None] = lambda: None,
            note_session: Callable[[int], None] = lambda session: None,
        ) -> LoopState:
            assert stop() is Reason.OPERATOR
            raise Aborted(Reason.OPERATOR, "while another tuner held the loop")

    result = run(trial(), Busy(), limits=RunLimits(), stop=lambda: Reason.OPERATOR)
    assert result.ended is not None and result.restored is None
    assert (result.ended.reason, result.value) == (Reason.OPERATOR, None)


def test_mv_beyond_what_the_job_permits_ends_the_run() -> None:
    result = run(trial(), loop := Meddled(), limits=RunLimits(mv_low=-0.05, mv_high=0.08))
    assert result.ended is not None
    assert result.ended.reason is Reason.MV_LIMIT
    assert_home(loop, result)


def test_mv_is_not_judged_before_the_plan_has_commanded_anything() -> None:
    def listen() -> Plan[str]:
        yield ()
        return "heard"

    assert run(listen(), Meddled(), limits=RunLimits(mv_low=0.5, mv_high=0.6)).value == "heard"


class TestWorkBesideTheSamples:
    """A live loop is pumped and guarded while something long is computed."""

    @staticmethod
    def beside(work: Work[Any]) -> None:
        threading.Thread(target=work.run, daemon=True).start()

    def test_samples_go_on_until_it_is_done(self) -> None:
        enough = threading.Event()
        seen: list[Sample] = []

        def heard(samples: list[Sample]) -> None:
            seen.extend(samples)
            if len(seen) >= 200:
                enough.set()

        result = run(
            worked(lambda: enough.wait(60)), Meddled(), limits=RunLimits(), on_samples=heard, start_work=self.beside
        )
        assert result.value is True

    def test_an_abort_does_not_wait_for_it(self) -> None:
        never = threading.Event()
        loop = Meddled()

        def plan() -> Plan[bool]:
            yield (SetGains(Gains(Kp=0.5, Ti=3.0)), SetSetpoint(0.3))
            return (yield from worked(lambda: never.wait(30)))

        asked = iter([None] * 50)
        result = run(
            plan(), loop, limits=RunLimits(), stop=lambda: next(asked, Reason.OPERATOR), start_work=self.beside
        )
        assert result.ended is not None
        assert result.ended.reason is Reason.OPERATOR
        assert_home(loop, result)
        never.set()

    @pytest.mark.parametrize(
        ("error", "reason"),
        [(Refused(Reason.NOT_ROBUST, "Ms 3"), Reason.NOT_ROBUST), (ZeroDivisionError("0"), Reason.INTERNAL)],
    )
    def test_what_it_raises_ends_the_run(self, error: Exception, reason: Reason) -> None:
        def fail() -> None:
            raise error

        result = run(worked(fail), loop := Meddled(), limits=RunLimits(), start_work=self.beside)
        assert result.ended is not None
        assert result.ended.reason is reason
        assert_home(loop, result)


def test_the_samples_of_a_stage_are_told_before_its_end() -> None:
    """What is done never runs again: a service that dies just after must not take its samples along."""

    def two_stages() -> Plan[None]:
        for stage, samples in (("one", 47), ("two", 23)):
            yield (StageStarted(stage, 1.0, 0.0),)
            for _ in range(samples - 1):
                yield ()
            yield (StageDone(stage, None),)

    told: list[float] = []
    at_end: list[int] = []

    def on_event(event: Event) -> None:
        if isinstance(event, StageDone):
            at_end.append(len(told))

    run(
        two_stages(), Meddled(), limits=RunLimits(), on_event=on_event, on_samples=lambda s: told.extend(e.t for e in s)
    )
    # The end of a stage is told with the sample that it was found at; the next one belongs to the next stage.
    assert at_end == [47, 47 + 1 + 23]
    assert told == pytest.approx([TS * n for n in range(len(told))]) and len(told) == at_end[1] + 1


def test_a_frozen_pv_is_noticed_once_mv_has_moved_and_the_loop_is_held() -> None:
    notes: list[str] = []
    loop = Meddled(0, lambda s: s._replace(pv=0.0))
    result = run(
        trial(), loop, limits=RunLimits(max_frozen_s=10.0),
        on_event=lambda e: notes.append(e.text) if isinstance(e, Note) else None,
    )  # fmt: skip
    assert isinstance(result.ended, FalsePv)
    assert result.ended.reason is Reason.PV_FROZEN
    state = loop.read()
    assert result.restored == state
    assert (state.mode, state.manual_output, state.sp) == (Mode.MANUAL, 0.0, 0.0)
    assert (state.gains, state.on_trial) == (OLD, False)
    assert ["PV is false: PV" in notes[0], "in manual at MV 0" in notes[1]] == [True, True], notes


def test_a_defect_in_the_way_to_HOLD_keeps_no_loop_from_being_restored() -> None:
    class Defective(Meddled):
        def hold(self) -> None:
            raise ValueError("no")

    def plan() -> Plan[None]:
        yield ()
        raise FalsePv(Reason.BAD_SAMPLE, "PV went from 1 to 2")

    notes: list[str] = []
    result = run(
        plan(), Defective(), limits=RunLimits(),
        on_event=lambda e: notes.append(e.text) if isinstance(e, Note) else None,
    )  # fmt: skip
    assert isinstance(result.ended, FalsePv) and result.restored is not None
    assert "could not be held, by a defect: ValueError('no')" in notes[1]


@pytest.mark.parametrize(("wrong", "kind", "reason"), [(2, Failed, "pv_limit"), (10**9, FalsePv, "bad_sample")])
def test_a_pv_that_jumps_beyond_its_limits_is_looked_at_until_it_is_known_to_stay(
    wrong: int, kind: type[Failed], reason: str
) -> None:
    left = [wrong]

    def jumped(s: Sample) -> Sample:
        left[0] -= 1
        return s._replace(pv=-5.0) if left[0] >= 0 else s

    loop = Meddled(100, jumped)
    result = run(trial(), loop, limits=RunLimits(pv_low=-4.0, pv_high=4.0))
    assert (type(result.ended), result.ended and result.ended.reason.value) == (kind, reason)
    assert loop.read().mode is (Mode.MANUAL if kind is FalsePv else Mode.AUTOMATIC)


def test_a_defect_in_the_doubt_of_pv_keeps_no_loop_from_being_restored(monkeypatch: pytest.MonkeyPatch) -> None:
    def defective(_guard: Guard) -> None:
        raise ZeroDivisionError

    def plan() -> Plan[None]:
        yield ()
        raise Refused(Reason.NO_RESPONSE, "PV did not move")

    monkeypatch.setattr(Guard, "check_end", defective)
    result = run(plan(), Meddled(), limits=RunLimits())
    assert result.ended is not None and result.ended.reason is Reason.NO_RESPONSE and result.restored is not None


def test_a_refusal_on_a_pv_that_never_answered_leaves_the_loop_held() -> None:
    """A PV without noise that is as before the test, whatever MV does: the sensor may have ended."""

    def waits() -> Plan[None]:
        for _ in range(60):
            yield ()
        yield (SetRelay(0.5, 0.0, 0.0), SetMode(Mode.EXPERIMENT))
        for _ in range(200):
            yield ()
        raise Refused(Reason.NO_RESPONSE, "PV did not move")

    loop = Meddled(0, lambda s: s._replace(pv=0.0))
    result = run(waits(), loop, limits=RunLimits())
    assert isinstance(result.ended, FalsePv) and result.ended.reason is Reason.PV_FROZEN
    assert "without that: no_response" in result.ended.detail
    assert loop.read().mode is Mode.MANUAL


def test_a_false_pv_stays_the_reason_where_the_loop_cannot_be_held_or_read_back() -> None:
    class Away(Meddled):
        def hold(self) -> None:
            raise Failed(Reason.NODE_LOST, "node 20h does not answer")

        def restore(self, home: LoopState, session: int | None = None) -> Restored:
            raise Failed(Reason.RESTORE_UNCONFIRMED, "node 20h does not answer")

    def plan() -> Plan[None]:
        yield ()
        raise FalsePv(Reason.BAD_SAMPLE, "PV went from 1 to 2")

    notes: list[str] = []
    result = run(
        plan(), Away(), limits=RunLimits(), on_event=lambda e: notes.append(e.text) if isinstance(e, Note) else None
    )
    assert isinstance(result.ended, FalsePv) and result.restored is None
    assert notes[1:] == [
        "the loop could not be held: node 20h does not answer", "restore: restore_unconfirmed: node 20h does not answer"
    ]  # fmt: skip


def test_the_time_budget_ends_the_run() -> None:
    result = run(trial(), loop := Meddled(), limits=RunLimits(max_time_s=20.0))
    assert result.ended is not None
    assert result.ended.reason is Reason.TIME_BUDGET
    assert_home(loop, result)


def test_the_operator_ends_the_run_at_the_next_sample() -> None:
    asked = iter([None] * 50)
    result = run(trial(), loop := Meddled(), limits=RunLimits(), stop=lambda: next(asked, Reason.OPERATOR))
    assert result.ended is not None
    assert result.ended.reason is Reason.OPERATOR
    assert_home(loop, result)


@pytest.mark.parametrize("error", [Refused(Reason.NOT_ROBUST, "Ms 3"), Failed(Reason.NODE_LOST, "node 20h")])
def test_what_a_plan_or_loop_raises_ends_the_run(error: Exception) -> None:
    def plan() -> Plan[None]:
        yield (SetSetpoint(0.2),)
        raise error

    result = run(plan(), loop := Meddled(), limits=RunLimits())
    assert result.ended is error
    assert_home(loop, result)


def test_a_defect_in_a_plan_is_told_as_one_and_the_loop_is_restored() -> None:
    def plan() -> Plan[float]:
        yield (SetSetpoint(0.2),)
        return 1 / 0

    result = run(plan(), loop := Meddled(), limits=RunLimits())
    assert result.ended is not None
    assert (result.ended.reason, "ZeroDivisionError" in result.ended.detail) == (Reason.INTERNAL, True)
    assert_home(loop, result)


def test_a_result_without_a_confirmed_restore_is_no_result() -> None:
    class Unrestorable(Meddled):
        def restore(self, home: LoopState, session: int | None = None) -> Restored:
            raise Failed(Reason.RESTORE_UNCONFIRMED, "mode reads manual")

    result = run(trial(), Unrestorable(), limits=RunLimits())
    assert result.value is None
    assert result.ended is not None
    assert result.ended.reason is Reason.RESTORE_UNCONFIRMED
