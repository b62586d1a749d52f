"""A loop, a way of tuning it and a service around them, without a bus, a plant or waiting."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from sqlalchemy.exc import OperationalError

from loopwright.service.execution.procedures import Hooks, Outcome, Rehearse
from loopwright.service.inputs.config import LoopConfig, parse_site
from loopwright.service.inputs.request import FastRetune, RetuneRequest
from loopwright.service.jobs.manager import Jobs
from loopwright.service.loops.loop import Loop, Restored
from loopwright.service.results import (
    FiveStageResult,
    GainsView,
    ModelView,
    PredictedView,
    StepView,
    UltimateView,
)
from loopwright.service.server.assembly import make_jobs
from loopwright.service.states.job_state import ACTIVE, JobState
from loopwright.service.states.loop_state import OPERATIONAL, LoopState, differences, same_gains
from loopwright.service.store.database import FILE
from loopwright.service.store.journal_writes import block_of
from loopwright.service.store.store import Store
from loopwright.tuning.analysis.comparison import Predicted
from loopwright.tuning.experiments.step_test import StepResult
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Command, Mode, Note, Sample, SetGains, SetSetpoint, StageDone, StageStarted
from loopwright.tuning.reasons import Aborted, Ended, Failed, FalsePv, Reason, Refused
from tests.unit.service.processes import PATIENCE_S, until

OLD, NEW = Gains(0.5, 2.0), Gains(0.75, 3.0)
TAG = "TIC-101"


def loop_entry(**changes: Any) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "tag": TAG, "bus": "virtual:test", "controller_node": 32, "plant_node": 16, "pv_unit": "degC",
        "pv_limits": {"low": 0.0, "high": 100.0}, "t95_s": 9.0, "sp_deviation": 2.0,
    }  # fmt: skip
    return {**entry, **changes}


class FakeController:
    """What survives of a loop between two openings of it. hands: what another's hand has moved since the opening."""

    def __init__(self) -> None:
        self.state = LoopState(Mode.AUTOMATIC, 50.0, 50.0, 40.0, OLD, False, 0.0, 100.0, 0.1, True)
        self.absent: Reason | None = None
        self.open = 0
        self.home = self.state
        self.session = 0
        self.session_last = 0
        self.hands: set[str] = set()
        self.held = False

    def answer(self) -> LoopState:
        if self.absent:
            raise Failed(self.absent, "node 32 does not answer")
        return self.state

    def begin_session(self, number: int) -> None:
        self.home, self.session, self.session_last, self.hands = self.state, number, number, set()
        self.held = False

    def hold(self) -> None:
        """The order HOLD."""
        if not self.session:
            raise Failed(Reason.SESSION_ENDED_BY_DEVICE, "the controller ended the test by itself")
        self.home, self.held = replace(self.home, mode=Mode.MANUAL, manual_output=self.home.mv), True
        self.state = self.home

    def end_session(self) -> None:
        """As the controller does by itself, whatever ended it."""
        if self.session:
            moved = {name: getattr(self.state, name) for name in ("mode", "sp") if _WORD[name] in self.hands}
            self.state, self.session = replace(self.home, **moved), 0

    def by_hand(self, **moved: Any) -> None:
        """An operator moves it: that ends a session at once."""
        self.state = replace(self.state, **moved)
        self.hands |= {_WORD[name] for name in moved}
        self.end_session()


_WORD = {"mode": "mode", "sp": "set-point", "gains": "gains", "manual_output": "output", "on_trial": "trial"}


class FakeLoop:
    def __init__(self, controller: FakeController) -> None:
        self._controller = controller
        controller.open += 1
        self._n = 0
        self._number = 0

    waits = False

    def read(self, beside_tests: bool = False) -> LoopState:
        return self._controller.answer()

    def begin(
        self,
        stop: Callable[[], Reason | None] = lambda: None,
        note_session: Callable[[int], None] = lambda session: None,
    ) -> LoopState:
        self._operational(self.read())
        number = self._controller.session_last + 1
        note_session(number)
        self._number = number
        self._controller.begin_session(number)
        return self._controller.home

    def step(self, commands: Sequence[Command]) -> Sample:
        self.read()
        if not self._controller.session:
            raise Failed(Reason.SESSION_ENDED_BY_DEVICE, "the controller ended the test by itself")
        for command in commands:
            if isinstance(command, SetSetpoint):
                self._controller.state = replace(self._controller.state, sp=command.value)
            elif isinstance(command, SetGains):
                self._controller.state = replace(self._controller.state, gains=command.gains, on_trial=True)
        self._n += 1
        state = self._controller.state
        return Sample(0.1 * self._n, state.sp, state.pv, state.mv, int(state.mode))

    def hold(self) -> None:
        self._controller.hold()

    def restore(self, home: LoopState, session: int | None = None) -> Restored:
        controller, number = self._controller, self._number if session is None else session
        self._operational(self.read())
        if number and controller.session == number:
            controller.end_session()
            how = "the session was closed"
        elif number and controller.session_last == number:
            how = "the controller had ended the session"
        else:
            found = differences(controller.state, home)
            return Restored(controller.state, "no session was opened" if not number else "nothing is known", found)
        found = differences(controller.state, controller.home)
        if found.keys() - controller.hands:
            raise Failed(Reason.RESTORE_UNCONFIRMED, "; ".join(found.values()))
        return Restored(controller.state, how, found, held=controller.held)

    @staticmethod
    def _operational(state: LoopState) -> None:
        if state.node_state != OPERATIONAL:
            raise Failed(Reason.NODE_NOT_OPERATIONAL, f"{state.node_state}: nothing controls, MV stays where it is")

    def accept(self, gains: Gains, instead_of: Gains) -> LoopState:
        held = self.read().gains
        if not same_gains(held, instead_of) and not same_gains(held, gains):
            raise Refused(Reason.GAINS_CHANGED, f"the controller holds {held}: the gains were changed meanwhile")
        self._controller.state = replace(self._controller.state, gains=gains)
        return self._controller.state

    def close(self) -> None:
        self._controller.open -= 1


@contextmanager
def held_acceptances() -> Iterator[tuple[threading.Event, threading.Event]]:
    """Acceptances wait in the controller. Yields what is set as one is there, and what is to be set to let it go on."""
    inside, free = threading.Event(), threading.Event()
    accept = FakeLoop.accept

    def slow(loop: FakeLoop, gains: Gains, instead_of: Gains) -> LoopState:
        inside.set()
        assert free.wait(20)
        return accept(loop, gains, instead_of)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FakeLoop, "accept", slow)
        yield inside, free


@dataclass(frozen=True)
class Found:
    Ku: float
    Pu_s: float


RESULT = FiveStageResult(
    method="five-stage",
    ultimate=UltimateView(Ku=2.05, Pu_s=3.32),
    model=ModelView(K=2.0, T_s=3.0, L_s=1.0),
    previous_gains=GainsView.of(OLD),
    new_gains=GainsView.of(NEW),
    predicted=PredictedView.model_validate(asdict(Predicted(1.6, 3.0, 60.0, 4.0, 8.0, 2.0))),
    step_before=StepView.model_validate(asdict(StepResult(2.0, 40.0, 9.0, 20.0, 2.0, 3.0, 0.0, True, 30.0))),
    step_after=StepView.model_validate(asdict(StepResult(2.0, 5.0, 4.0, 9.0, 2.0, 2.0, 0.0, True, 30.0))),
    notes=["all quiet"],
)


class FakeTune:
    """Two stages of 10 samples; `hold` keeps it in the first one until released, as a long experiment would."""

    def __init__(self) -> None:
        self.hold = threading.Event()
        self.hold.set()
        self.inside = threading.Event()
        self.ends: Exception | None = None

    def __call__(
        self, config: LoopConfig, request: RetuneRequest, loop: Loop, state: LoopState, hooks: Hooks
    ) -> Outcome:
        ended: Ended | None = None
        restored: LoopState | None = None
        times: dict[str, float] = {}
        done = {event.data["stage"] for event in hooks.earlier if event.kind == "stage_done"}
        try:
            hooks.on_home(loop.begin(hooks.stop, hooks.note_session))
        except Ended as error:
            return Outcome(None, error, None, {})
        try:
            for stage, remaining in (("preflight", 3.0), ("relay", 1.0)):
                if stage in done:
                    continue
                hooks.on_event(StageStarted(stage, 1.0, remaining))
                samples = [loop.step((SetGains(NEW),) if n == 0 else ()) for n in range(10)]
                hooks.on_samples(samples)
                self.inside.set()
                while not self.hold.wait(0.005):
                    loop.step(())
                    if reason := hooks.stop():
                        raise Aborted(reason, "asked to stop")
                hooks.on_event(StageDone(stage, Found(2.05, 3.32)))
                times[stage] = 1.0
            hooks.on_event(Note("nearly there"))
            if self.ends:
                raise self.ends
        except Ended as error:
            ended = error
        try:
            if isinstance(ended, FalsePv):
                loop.hold()
            restored = loop.restore(state).state
        except Ended as error:
            ended = error
        return Outcome(None if ended else RESULT, ended, restored, times)


def fake_rehearse(config: LoopConfig, request: RetuneRequest, hooks: Hooks) -> Outcome:
    hooks.on_event(StageStarted("preflight", 1.0, 0.0))
    hooks.on_event(StageDone("preflight", Found(2.05, 3.32)))
    return Outcome(RESULT, None, None, {"preflight": 1.0})


def add_samples(store: Store, job_id: str, stage: str, samples: Sequence[Sample]) -> None:
    with store.writing() as session:
        block_of(job_id, stage, samples)(session)


class ThreadEngine:
    """Starts every job at once in a thread, and forgets everything with the process."""

    def __init__(self) -> None:
        self._run: Callable[[str], None] | None = None
        self._threads: dict[str, threading.Thread] = {}
        self.enqueued: list[tuple[str, str]] = []

    def launch(self, run: Callable[[str], None], queues: Mapping[str, int]) -> None:
        self._run = run

    def enqueue(self, job_id: str, queue: str) -> None:
        assert self._run is not None
        self.enqueued.append((job_id, queue))
        thread = self._threads[job_id] = threading.Thread(target=self._run, args=(job_id,))
        thread.start()

    def join(self, timeout_s: float, job_id: str | None = None) -> None:
        """Waits for the end of this job, or of each one's that there is now."""
        for thread in list(self._threads.values()) if job_id is None else [self._threads[job_id]]:
            thread.join(timeout_s)

    def known(self, job_ids: Collection[str]) -> set[str]:
        return {job_id for job_id in job_ids if job_id in self._threads and self._threads[job_id].is_alive()}

    def over(self, limit: int) -> list[str]:
        return [job_id for job_id, thread in self._threads.items() if not thread.is_alive()][:limit]

    def forget(self, job_ids: Collection[str]) -> None:
        for job_id in job_ids:
            self._threads.pop(job_id, None)

    def alive(self) -> bool:
        return self._run is not None

    def close(self) -> None:
        self._run = None


@cache
def _made_tables() -> bytes:
    """The file of a new store, as its migrations make it: once for all tests of this process."""
    with TemporaryDirectory() as folder:
        Store(Path(folder)).close()
        return (Path(folder) / FILE).read_bytes()


def store_in(folder: Path) -> Store:
    """The store in a folder; a new one does not go through all migrations again."""
    if not (folder / FILE).exists():
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        (folder / FILE).write_bytes(_made_tables())
    return Store(folder)


def away(*_: object, **__: object) -> Any:
    """In the place of what reads or writes the database: it is locked, or its server is gone."""
    raise OperationalError("SELECT", {}, Exception("server closed the connection"))


class Service:
    """Everything of a service that a test wants to put a hand on."""

    def __init__(self, folder: Path, **options: Any) -> None:
        self.controller = FakeController()
        self.tune = FakeTune()
        self.store = store_in(folder)
        self.loops = parse_site({"loops": [loop_entry(), loop_entry(tag="FIC-2", channel=2)]}, "test").loops
        self.jobs = self.more_jobs(lambda config: FakeLoop(self.controller), **options)

    def more_jobs(
        self, open_loop: Callable[[LoopConfig], Loop], rehearse: Rehearse = fake_rehearse, **options: Any
    ) -> Jobs:
        """Jobs on the same store, started."""
        settings = {"engine": ThreadEngine()} | options
        jobs = make_jobs(self.loops, self.store, open_loop, self.tune, rehearse, **settings)
        jobs.boot()
        return jobs

    def under_test(self) -> str:
        """The id of a job whose loop is under test, until `tune.hold` is set."""
        self.tune.hold.clear()
        job_id = self.jobs.start(TAG, FastRetune()).id
        assert self.tune.inside.wait(PATIENCE_S)
        return job_id

    def wait(self, job_id: str) -> None:
        """Until the job is over."""
        until(lambda: JobState(self.store.get(job_id).state) not in ACTIVE, f"the end of job {job_id}")

    def close(self) -> None:
        self.tune.hold.set()
        self.jobs.stop()
        self.store.close()
