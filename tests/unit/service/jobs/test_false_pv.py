"""A test that finds PV to be false: the loop is held, the job says so and is not resumed, and no other begins on it
until a person has acknowledged it, over restarts, and whoever dies."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from loopwright.service.alarms.watch import AlarmWatch
from loopwright.service.errors import NotAcknowledged
from loopwright.service.inputs.request import FastRetune
from loopwright.service.jobs.aftercare import Aftercare
from loopwright.service.listening.listening import Listening
from loopwright.service.states.job_state import JobState
from loopwright.service.store import audit
from loopwright.service.store.job_rows import find
from loopwright.service.store.jobs import Job
from loopwright.service.store.store import Store
from loopwright.tuning.plan import Mode
from loopwright.tuning.reasons import FalsePv, Reason
from tests.unit.service.fakes import OLD, TAG, FakeController, Service
from tests.unit.service.jobs.test_recovery import SESSION, again, in_the_session, left
from tests.unit.service.processes import until

FROZEN = FalsePv(Reason.PV_FROZEN, "PV is exactly 50.1 for 10 samples")


@pytest.fixture(autouse=True)
def by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """No thread looks after loops: each test says when."""
    monkeypatch.setattr(Aftercare, "start", lambda self: None)


@pytest.fixture
def started() -> Iterator[list[Service]]:
    services: list[Service] = []
    yield services
    for service in services:
        service.close()


def ended(service: Service, becomes: Callable[[FakeController], None] = lambda controller: None) -> Job:
    """A test that has found PV to be false, after its controller has become so in the middle of it."""
    service.tune.ends = FROZEN
    job_id = service.under_test()
    becomes(service.controller)
    service.tune.hold.set()
    service.wait(job_id)
    service.tune.ends = None
    return service.store.get(job_id)


def refused(service: Service) -> str:
    with pytest.raises(NotAcknowledged) as error:
        service.jobs.start(TAG, FastRetune())
    assert error.value.reason is Reason.NOT_ACKNOWLEDGED
    return error.value.detail


def alarms(service: Service) -> AlarmWatch:
    return AlarmWatch(service.jobs, Listening(service.jobs.directory.loops, service.store, on=False))


def test_the_job_says_what_the_loop_is_and_who_has_to_act(service: Service) -> None:
    job = ended(service)
    assert (job.state, job.reason, job.false_pv, job.restore_unconfirmed) == (
        JobState.FAILED,
        Reason.PV_FROZEN,
        True,
        False,
    )
    assert job.restored is not None and (job.restored["mode"], job.restored["manual_output"]) == ("manual", 40.0)
    assert "10 samples; PV is false: the loop was left in manual at MV 40" in (job.detail or "")
    assert "until an operator has mended the sensor and puts the loop in automatic" in (job.detail or "")
    assert (service.controller.state.mode, service.controller.state.gains) == (Mode.MANUAL, OLD)


def test_no_test_begins_until_a_person_has_acknowledged_it(service: Service, client: TestClient) -> None:
    job = ended(service)
    assert f"job {job.id} found PV of loop {TAG} to be false" in refused(service)
    assert f"loopwright acknowledge {TAG}" in refused(service)
    answer = client.post(f"/loops/{TAG}/retune", json={"by": "A. Lind"})
    assert (answer.status_code, answer.json()["reason"]) == (409, "not_acknowledged")
    assert f"loopwright acknowledge {TAG}" in answer.json()["detail"] and job.id in answer.json()["detail"]
    preview = client.post(f"/loops/{TAG}/retune/preview", json={}).json()
    assert not preview["would_start"]
    assert "not_acknowledged" in [each["reason"] for each in preview["obstacles"]]
    many = client.post("/batches/preview", json={"loops": [TAG]}).json()
    assert "not_acknowledged" in str(many)
    assert job.id in client.get(f"/loops/{TAG}").json()["not_acknowledged"]
    rehearsal = service.jobs.start(TAG, FastRetune(dry_run=True))
    service.wait(rehearsal.id)
    assert service.store.get(rehearsal.id).state is JobState.REHEARSED

    assert client.post(f"/loops/{TAG}/acknowledge", json={"by": "A. Lind"}).json()["jobs"] == [f"/jobs/{job.id}"]
    assert client.get(f"/loops/{TAG}").json()["not_acknowledged"] is None
    assert client.post(f"/loops/{TAG}/acknowledge", json={"by": "A. Lind"}).json()["jobs"] == []
    entries = audit.trail(service.store.engine, 10, what=["acknowledge", "acknowledge_alarm"])
    assert {(entry.what, entry.loop, entry.by) for entry in entries} == {
        ("acknowledge", TAG, "A. Lind"), ("acknowledge_alarm", TAG, "A. Lind"),
    }  # fmt: skip
    service.controller.state = replace(service.controller.state, mode=Mode.AUTOMATIC)
    service.wait(service.jobs.start(TAG, FastRetune()).id)


def test_signing_its_alarm_off_is_acknowledging_it(service: Service) -> None:
    job = ended(service)
    watch = alarms(service)
    (alarm,) = watch.look()
    assert (alarm.priority, alarm.job, alarm.kind) == (1, f"/jobs/{job.id}", "false_pv")
    assert "the loop was left in manual at MV 40 %" in alarm.text
    watch.acknowledge(alarm.id, "A. Lind")
    assert watch.look() == ()
    service.wait(service.jobs.start(TAG, FastRetune()).id)


def test_it_is_to_be_acknowledged_after_a_restart_too(service: Service, started: list[Service], tmp_path: Path) -> None:
    job = ended(service)
    service.close()
    later = again(started, tmp_path, lambda controller: None)
    assert job.id in refused(later)
    assert [alarm.kind for alarm in alarms(later).look()] == ["false_pv"]


def test_a_job_that_waits_for_its_turn_is_refused(service: Service) -> None:
    """It was asked for before, and its loop is free again only now."""
    job = ended(service)
    with service.store.writing() as session:
        find(session, job.id, lock=True).false_pv = False
    service.tune.hold.clear()
    row = service.store.create(TAG, {}, "me", False)
    with service.store.writing() as session:
        find(session, job.id, lock=True).false_pv = True
    service.jobs.worker.work(row.id)
    assert (service.store.get(row.id).state, service.store.get(row.id).reason) == ("refused", "not_acknowledged")


def test_a_batch_leaves_the_loop_out_and_says_why(service: Service, client: TestClient) -> None:
    job = ended(service)
    asked = {"loops": [TAG], "stop_after_failures": 1, "by": "A. Lind"}
    url = client.post("/batches", json=asked).json()["url"]
    until(lambda: client.get(url).json()["ended_at"] is not None, "the end of the batch")
    found = client.get(url).json()
    (part,) = found["loops"]
    assert (part["state"], part["reason"], part["job"]) == ("skipped", "not_acknowledged", None)
    assert job.id in part["detail"] and (found["state"], found["failures"]) == ("done", 0)


@pytest.mark.parametrize("over", [False, True], ids=["open", "over"])
def test_a_kill_between_HOLD_and_the_end_of_the_job_ends_it_so(
    started: list[Service], tmp_path: Path, over: bool
) -> None:
    job_id = left(tmp_path)

    def held(controller: FakeController) -> None:
        in_the_session(controller)
        controller.hold()
        if over:
            controller.end_session()

    service = again(started, tmp_path, held)
    job = service.store.get(job_id)
    assert (job.state, job.reason, job.false_pv) == (JobState.FAILED, Reason.BAD_SAMPLE, True), job.detail
    assert job.restored is not None and job.restored["mode"] == "manual"
    assert "the loop was left in manual at MV 40" in (job.detail or "")
    assert (service.controller.state.mode, service.controller.session) == (Mode.MANUAL, 0)
    assert job_id in refused(service)


def test_a_kill_before_HOLD_is_the_end_of_a_test_as_ever(started: list[Service], tmp_path: Path) -> None:
    job_id = left(tmp_path)
    service = again(started, tmp_path, in_the_session)
    service.wait(job_id)
    assert (service.store.get(job_id).state, service.store.get(job_id).false_pv) == (JobState.PROPOSED, False)


def test_what_a_hand_has_done_with_the_held_loop_since_stays(started: list[Service], tmp_path: Path) -> None:
    job_id = left(tmp_path)

    def held(controller: FakeController) -> None:
        in_the_session(controller)
        controller.hold()
        controller.by_hand(mode=Mode.AUTOMATIC)

    service = again(started, tmp_path, held)
    job = service.store.get(job_id)
    assert (job.state, job.false_pv, service.controller.state.mode) == (JobState.FAILED, True, Mode.AUTOMATIC)
    assert "an operator has to look at it now" in (job.detail or "") and "mode is automatic" in (job.detail or "")


def test_a_stop_asked_for_before_the_service_died_changes_nothing_of_it(started: list[Service], tmp_path: Path) -> None:
    job_id = left(tmp_path)
    store = Store(tmp_path)
    store.request_stop(job_id, Reason.OPERATOR, "A. Lind")
    store.close()

    def held(controller: FakeController) -> None:
        controller.begin_session(SESSION)
        controller.hold()

    service = again(started, tmp_path, held)
    assert (service.store.get(job_id).state, service.store.get(job_id).false_pv) == (JobState.FAILED, True)


def test_a_loop_that_is_found_held_only_later_is_to_be_acknowledged_too(service: Service) -> None:
    """The node was away at the end of the test, and the next look at it finds it held."""

    def silent(controller: FakeController) -> None:
        controller.hold()
        controller.absent = Reason.NODE_LOST

    service.tune.ends = None
    job_id = service.under_test()
    silent(service.controller)
    service.tune.hold.set()
    service.wait(job_id)
    assert (service.store.get(job_id).restore_unconfirmed, service.store.get(job_id).false_pv) == (True, False)
    service.controller.absent = None
    service.jobs.aftercare.check_due_loops()
    found = service.store.get(job_id)
    assert (found.restore_unconfirmed, found.false_pv) == (False, True)
    assert found.restored is not None and found.restored["mode"] == "manual"
    assert job_id in refused(service)


def test_a_test_that_is_asked_for_before_that_look_finds_it_out_itself(service: Service) -> None:
    """The service was killed after HOLD, and the node was away at its next start."""
    service.tune.ends = None
    job_id = service.under_test()
    service.controller.hold()
    service.controller.absent = Reason.NODE_LOST
    service.tune.hold.set()
    service.wait(job_id)
    service.controller.absent = None
    later = service.jobs.start(TAG, FastRetune())
    service.wait(later.id)
    found = service.store.get(later.id)
    assert (found.state, found.reason, found.session) == (JobState.REFUSED, Reason.NOT_ACKNOWLEDGED, None), found.detail
    earlier = service.store.get(job_id)
    assert (earlier.restore_unconfirmed, earlier.false_pv) == (False, True)
    assert service.controller.state.mode is Mode.MANUAL
