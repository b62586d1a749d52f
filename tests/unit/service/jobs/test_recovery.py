"""What a service does with the jobs that another one left, without processes: the same store, opened again."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy.exc import OperationalError

from loopwright.service.inputs.config import parse_site
from loopwright.service.inputs.request import FastRetune
from loopwright.service.jobs.engine import WORKFLOW_VERSION
from loopwright.service.jobs.manager import Jobs
from loopwright.service.jobs.recovery import MAX_ATTEMPTS
from loopwright.service.server.assembly import make_jobs
from loopwright.service.states.job_state import IllegalMove, JobState
from loopwright.service.states.loop_state import LoopState, state_json
from loopwright.service.store.jobs import Job
from loopwright.service.store.store import Store
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode
from loopwright.tuning.reasons import Reason
from tests.unit.service.fakes import (
    NEW,
    OLD,
    TAG,
    FakeController,
    FakeLoop,
    FakeTune,
    Service,
    ThreadEngine,
    fake_rehearse,
    loop_entry,
)

HOME = FakeController().state
ON_TRIAL = replace(HOME, gains=NEW, on_trial=True, sp=52.0)
SESSION = 41


@pytest.fixture
def started() -> Iterator[list[Service]]:
    services: list[Service] = []
    yield services
    for service in services:
        service.close()


def left(folder: Path, version: str = WORKFLOW_VERSION, done: tuple[str, ...] = (), **columns: Any) -> str:
    """A job in the middle of its test, as kill -9 leaves it."""
    store = Store(folder)
    row = store.create(TAG, {}, "me", False, version=version)
    old = {"Kp": OLD.Kp, "Ti": OLD.Ti}
    running: dict[str, Any] = {"previous_gains": old, "found": state_json(HOME), "attempt": 1, "session": SESSION}
    store.move(row.id, JobState.RUNNING, **running | columns)
    for stage in done:
        store.append(row.id, "stage_started", {"stage": stage, "expected_s": 1.0, "remaining_s": 1.0}, 5.0)
        store.append(row.id, "stage_done", {"stage": stage, "result": {}, "stage_time_s": 5.0}, 5.0)
    store.close()
    return row.id


def in_the_session(controller: FakeController) -> None:
    """Still in the test that the dead service has begun."""
    controller.begin_session(SESSION)
    controller.state = ON_TRIAL


def ended_by_itself(controller: FakeController) -> None:
    in_the_session(controller)
    controller.end_session()


def moved(**by_hand: Any) -> Callable[[FakeController], None]:
    """Another's hand was on it after the service had died."""

    def move(controller: FakeController) -> None:
        in_the_session(controller)
        controller.by_hand(**by_hand)

    return move


def restarted(state: LoopState) -> Callable[[FakeController], None]:
    """It knows nothing of the session."""

    def start(controller: FakeController) -> None:
        controller.state = state

    return start


def away(reason: Reason) -> Callable[[FakeController], None]:
    def leave(controller: FakeController) -> None:
        in_the_session(controller)
        controller.absent = reason

    return leave


def again(
    started: list[Service],
    folder: Path,
    becomes: Callable[[FakeController], None] = ended_by_itself,
    **options: Any,
) -> Service:
    """The next start, with what has become of the controller."""

    class Later(Service):
        def more_jobs(self, open_loop: Callable[..., Any], *more: Any, **settings: Any) -> Jobs:
            becomes(self.controller)
            return super().more_jobs(open_loop, *more, **settings)

    service = Later(folder, **options)
    started.append(service)
    return service


def texts(service: Service, job_id: str, kind: str) -> list[str]:
    return [event.data["text"] for event in service.store.events(job_id) if event.kind == kind]


@pytest.mark.parametrize(
    ("becomes", "words"),
    [(in_the_session, "the session was closed"), (ended_by_itself, "the controller had ended the session")],
)
def test_a_loop_on_trial_is_brought_back_and_its_job_goes_on_where_it_was(
    started: list[Service], tmp_path: Path, becomes: Callable[[FakeController], None], words: str
) -> None:
    job_id = left(tmp_path, done=("preflight",), plant_time_s=7.0)
    service = again(started, tmp_path, becomes)
    service.wait(job_id)
    row = service.store.get(job_id)
    assert (row.state, row.attempt) == ("proposed", 2), row.detail
    assert words in texts(service, job_id, "loop_found")[0] and len(texts(service, job_id, "resumed")) == 1
    assert service.controller.state == HOME
    assert [stage for stage, _ in service.store.samples(job_id)] == ["relay"]
    assert service.store.samples(job_id)[0][1][0].t > 7.0
    assert row.stage_times_s == {"preflight": 5.0, "relay": 1.0} and row.plant_time_s == 8.0


def test_a_job_that_had_not_begun_is_begun(started: list[Service], tmp_path: Path) -> None:
    store = Store(tmp_path)
    row = store.create(TAG, {}, "me", False, version=WORKFLOW_VERSION)
    store.close()
    service = again(started, tmp_path)
    service.wait(row.id)
    assert service.store.get(row.id).state == "proposed" and not texts(service, row.id, "loop_found")


def test_a_job_that_had_opened_no_session_begins_anew_on_the_loop_as_it_is(
    started: list[Service], tmp_path: Path
) -> None:
    """What it had read may have been the test of another tuner."""
    job_id = left(tmp_path, found=state_json(ON_TRIAL), session=None)
    service = again(started, tmp_path, lambda controller: None)
    service.wait(job_id)
    row = service.store.get(job_id)
    assert (row.state, row.attempt) == ("proposed", 2), row.detail
    assert row.found == state_json(HOME) and not texts(service, job_id, "loop_found")


@pytest.mark.parametrize(
    ("becomes", "found", "reason", "words"),
    [
        (moved(sp=55.0), replace(HOME, sp=55.0), Reason.SETPOINT_CHANGED, "set-point is 55, was 50"),
        (moved(mode=Mode.MANUAL), replace(HOME, mode=Mode.MANUAL), Reason.MODE_CHANGED, "mode is manual"),
        (restarted(replace(HOME, gains=NEW)), replace(HOME, gains=NEW), Reason.GAINS_CHANGED, "gains is"),
    ],
)
def test_what_somebody_changed_meanwhile_stays_and_the_job_does_not_go_on(
    started: list[Service],
    tmp_path: Path,
    becomes: Callable[[FakeController], None],
    found: LoopState,
    reason: Reason,
    words: str,
) -> None:
    job_id = left(tmp_path)
    service = again(started, tmp_path, becomes)
    row = service.store.get(job_id)
    assert (row.state, row.reason, row.restore_unconfirmed) == ("interrupted", reason.value, False)
    assert words in (row.detail or "") and "not as before the job" in (row.detail or "")
    assert service.controller.state == found and row.restored == state_json(found)


@pytest.mark.parametrize(
    ("columns", "options", "reason", "words"),
    [
        ({"version": "0"}, {}, Reason.SERVICE_STOPPED, "another version"),
        ({}, {"resume": False}, Reason.SERVICE_STOPPED, "--no-resume"),
        ({"attempt": MAX_ATTEMPTS}, {}, Reason.SERVICE_STOPPED, f"attempt {MAX_ATTEMPTS}"),
        ({"request": {"sp_deviation": 2.5}}, {}, Reason.BAD_LIMITS, "configuration has changed"),
    ],
)
def test_a_job_that_may_not_go_on_says_why_and_what_was_restored(
    started: list[Service], tmp_path: Path, columns: dict[str, Any], options: dict[str, Any], reason: Reason, words: str
) -> None:
    job_id = left(tmp_path, **columns)
    service = again(started, tmp_path, in_the_session, **options)
    row = service.store.get(job_id)
    assert (row.state, row.reason) == ("interrupted", reason.value) and words in (row.detail or "")
    assert "the session was closed" in (row.detail or "") and service.controller.session == 0
    assert row.restored == state_json(HOME) == state_json(service.controller.state)
    assert service.store.active(TAG) is None


def test_a_loop_that_is_not_reached_is_said_so(started: list[Service], tmp_path: Path) -> None:
    job_id = left(tmp_path)
    service = again(started, tmp_path, away(Reason.NODE_LOST))
    row = service.store.get(job_id)
    assert (row.state, row.reason, row.restored, row.restore_unconfirmed) == ("interrupted", "node_lost", None, True)
    assert "not reached" in (row.detail or "")


def test_a_job_asked_to_stop_before_the_crash_is_stopped(started: list[Service], tmp_path: Path) -> None:
    job_id = left(tmp_path, stop_reason="operator")
    service = again(started, tmp_path, in_the_session)
    row = service.store.get(job_id)
    assert (row.state, row.reason) == ("aborted", "operator") and service.controller.state == HOME


def test_the_loop_of_a_job_is_configured_no_more(started: list[Service], tmp_path: Path) -> None:
    store = Store(tmp_path)
    row = store.create("GONE", {}, "me", False, version=WORKFLOW_VERSION)
    store.close()
    service = again(started, tmp_path)
    found: Job = service.store.get(row.id)
    assert found.state == "interrupted" and "no longer configured" in (found.detail or "")


class Forgetful(ThreadEngine):
    """Loses the first job that it is given."""

    def enqueue(self, job_id: str, queue: str) -> None:
        if not self.enqueued:
            self.enqueued.append((job_id, queue))
        else:
            super().enqueue(job_id, queue)


def test_a_job_that_the_engine_has_lost_is_given_to_it_again(started: list[Service], tmp_path: Path) -> None:
    engine = Forgetful()
    service = again(started, tmp_path, engine=engine)
    row = service.jobs.start(TAG, FastRetune())
    service.jobs.reconcile()
    assert service.store.get(row.id).state == "queued"  # at first sight it may still be on its way
    service.jobs.reconcile()
    service.wait(row.id)
    assert service.store.get(row.id).state == "proposed"
    assert engine.enqueued == [(row.id, "local:virtual:test")] * 2


class Broken(ThreadEngine):
    def enqueue(self, job_id: str, queue: str) -> None:
        raise OperationalError("INSERT", {}, Exception("no room"))


def test_what_could_not_be_queued_is_over_and_does_not_begin_later(started: list[Service], tmp_path: Path) -> None:
    service = again(started, tmp_path, engine=Broken())
    with pytest.raises(OperationalError):
        service.jobs.start(TAG, FastRetune())
    (row,) = service.store.recent()
    assert (row.state, row.reason) == ("failed", "internal") and service.store.active(TAG) is None


def test_what_could_neither_be_queued_nor_ended_does_not_begin_later(
    started: list[Service], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full disk: the end is written when there is room again; until then nobody begins it."""
    service = again(started, tmp_path)
    jobs = service.jobs

    def full(*_: Any, **__: Any) -> None:
        raise OperationalError("INSERT", {}, Exception("database or disk is full"))

    with monkeypatch.context() as patch:
        patch.setattr(jobs.engine, "enqueue", full)
        patch.setattr(service.store, "move", full)
        with pytest.raises(OperationalError):
            jobs.start(TAG, FastRetune())
        (row,) = service.store.unfinished()
        patch.setattr(jobs.engine, "enqueue", ThreadEngine.enqueue.__get__(jobs.engine))
        for _ in range(3):
            jobs.reconcile()
        jobs.worker.work(row.id)  # an engine that had taken it after all
        assert service.store.get(row.id).state == "queued" and not service.tune.inside.is_set()
    jobs.reconcile()
    row = service.store.get(row.id)
    assert (row.state, row.reason, row.detail) == ("failed", "internal", "it could not be queued")
    again_asked = jobs.start(TAG, FastRetune())
    service.wait(again_asked.id)
    assert service.store.get(again_asked.id).state == "proposed"


def test_what_could_not_be_queued_but_has_begun_is_stopped(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    service.tune.hold.clear()
    enqueue = service.jobs.engine.enqueue

    def taken_all_the_same(job_id: str, queue: str) -> None:
        enqueue(job_id, queue)
        service.tune.inside.wait(60)
        raise OperationalError("INSERT", {}, Exception("no answer"))

    monkeypatch.setattr(service.jobs.engine, "enqueue", taken_all_the_same)
    with pytest.raises(OperationalError):
        service.jobs.start(TAG, FastRetune())
    (row,) = service.store.recent()
    service.wait(row.id)
    row = service.store.get(row.id)
    assert (row.state, row.reason, service.controller.state) == ("aborted", "internal", HOME)


def test_what_could_not_be_queued_elsewhere_is_stopped_there(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its own host may have begun it by now: a job under test must not be called over."""
    monkeypatch.setattr(service.jobs.directory, "owner", lambda tag: (service.loops[TAG], "gateway B"))
    monkeypatch.setattr(service.jobs.engine, "enqueue", Broken().enqueue)
    with pytest.raises(OperationalError):
        service.jobs.start(TAG, FastRetune())
    (row,) = service.store.recent()
    assert (row.state, row.stop_reason, row.host) == ("queued", "internal", "gateway B")


def test_a_service_that_does_not_come_to_its_start_leaves_the_jobs(tmp_path: Path) -> None:
    job_id = left(tmp_path)
    store = Store(tmp_path)

    class NoStart(ThreadEngine):
        def launch(self, run: Callable[[str], None], queues: Mapping[str, int]) -> None:
            raise OSError("no engine")

    loops = parse_site({"loops": [loop_entry()]}, "test").loops
    controller = FakeController()
    jobs = make_jobs(loops, store, lambda config: FakeLoop(controller), FakeTune(), fake_rehearse, engine=NoStart())
    with pytest.raises(OSError, match="no engine"):
        jobs.boot()
    jobs.stop()
    assert store.get(job_id).state == "running"
    store.close()


def test_a_service_told_to_end_before_it_has_begun_leaves_the_jobs(tmp_path: Path) -> None:
    job_id = left(tmp_path)
    store = Store(tmp_path)
    loops = parse_site({"loops": [loop_entry()]}, "test").loops
    controller, engine = FakeController(), ThreadEngine()
    in_the_session(controller)
    jobs = make_jobs(loops, store, lambda config: FakeLoop(controller), FakeTune(), fake_rehearse, engine=engine)
    jobs.request_stop()
    jobs.boot()
    jobs.stop()
    assert store.get(job_id).state == "running" and not engine.alive() and controller.session == SESSION
    store.close()


def test_a_job_that_waits_for_its_turn_ends_at_once_when_aborted(started: list[Service], tmp_path: Path) -> None:
    service = again(started, tmp_path, engine=Forgetful())
    row = service.jobs.start(TAG, FastRetune())
    row = service.jobs.abort(row.id, "me")
    assert (row.state, row.reason) == ("aborted", "operator")
    assert [event.kind for event in service.store.events(row.id)] == ["state", "abort_requested", "state"]


def as_it_gets_its_turn(monkeypatch: pytest.MonkeyPatch, happens: Callable[[], object]) -> None:
    """Between the job's row being read and its being among those that run."""
    last_sample_s = Store.last_sample_s

    def meanwhile(store: Store, job: str) -> float:
        found = last_sample_s(store, job)
        happens()
        return found

    monkeypatch.setattr(Store, "last_sample_s", meanwhile)


def test_an_abort_just_as_the_job_gets_its_turn_is_kept(
    started: list[Service], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Answered as aborted, for it was waiting: then its test must not begin."""
    job_id = left(tmp_path)
    answers: list[str] = []
    service = again(started, tmp_path, engine=Forgetful())  # has the job, and does not begin it
    as_it_gets_its_turn(monkeypatch, lambda: answers.append(service.jobs.abort(job_id, "me").state))
    service.jobs.worker.work(job_id)
    assert answers == ["aborted"] and service.jobs.running(job_id) is None
    assert not service.tune.inside.is_set() and not texts(service, job_id, "resumed")
    assert service.store.get(job_id).state == "aborted"


def test_a_stop_request_written_just_as_the_job_gets_its_turn_is_heard(
    started: list[Service], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = left(tmp_path)
    service = again(started, tmp_path, engine=Forgetful())
    monkeypatch.setattr(service.store, "stop_requests", dict)  # the watcher comes later
    as_it_gets_its_turn(monkeypatch, lambda: service.store.request_stop(job_id, Reason.OPERATOR, "gateway B"))
    service.jobs.worker.work(job_id)
    row = service.store.get(job_id)
    assert (row.state, row.reason) == ("aborted", "operator") and not service.tune.inside.is_set()
    monkeypatch.undo()


def test_a_job_that_is_over_is_not_resumed(store: Store) -> None:
    row = store.create(TAG, {}, "me", False)
    store.move(row.id, JobState.ABORTED)
    with pytest.raises(IllegalMove):
        store.resumed(row.id, {"attempt": 2}, attempt=2)
    assert store.get(row.id).attempt == 0


def test_a_job_that_waits_when_the_service_stops_ends_as_such(started: list[Service], tmp_path: Path) -> None:
    service = again(started, tmp_path, engine=Forgetful())
    row = service.jobs.start(TAG, FastRetune())
    service.jobs.stop()
    assert (service.store.get(row.id).state, service.store.get(row.id).reason) == ("aborted", "service_stopped")


def test_an_abort_written_by_another_host_is_heard(service: Service) -> None:
    service.tune.hold.clear()
    row = service.jobs.start(TAG, FastRetune())
    service.tune.inside.wait(60)
    service.store.request_stop(row.id, Reason.OPERATOR, "gateway B")
    service.wait(row.id)
    assert (service.store.get(row.id).state, service.controller.state) == ("aborted", HOME)


def test_no_loop_is_read_while_a_decision_is_carried_out(service: Service) -> None:
    """A job begins with what the controller holds: not in the middle of an exchange of gains."""
    first = service.jobs.start(TAG, FastRetune())
    service.wait(first.id)
    seen: list[Any] = []

    class Slow(FakeLoop):
        def accept(self, gains: Gains, instead_of: Gains) -> LoopState:
            second = service.store.create(TAG, {}, "B", False, version=WORKFLOW_VERSION)
            service.jobs.engine.enqueue(second.id, "local:virtual:test")
            seen.append(second.id)
            service.tune.inside.wait(0.2)
            return super().accept(gains, instead_of)

    service.tune.inside.clear()
    service.jobs.directory.open_loop = lambda config: Slow(service.controller)
    service.jobs.decisions.accept(first.id, "me")
    service.wait(seen[0])
    assert service.store.get(seen[0]).previous_gains == asdict(HOME.gains) | {"Kp": NEW.Kp, "Ti": NEW.Ti}
