from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.exc import OperationalError

from loopwright.service.api.job_views import job_view
from loopwright.service.execution.procedures import rehearse
from loopwright.service.inputs.request import FastRetune, retune_request
from loopwright.service.jobs import manager as jobs_module
from loopwright.service.jobs.database_retries import STOP_PATIENCE_S
from loopwright.service.jobs.progress import Progress
from loopwright.service.loops.bus_restore import RESTORE_PATIENCE_S
from loopwright.service.loops.loop import Restored
from loopwright.service.results import ModelView, TransferModelView
from loopwright.service.security.keys import Scope
from loopwright.service.security.principal import Principal
from loopwright.service.security.principal import current as principal
from loopwright.service.states.job_state import IllegalMove, JobState
from loopwright.service.states.loop_state import LoopState
from loopwright.service.store import audit
from loopwright.service.store.clock import now
from loopwright.service.store.jobs import Job
from loopwright.service.store.journal_writes import Write, stop_of
from loopwright.service.store.store import Store
from loopwright.service.store.tables import AuditRow
from loopwright.tuning.plan import StageStarted
from loopwright.tuning.reasons import Failed, Reason
from tests.unit.service.api.test_api import assert_problem
from tests.unit.service.fakes import OLD, TAG, FakeLoop, Service, away
from tests.unit.service.processes import until


def test_stopping_ends_the_jobs_and_waits_for_their_loops(service: Service) -> None:
    service.tune.hold.clear()
    row = service.jobs.start(TAG, FastRetune())
    service.tune.inside.wait(60)
    service.jobs.stop()
    row = service.store.get(row.id)
    assert (row.state, row.reason) == ("aborted", Reason.SERVICE_STOPPED.value)
    assert service.controller.state.gains == OLD and service.controller.open == 0


def test_a_job_that_does_not_end_holds_the_stop_up_for_a_while_only(
    service: Service, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(jobs_module, "ENDS_S", 0.2)
    inside, free = threading.Event(), threading.Event()

    def hangs(loop: FakeLoop, home: LoopState, session: int | None = None) -> Restored:
        inside.set()
        free.wait(20)
        return Restored(home, "at last")

    monkeypatch.setattr(FakeLoop, "restore", hangs)
    row = service.jobs.start(TAG, FastRetune())
    try:
        assert inside.wait(60)
        running = service.jobs.running(row.id)
        began = time.monotonic()
        service.jobs.stop()
        assert time.monotonic() - began < 10
    finally:
        free.set()
    (error,) = [record.getMessage() for record in caplog.records if record.levelname == "ERROR"]
    assert row.id in error and TAG in error and "unknown" in error and "look at the controller" in error
    assert service.store.get(row.id).state == "running"  # the next start looks at its loop
    assert running is not None and running.over.wait(60)


def test_the_stop_waits_longer_than_any_restore() -> None:
    assert jobs_module.ENDS_S > RESTORE_PATIENCE_S + 3 * STOP_PATIENCE_S


def test_what_a_dead_service_left_is_marked_at_the_next_start(tmp_path: Path) -> None:
    store = Store(tmp_path)
    queued, running = store.create("A", {}, "me", False), store.create("B", {}, "me", False)
    store.move(running.id, JobState.RUNNING)
    store.close()
    service = Service(tmp_path)
    for job in (queued, running):
        row = service.store.get(job.id)
        assert (row.state, row.reason) == ("interrupted", "service_stopped") and row.ended_at
    service.close()


def test_a_job_that_cannot_open_its_loop_fails_and_frees_it(service: Service) -> None:
    def no_bus(config: object) -> FakeLoop:
        raise OSError("no such device")

    jobs = service.more_jobs(no_bus)
    row = jobs.start(TAG, FastRetune())
    service.wait(row.id)
    jobs.stop()
    row = service.store.get(row.id)
    assert (row.state, row.reason) == ("failed", "internal")
    assert service.store.active(TAG) is None


def test_progress_never_falls_and_ends_below_one() -> None:
    progress = Progress()
    seen, now = [], 100.0
    for stage, expected, remaining, seconds in (("a", 10.0, 90.0, 20), ("b", 40.0, 60.0, 30), ("c", 10.0, 0.0, 100)):
        progress.stage_started(StageStarted(stage, expected, remaining))
        for _ in range(seconds):
            now += 1.0
            progress.at(now)
            seen.append(progress.fraction)
    assert seen == sorted(seen) and 0.9 < seen[-1] < 1.0
    assert progress.remaining_s == pytest.approx(1.0)


def test_who_reads_the_progress_changes_nothing() -> None:
    progress = Progress()
    progress.stage_started(StageStarted("a", 10.0, 90.0))
    progress.at(100.0)
    before = vars(progress).copy()
    seen = progress.seen_at(105.0)
    assert (seen.plant_time_s, seen.remaining_s) == (5.0, 95.0) and seen.fraction == pytest.approx(0.05)
    assert progress.seen_at(99.0).plant_time_s == progress.seen_at(None).plant_time_s == 0.0
    assert vars(progress) == before and progress.fraction == 0.0


def test_a_job_that_is_looked_at_is_as_before(service: Service) -> None:
    service.tune.hold.clear()
    row = service.jobs.start(TAG, FastRetune())
    assert service.tune.inside.wait(60)
    running = service.jobs.running(row.id)
    assert running is not None and running.loop is not None
    before = vars(running.progress).copy()
    at_first = running.loop.t_s or 0.0
    while (running.loop.t_s or 0.0) < at_first + 1.0:
        time.sleep(0.005)
    views = [job_view(service.store.get(row.id), service.store.events(row.id), running) for _ in range(2)]
    assert views[0].plant_time_s > 0.5 and vars(running.progress) == before


@pytest.mark.parametrize("method", ["fast", "five-stage"])
def test_a_real_rehearsal_through_a_job(service: Service, method: str) -> None:
    jobs = service.more_jobs(lambda config: FakeLoop(service.controller), rehearse)
    row = jobs.start(TAG, retune_request(dry_run=True, method=method))
    service.wait(row.id)
    jobs.stop()
    row = service.store.get(row.id)
    assert (row.state, row.reason) == ("rehearsed", None), row.detail
    view = job_view(row, service.store.events(row.id), None)
    assert row.result is not None and view.method == method
    assert view.new_gains is not None and view.new_gains.Kp > 0
    assert view.predicted is not None and view.predicted.Ms < 2.1
    # the plant that is guessed: a tenth of MV for the step, T95 = L + 3 T
    K, T, L = 0.2, 2.4, 1.8
    if method == "five-stage":
        assert isinstance(view.model, ModelView) and view.model.T_s > 0
        assert view.step_before and view.step_after and view.step_after.settled
        return
    model = view.model
    assert isinstance(model, TransferModelView) and model.num_errors is not None
    assert model.num[-1] / model.den[-1] == pytest.approx(K, rel=1e-3)
    assert model.den[0] / model.den[-1] == pytest.approx(T, rel=1e-3)
    assert model.dead_time_s == pytest.approx(L, rel=1e-3)
    assert view.predicted.Ms == pytest.approx(1.6, abs=0.01)
    assert view.predicted_previous and view.evidence and view.verification
    assert view.evidence.reason is None and view.evidence.switches >= 4
    assert view.verification.fit_pct > 99.9 and view.verification.Ms == pytest.approx(1.6, abs=0.05)
    assert view.step_before is None and view.step_after is None
    assert "overshoot_window_pct" not in row.request and row.request["Ms"] == 1.6


def test_samples_of_a_rehearsal_are_kept(service: Service) -> None:
    jobs = service.more_jobs(lambda config: FakeLoop(service.controller), rehearse)
    row = jobs.start(TAG, retune_request(dry_run=True, Ms=1.4))
    service.wait(row.id)
    jobs.stop()
    stages = [stage for stage, _ in service.store.samples(row.id)]
    assert {"preflight", "relay", "verify"} <= set(stages)


def aborts(service: Service) -> list[AuditRow]:
    return [each for each in audit.trail(service.store.engine, 100) if each.what == "abort"]


def test_a_running_job_hears_of_an_abort_that_the_database_does_not_take(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = service.under_test()
    monkeypatch.setattr(service.store, "request_stop", away)
    service.jobs.abort(job_id, "me")
    service.wait(job_id)
    row = service.store.get(job_id)
    assert (row.state, row.reason) == ("aborted", Reason.OPERATOR.value)
    assert service.controller.state.gains == OLD


def test_an_abort_that_the_database_does_not_take_is_written_once_when_it_does(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = service.under_test()
    who = Principal("control room", Scope.OPERATE, "0123456789ab", "192.0.2.7")
    with monkeypatch.context() as patch:
        patch.setattr(service.store, "writing", away)
        token = principal.set(who)
        assert service.jobs.abort(job_id, "operator A").id == service.jobs.abort(job_id, "operator A").id == job_id
        principal.reset(token)
        asked = now()
        until(lambda: service.jobs.journal.behind_s > 0, "reports that the database does not take")
        assert aborts(service) == []
    service.wait(job_id)
    assert service.jobs.journal.flush(60)
    row, (told,) = service.store.get(job_id), aborts(service)
    assert (row.state, row.reason, row.stop_reason) == ("aborted", Reason.OPERATOR, Reason.OPERATOR)
    assert (told.key, told.key_id, told.address) == (who.name, who.key_id, who.address)
    assert (told.by, told.before, told.loop) == ("operator A", {"state": "running"}, TAG)
    (event,) = [each for each in service.store.events(job_id) if each.kind == "abort_requested"]
    assert event.data == {"by": "operator A"} and event.at <= asked and told.at <= asked


def test_who_aborted_is_written_also_after_the_jobs_own_end(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its way out failed, and the journal comes after the end."""
    job_id = service.under_test()
    waiting: list[Write] = []
    with monkeypatch.context() as patch:
        patch.setattr(service.store, "request_stop", away)
        patch.setattr(FakeLoop, "restore", lambda *_: (_ for _ in ()).throw(Failed(Reason.NODE_LOST, "silent")))
        patch.setattr(service.jobs.journal, "put", waiting.append)
        service.jobs.abort(job_id, "me")
        service.wait(job_id)
    assert service.store.get(job_id).state == "failed"
    for write in waiting:
        service.jobs.journal.put(write)
    assert service.jobs.journal.flush(60)
    (told,) = aborts(service)
    assert (told.by, told.before) == ("me", {"state": "running"})


def test_a_job_that_came_to_its_own_end_has_no_abort_written_later(
    service: Service, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    job_id = service.under_test()
    service.tune.hold.set()
    service.wait(job_id)
    service.jobs.journal.put(stop_of(job_id, Reason.OPERATOR, "me"))
    assert service.jobs.journal.flush(60)
    assert aborts(service) == [] and service.store.get(job_id).stop_reason is None
    assert "could not be written" not in caplog.text


def test_an_abort_of_a_waiting_job_that_the_database_does_not_take_is_refused(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody has heard of it, so that it has to be asked again."""
    row = service.store.create(TAG, {}, "me", False)
    monkeypatch.setattr(service.store, "request_stop", away)
    with pytest.raises(OperationalError):
        service.jobs.abort(row.id, "me")


def test_an_abort_while_the_database_answers_nothing_says_that_the_job_has_heard(
    service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = service.under_test()
    with monkeypatch.context() as patch:
        patch.setattr(service.store, "request_stop", away)
        patch.setattr(service.store, "get", away)
        answer = client.post(f"/jobs/{job_id}/abort", json={"by": "me"})
    detail = assert_problem(answer, 503)["detail"]
    assert f"job {job_id} has been told to stop" in detail and answer.headers["retry-after"]
    service.wait(job_id)
    assert service.jobs.journal.flush(60)
    assert [each.by for each in aborts(service)] == ["me"]


def test_an_abort_that_waits_for_the_database_is_accepted_and_shown_later(
    service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = service.under_test()
    with monkeypatch.context() as patch:
        patch.setattr(service.store, "writing", away)
        assert client.post(f"/jobs/{job_id}/abort", json={"by": "operator A"}).status_code == 202
    service.wait(job_id)
    assert service.jobs.journal.flush(60)
    shown = [(each["what"], each["by"]) for each in client.get("/decisions").json()]
    assert shown.count(("abort", "operator A")) == 1
    assert client.get(f"/jobs/{job_id}").json()["stopping"]["by"] == "operator A"


def test_a_job_that_ends_for_an_abort_before_it_is_written_down_was_aborted_by_it(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = service.store.request_stop

    def slow(job_id: str, *more: Any) -> Job:
        service.wait(job_id)
        return write(job_id, *more)

    service.tune.hold.clear()
    row = service.jobs.start(TAG, FastRetune())
    assert service.tune.inside.wait(60)
    monkeypatch.setattr(service.store, "request_stop", slow)
    assert service.jobs.abort(row.id, "me").state == "aborted"
    (told,) = aborts(service)
    assert (told.subject, told.by) == (row.id, "me")
    with pytest.raises(IllegalMove):
        service.jobs.abort(row.id, "me")
