"""Jobs against a plain model of them: any order of submit, begin, end, abort, accept, roll back, crash and restart.

The model is a table of what each wish does, written from docs/safety.md and the README; it shares no code with the
service. The examples are the same at every run; how often each rule was tried, and how it ended, is told at its end.
"""

from __future__ import annotations

import shutil
import tempfile
import threading
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, seed, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule, run_state_machine_as_test

from loopwright.service.errors import Conflict, Locked
from loopwright.service.execution.procedures import Hooks, Outcome
from loopwright.service.inputs.config import LoopConfig, parse_site
from loopwright.service.inputs.request import RetuneRequest, retune_request
from loopwright.service.loops.loop import Loop
from loopwright.service.results import FiveStageResult, GainsView
from loopwright.service.server.assembly import make_jobs
from loopwright.service.states.job_state import IllegalMove
from loopwright.service.states.loop_state import LoopState
from loopwright.service.store import database
from loopwright.service.store.database import FILE
from loopwright.service.store.store import Busy, Store
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import SetGains, StageStarted
from loopwright.tuning.reasons import Aborted, Ended, Failed, NoGain, Reason, Refused
from tests.unit.service.fakes import OLD, RESULT, FakeController, FakeLoop, loop_entry

TAGS = ("TIC-101", "FIC-2")
ENTRIES = [loop_entry(tag=tag, channel=n + 1) for n, tag in enumerate(TAGS)]
ENDS: dict[str, Ended | None] = {
    "proposed": None,
    "refused": Refused(Reason.NOT_AT_REST, "drifts"),
    "failed": Failed(Reason.NODE_LOST, "silent"),
    "aborted": Aborted(Reason.MODE_CHANGED, "manual"),
    "no_gain": NoGain(Reason.NO_GAIN, "as good as asked"),
}
MAX_ATTEMPTS = 10
WHICH = st.integers(0, 15)
OPTIONS: tuple[dict[str, Any], ...] = (
    {},
    {"Ms": 1.4, "derivative": True, "aim": "no_overshoot", "amplitude_pct": 10.0, "min_switches": 6, "verify": False},
    {"settling_s": 300.0, "mv_peak": 4.0, "noise_gain": 2.0},
    {"start": "design", "model": {"num": [1.0], "den": [3.0, 1.0], "dead_time_s": 1.0}},
    {"method": "five-stage", "overshoot_window_pct": (8.0, 50.0), "baseline": False},
    {"method": "simc", "method_options": {"tau_c_s": 2.0}},
)
"""A job is read back from its row after a crash: with the options of its method alone."""
RULES = {
    "submit: queued", "submit: busy", "begin: running", "begin: again", "end: proposed", "end: refused", "end: failed",
    "end: aborted", "end: no_gain", "end: rehearsed",
    "abort: aborted", "abort: illegal", "accept: accepted", "accept: illegal", "accept: conflict",
    "accept: busy", "rollback: rolled_back", "rollback: illegal", "rollback: conflict", "rollback: busy",
    "crash: on trial", "crash: gone back", "restart: done", "by hand: done", "submit: locked", "begin: locked",
    "accept: locked", "rollback: locked", "lock: done", "lock: a test runs", "unlock: done",
}  # fmt: skip

SEEDS = (1, 5, *range(10, 20))
"""The seeds of the rounds, which end when every outcome was seen. The first two see all of them; threads, too, decide
what happens, and a rare outcome may want a further round."""


class Killed(BaseException):
    """The process is gone: nothing is restored, nothing is written."""


@dataclass
class Act:
    """An experiment that is under way, and what becomes of it."""

    new: Gains
    inside: threading.Event = field(default_factory=threading.Event)
    told: threading.Event = field(default_factory=threading.Event)
    end: Ended | None = None
    killed: bool = False

    def play(self, hooks: Hooks) -> tuple[FiveStageResult | None, Ended | None]:
        ended = None
        hooks.on_event(StageStarted("relay", 1.0, 1.0))
        self.inside.set()
        while not self.told.wait(0.001):
            if reason := hooks.stop():
                return None, Aborted(reason, "asked to stop")
        if self.killed:
            raise Killed
        ended = self.end
        return (None, ended) if ended else (RESULT.model_copy(update={"new_gains": GainsView.of(self.new)}), None)


class HandEngine:
    """Begins a job when the test says so."""

    def __init__(self) -> None:
        self.queued: list[str] = []
        self.threads: dict[str, threading.Thread] = {}
        self._run: Callable[[str], None] | None = None

    def launch(self, run: Callable[[str], None], queues: Mapping[str, int]) -> None:
        self._run = run

    def enqueue(self, job_id: str, queue: str) -> None:
        self.queued.append(job_id)

    def begin(self, job_id: str) -> None:
        self.queued.remove(job_id)
        thread = self.threads[job_id] = threading.Thread(target=self._until_killed, args=(job_id,))
        thread.start()

    def _until_killed(self, job_id: str) -> None:
        assert self._run is not None
        try:
            self._run(job_id)
        except Killed:
            return

    def known(self, job_ids: Collection[str]) -> set[str]:
        return set(job_ids) & (set(self.queued) | self.threads.keys())

    def over(self, limit: int) -> list[str]:
        return []

    def forget(self, job_ids: Collection[str]) -> None:
        """There is nothing to forget."""

    def alive(self) -> bool:
        return self._run is not None

    def close(self) -> None:
        self._run = None


@dataclass
class Job:
    """What the model knows of a job."""

    id: str
    loop: str
    dry: bool
    act: Act
    state: str = "queued"
    begun: bool = False
    attempts: int = 0
    old: Gains | None = None

    @property
    def active(self) -> bool:
        return self.state in ("queued", "running")

    @property
    def waits_for_a_loop(self) -> bool:
        return self.active and not self.begun and not self.dry


class JobsMachine(RuleBasedStateMachine):
    """The service on the left, the model on the right."""

    def __init__(self, empty: Path, counts: Counter[str]) -> None:
        super().__init__()
        self.counts = counts
        self.folder = Path(tempfile.mkdtemp(prefix="machine-"))
        shutil.copy(empty, self.folder / FILE)
        self.controllers = {tag: FakeController() for tag in TAGS}
        self.acts: dict[str, Act] = {}
        self.jobs: list[Job] = []
        self.gains = dict.fromkeys(TAGS, OLD)
        self.locked: set[str] = set()
        self.boot()

    # the service
    def boot(self) -> None:
        self.store, self.engine = Store(self.folder), HandEngine()
        self.service = make_jobs(
            parse_site({"loops": ENTRIES}, "test").loops, self.store, self.open, self.tune, self.rehearse,
            engine=self.engine,
        )  # fmt: skip
        self.service.boot()

    def open(self, config: LoopConfig) -> Loop:
        return FakeLoop(self.controllers[config.tag])

    def tune(self, config: LoopConfig, request: RetuneRequest, loop: Loop, state: LoopState, hooks: Hooks) -> Outcome:
        act = self.acts[request.by]
        hooks.on_home(loop.begin(hooks.stop, hooks.note_session))
        loop.step((SetGains(act.new),))
        result, ended = act.play(hooks)
        return Outcome(result, ended, loop.restore(state).state, {})

    def rehearse(self, config: LoopConfig, request: RetuneRequest, hooks: Hooks) -> Outcome:
        result, ended = self.acts[request.by].play(hooks)
        return Outcome(result, ended, None, {})

    # helpers
    def said(self, what: str, outcome: str) -> None:
        self.counts[f"{what}: {outcome}"] += 1

    def having(self, loop: str) -> Job | None:
        """The model's active job of a loop."""
        return next((job for job in self.jobs if job.loop == loop and job.active and not job.dry), None)

    def one(self, which: int, wanted: Callable[[Job], bool]) -> Job:
        """One of the wanted jobs; now and then, or when there are none, one of all."""
        found = [job for job in self.jobs if wanted(job) and which % 4] or self.jobs
        return found[-1 - which // 4 % len(found)]

    def over(self, job: Job) -> None:
        self.engine.threads[job.id].join(60)
        assert not self.engine.threads[job.id].is_alive()

    # rules
    @rule(
        loop=st.sampled_from(TAGS), dry=st.sampled_from((False, False, False, True)), begins=st.booleans(),
        options=st.sampled_from(OPTIONS),
    )  # fmt: skip
    def submit(self, loop: str, dry: bool, begins: bool, options: dict[str, Any]) -> None:
        n = len(self.acts)
        name = f"wish {n}"
        self.acts[name] = act = Act(Gains(0.6 + 0.01 * n, 3.0))
        request = retune_request(by=name, dry_run=dry, **options)
        other = None if dry else self.having(loop)
        if loop in self.locked and not dry:
            with pytest.raises(Locked):
                self.service.start(loop, request)
            self.said("submit", "locked")
        elif other is not None:
            with pytest.raises(Busy) as busy:
                self.service.start(loop, request)
            assert busy.value.job_id == other.id
            self.said("submit", "busy")
        else:
            self.jobs.append(Job(self.service.start(loop, request).id, loop, dry, act))
            self.said("submit", "queued")
            if begins:
                self.begun(self.jobs[-1])

    @precondition(lambda self: any(job.active and not job.begun for job in self.jobs))
    @rule(which=st.integers(0, 9))
    def begin(self, which: int) -> None:
        job = next(job for job in (*self.jobs[which:], *self.jobs) if job.active and not job.begun)
        self.begun(job)

    def begun(self, job: Job) -> None:
        self.engine.begin(job.id)
        if job.loop in self.locked and not job.dry:
            self.over(job)
            job.state = "refused"
            assert self.store.get(job.id).reason == "locked"
            self.said("begin", "locked")
            return
        assert job.act.inside.wait(60)
        if job.old is None and not job.dry:
            job.old = self.gains[job.loop]
        job.attempts += 1
        self.said("begin", "running" if job.state == "queued" else "again")
        job.state, job.begun = "running", True

    @precondition(lambda self: any(job.begun for job in self.jobs))
    @rule(which=st.integers(0, 9), how=st.sampled_from((*sorted(ENDS), "proposed")))
    def end(self, which: int, how: str) -> None:
        self.ended(next(job for job in (*self.jobs[which:], *self.jobs) if job.begun), how)

    def ended(self, job: Job, how: str) -> None:
        job.act.end = ENDS[how]
        job.act.told.set()
        self.over(job)
        job.state, job.begun = "rehearsed" if job.dry and how == "proposed" else how, False
        self.said("end", job.state)

    @rule(loop=st.sampled_from(TAGS))
    def propose(self, loop: str) -> None:
        """A job from its beginning to its end, where the loop is free: decisions are what is then tried."""
        if self.having(loop) is None and loop not in self.locked:
            self.submit(loop, dry=False, begins=True, options={})
            self.ended(self.jobs[-1], "proposed")

    @precondition(lambda self: len(self.jobs) > 1)
    @rule(which=WHICH)
    def abort(self, which: int) -> None:
        job = self.one(which, lambda job: job.active)
        if not job.active:
            with pytest.raises(IllegalMove):
                self.service.abort(job.id, "me")
            self.said("abort", "illegal")
            return
        self.service.abort(job.id, "me")
        if job.begun:
            self.over(job)
        elif job.id in self.engine.queued:
            self.engine.begin(job.id)  # the engine still has it, and finds nothing to do
            self.over(job)
        job.state, job.begun = "aborted", False
        assert self.store.get(job.id).reason == "operator"
        self.said("abort", "aborted")

    def decide(self, job: Job, what: str, wish: Callable[[str, str], object], legal: tuple[str, ...]) -> bool:
        """Whether the model lets it pass to the controller; else the service refuses in the same way."""
        # To roll back what has been rolled back by hand is no conflict.
        legal_gains = {"accept": (job.old,), "rollback": (job.old, job.act.new)}[what]
        declined = what == "rollback" and job.state == "proposed"
        refusal: type[Exception] | None = None
        if job.state not in legal:
            refusal, word = IllegalMove, "illegal"
        elif self.having(job.loop):
            refusal, word = Busy, "busy"
        elif not declined and job.loop in self.locked:
            refusal, word = Locked, "locked"
        elif not declined and self.gains[job.loop] not in legal_gains:
            refusal, word = Conflict, "conflict"
        if refusal is None:
            wish(job.id, "me")
            return True
        with pytest.raises(refusal):
            wish(job.id, "me")
        self.said(what, word)
        return False

    @precondition(lambda self: self.jobs)
    @rule(which=WHICH)
    def accept(self, which: int) -> None:
        job = self.one(which, lambda job: job.state == "proposed")
        if self.decide(job, "accept", self.service.decisions.accept, ("proposed",)):
            job.state, self.gains[job.loop] = "accepted", job.act.new
            self.said("accept", "accepted")

    @precondition(lambda self: self.jobs)
    @rule(which=WHICH)
    def rollback(self, which: int) -> None:
        job = self.one(which, lambda job: job.state in ("proposed", "accepted"))
        if self.decide(job, "rollback", self.service.decisions.rollback, ("proposed", "accepted")):
            if job.state == "accepted":
                assert job.old is not None
                self.gains[job.loop] = job.old
            job.state = "rolled_back"
            self.said("rollback", "rolled_back")

    @precondition(lambda self: any(job.state in ("proposed", "accepted") for job in self.jobs[-2:]))
    @rule(loop=st.sampled_from(TAGS), kp=st.floats(1.0, 2.0))
    def by_hand(self, loop: str, kp: float) -> None:
        """An operator puts other gains into a controller that no job has."""
        if self.having(loop) is None:
            self.gains[loop] = Gains(kp, 5.0)
            self.controllers[loop].by_hand(gains=self.gains[loop])
            self.said("by hand", "done")

    @precondition(lambda self: len(self.jobs) > 2 and not self.locked)
    @rule(loop=st.sampled_from(TAGS))
    def lock(self, loop: str) -> None:
        """What runs goes on, and is named."""
        _, found = self.service.locking.lock(loop, "valve", "me")
        self.locked.add(loop)
        job = self.having(loop)
        runs = job is not None and job.state == "running"
        assert (found.id if found else None) == (job.id if job and runs else None)
        self.said("lock", "a test runs" if runs else "done")

    @precondition(lambda self: not self.locked and any(job.state == "accepted" for job in self.jobs))
    @rule()
    def lock_what_is_accepted(self) -> None:
        """And try to take it back: by chance alone that takes thousands of steps."""
        job = next(job for job in reversed(self.jobs) if job.state == "accepted")
        self.lock(job.loop)
        assert not self.decide(job, "rollback", self.service.decisions.rollback, ("proposed", "accepted"))

    @precondition(lambda self: not self.locked and any(job.waits_for_a_loop for job in self.jobs))
    @rule()
    def lock_what_waits(self) -> None:
        """Locks the loop of a job that has not begun, which then begins: by chance alone that is rare, too."""
        job = next(job for job in self.jobs if job.waits_for_a_loop)
        self.lock(job.loop)
        self.begun(job)

    @precondition(lambda self: self.locked)
    @rule()
    def unlock(self) -> None:
        assert self.service.locking.unlock(self.locked.pop(), "me") is not None
        self.said("unlock", "done")

    @precondition(lambda self: any(job.begun for job in self.jobs))
    @rule(goes_back=st.booleans())
    def crash(self, goes_back: bool) -> None:
        """kill -9 and the next start; the controllers have ended their sessions meanwhile, or not yet."""
        self.service.stop_watching()
        self.service.aftercare.close()
        for job in self.jobs:
            if job.begun:
                job.act.killed = True
                job.act.told.set()
                self.over(job)
        self.service.journal.close(5.0)
        self.store.close()
        for controller in self.controllers.values():
            if goes_back:
                controller.end_session()
        self.boot()
        for job in self.jobs:
            if not job.active:
                continue
            job.begun = False
            job.act.killed = False
            job.act.told.clear()
            job.act.inside.clear()
            if job.attempts >= MAX_ATTEMPTS or (job.loop in self.locked and job.old is not None):
                job.state = "interrupted"
        assert sorted(self.engine.queued) == sorted(job.id for job in self.jobs if job.active)
        self.said("crash", "gone back" if goes_back else "on trial")

    @precondition(lambda self: any(job.begun for job in self.jobs))
    @rule()
    def restart(self) -> None:
        """SIGTERM and the next start: what was active is aborted, and does not go on."""
        self.service.stop()
        self.store.close()
        for job in self.jobs:
            if job.active:
                job.state, job.begun = "aborted", False
        self.boot()
        assert self.engine.queued == []
        self.said("restart", "done")

    # what always holds
    @invariant()
    def states_agree(self) -> None:
        rows = {row.id: row for row in self.store.recent(limit=1000)}
        found = {job_id: (row.state, row.loop, row.dry_run, row.attempt) for job_id, row in rows.items()}
        assert found == {job.id: (job.state, job.loop, job.dry, job.attempts) for job in self.jobs}
        for job in self.jobs:
            row = rows[job.id]
            assert (row.ended_at is None) == job.active
            assert row.reason is None or row.state in ("refused", "failed", "aborted", "interrupted", "no_gain")
        assert self.store.busy() == {job.loop: job.id for job in self.jobs if job.active and not job.dry}

    @invariant()
    def a_loop_without_a_job_has_its_gains(self) -> None:
        under_test = {job.loop for job in self.jobs if job.begun and not job.dry}
        for tag, controller in self.controllers.items():
            if tag not in under_test:
                assert controller.state == replace(FakeController().state, gains=self.gains[tag])
            assert controller.open == (tag in under_test)

    def teardown(self) -> None:
        try:
            self.service.stop()
            for job in self.jobs:
                events = self.store.events(job.id)
                assert [event.seq for event in events] == list(range(1, len(events) + 1))
                told = [(event.data.get("from"), event.data["state"]) for event in events if event.kind == "state"]
                chain = [state for _, state in told]
                assert [before for before, _ in told] == [None, *chain[:-1]], "each state follows the one before"
        finally:
            self.store.close()
            shutil.rmtree(self.folder)


def test_jobs_do_what_the_model_says(
    tmp_path: Path, machine_count: Counter[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pragmas = database.pragmas

    def hasty(connection: Any, record: object) -> None:
        """These crashes are no power cuts: waiting for the disk would only take time."""
        pragmas(connection, record)
        connection.execute("PRAGMA synchronous=OFF")

    monkeypatch.setattr(database, "pragmas", hasty)
    Store(tmp_path).close()
    for number in SEEDS:
        run_state_machine_as_test(  # type: ignore[no-untyped-call]
            seed(number)(lambda: JobsMachine(tmp_path / FILE, machine_count)),
            settings=settings(
                max_examples=20, stateful_step_count=40, database=None, deadline=None,
                suppress_health_check=list(HealthCheck), print_blob=False,
            ),
        )  # fmt: skip
        if machine_count.keys() >= RULES:
            break
    assert RULES - machine_count.keys() == set(), "outcomes that were not seen"
