"""Loops that a job could not bring home: looked at again until they are, across restarts, or until a person answers."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Unpack

import pytest
from fastapi.testclient import TestClient
from typer.testing import CliRunner

from loopwright.service.api.metrics import exposition, registry
from loopwright.service.cli import main as cli
from loopwright.service.cli.client import Client
from loopwright.service.inputs.request import FastRetune
from loopwright.service.jobs import aftercare
from loopwright.service.jobs.aftercare import EVERY_S, LONGEST_S, Aftercare
from loopwright.service.states.job_state import JobState
from loopwright.service.states.loop_state import state_json
from loopwright.service.store import audit, unconfirmed_restorations
from loopwright.service.store.jobs import Job, JobColumns
from loopwright.service.store.store import Store
from loopwright.service.store.tables import LoopRow
from loopwright.tuning.plan import Mode
from loopwright.tuning.reasons import Reason
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import TAG, FakeController, Service, loop_entry
from tests.unit.service.postgres import Server

HOME = FakeController().state
STOPPED = "node 20h is pre-operational"


@pytest.fixture(autouse=True)
def by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """No thread looks: each test says when."""
    monkeypatch.setattr(Aftercare, "start", lambda self: None)


class Clock:
    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(service: Service) -> Clock:
    clock = Clock()
    service.jobs.aftercare.clock = clock
    return clock


def left_by_a_job(service: Service, becomes: Callable[[FakeController], None]) -> Job:
    """A job that ends with what has become of its controller in the middle of the test."""
    service.tune.hold.clear()
    service.tune.inside.clear()
    row = service.jobs.start(TAG, FastRetune())
    assert service.tune.inside.wait(60)
    becomes(service.controller)
    service.tune.hold.set()
    service.wait(row.id)
    return service.store.get(row.id)


def stopped(controller: FakeController) -> None:
    """Another node's NMT command: the test is over, and nothing controls."""
    controller.end_session()
    controller.state = replace(controller.state, node_state=STOPPED)


def started(controller: FakeController) -> None:
    controller.state = replace(controller.state, node_state="operational")


def silent(controller: FakeController) -> None:
    controller.absent = Reason.NODE_LOST


def told(service: Service, job_id: str) -> list[str]:
    return [event.data["text"] for event in service.store.events(job_id) if event.kind == "loop_found"]


def test_it_is_looked_at_again_until_the_node_is_back(service: Service, clock: Clock) -> None:
    row = left_by_a_job(service, stopped)
    assert (row.state, row.reason, row.restore_unconfirmed, row.restored) == (
        "failed",
        "node_not_operational",
        True,
        None,
    )
    service.jobs.aftercare.check_due_loops()
    assert service.store.get(row.id).restore_unconfirmed and told(service, row.id) == []
    started(service.controller)
    service.jobs.aftercare.check_due_loops()
    assert service.store.get(row.id).restore_unconfirmed  # not so soon
    clock.now += EVERY_S
    service.jobs.aftercare.check_due_loops()
    row = service.store.get(row.id)
    assert (row.restore_unconfirmed, row.state, row.reason) == (False, "failed", "node_not_operational")
    assert row.restored == state_json(HOME) and service.controller.open == 0
    (text,) = told(service, row.id)
    assert "as before the job, read back" in text


def test_a_session_that_is_still_open_is_closed(service: Service, clock: Clock) -> None:
    row = left_by_a_job(service, silent)
    assert row.restore_unconfirmed and service.controller.session == row.session
    service.controller.absent = None
    service.jobs.aftercare.check_due_loops()
    assert service.controller.session == 0 and service.controller.state == HOME
    assert told(service, row.id)[0].startswith("the session was closed")


def test_what_another_hand_has_changed_ends_it_too(service: Service, clock: Clock) -> None:
    row = left_by_a_job(service, silent)
    service.controller.absent = None
    service.controller.by_hand(mode=Mode.MANUAL)
    service.jobs.aftercare.check_due_loops()
    row = service.store.get(row.id)
    assert not row.restore_unconfirmed and row.restored is not None and row.restored["mode"] == "manual"
    assert "not as before the job, left so: mode is manual" in told(service, row.id)[0]
    assert service.controller.state.mode is Mode.MANUAL


def test_it_is_asked_less_often_the_longer_it_stays_away(service: Service, clock: Clock) -> None:
    left_by_a_job(service, silent)
    reads: list[float] = []
    read = FakeController.answer

    def counted(controller: FakeController) -> Any:
        reads.append(clock.now)
        return read(controller)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FakeController, "answer", counted)
        for _ in range(240):
            service.jobs.aftercare.check_due_loops()
            clock.now += 0.5
    gaps = [after - before for before, after in pairwise(reads)]
    assert gaps[:5] == [2.0, 4.0, 8.0, 16.0, LONGEST_S] and set(gaps[5:]) == {LONGEST_S}


def test_it_goes_on_after_a_restart(tmp_path: Path) -> None:
    first = Service(tmp_path)
    row = left_by_a_job(first, stopped)
    first.close()
    second = Service(tmp_path)
    second.controller.session_last, second.controller.home = row.session or 0, HOME
    second.jobs.aftercare.check_due_loops()
    assert not second.store.get(row.id).restore_unconfirmed and len(told(second, row.id)) == 1
    second.close()


def test_the_thread_looks_by_itself_and_ends_with_the_service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    monkeypatch.setattr(aftercare, "EVERY_S", 0.02)
    service = Service(tmp_path)
    row = left_by_a_job(service, stopped)
    started(service.controller)
    until = time.monotonic() + 60
    while service.store.get(row.id).restore_unconfirmed and time.monotonic() < until:
        time.sleep(0.01)
    assert not service.store.get(row.id).restore_unconfirmed
    service.close()
    assert not service.jobs.aftercare.is_running


def test_a_loop_with_an_active_job_is_that_jobs(service: Service, clock: Clock) -> None:
    row = left_by_a_job(service, stopped)
    started(service.controller)
    service.tune.hold.clear()
    service.tune.inside.clear()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(unconfirmed_restorations, "opened", lambda job_id, columns: lambda session: None)
        second = service.jobs.start(TAG, FastRetune())
        assert service.tune.inside.wait(60)
    service.jobs.aftercare.check_due_loops()
    assert service.store.get(row.id).restore_unconfirmed and service.controller.session
    service.tune.hold.set()
    service.wait(second.id)


def test_a_job_that_opens_a_session_answers_for_the_loop(service: Service, clock: Clock) -> None:
    row = left_by_a_job(service, stopped)
    refused = service.jobs.start(TAG, FastRetune())  # the node is still where it was
    service.wait(refused.id)
    assert service.store.get(refused.id).state == "failed" and service.store.get(row.id).restore_unconfirmed
    assert not service.store.get(refused.id).restore_unconfirmed  # it has touched nothing
    started(service.controller)
    second = service.jobs.start(TAG, FastRetune())
    service.wait(second.id)
    assert service.store.get(second.id).state == "proposed" and not service.store.get(row.id).restore_unconfirmed
    assert second.id in told(service, row.id)[0]


def failed(store: Store, job_id: str, **columns: Unpack[JobColumns]) -> None:
    store.move(job_id, JobState.RUNNING)
    store.move(job_id, JobState.FAILED, **columns)


def test_a_defect_with_one_loop_does_not_keep_the_others_from_being_looked_at(
    service: Service, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = left_by_a_job(service, stopped)
    started(service.controller)
    other = service.store.create("FIC-2", {}, "me", False)
    failed(service.store, other.id, restore_unconfirmed=True, found={"no": "state"}, session=3)
    service.jobs.aftercare.check_due_loops()
    assert not service.store.get(row.id).restore_unconfirmed and service.store.get(other.id).restore_unconfirmed


def test_a_loop_that_is_configured_no_more_is_kept_and_can_be_dismissed(service: Service, clock: Clock) -> None:
    row = service.store.create("GONE", {}, "me", False)
    failed(service.store, row.id, restore_unconfirmed=True, session=3)
    service.jobs.aftercare.check_due_loops()
    (found,) = service.jobs.aftercare.unconfirmed()
    assert "no longer configured here" in found.words
    assert service.jobs.aftercare.acknowledge("GONE", "me") == [row.id] and service.jobs.aftercare.unconfirmed() == []


def test_it_moves_with_its_loop_to_another_host(tmp_path: Path, postgres: Server) -> None:
    store = Store(tmp_path, postgres.database(), "gateway A")
    row = store.create(TAG, {}, "me", False, host="gateway B")
    failed(store, row.id, restore_unconfirmed=True)
    with store.writing() as session:
        session.add(LoopRow(tag=TAG, host="gateway B", config={}))
    store.own_loops({TAG: loop_entry()})
    assert [found.id for found in unconfirmed_restorations.rows(store)] == [row.id]
    store.close()


# over HTTP


@pytest.fixture
def client(service: Service) -> Iterator[TestClient]:
    with TestClient(app_of(service.jobs, checks={}), raise_server_exceptions=False) as client:
        yield client


def test_who_asks_is_told(service: Service, clock: Clock, client: TestClient) -> None:
    shown = client.get(f"/loops/{TAG}").json()
    assert shown["restore_unconfirmed"] is None
    assert (shown["live"]["node_state"], shown["live"]["fail_action"]) == ("operational", "")
    row = left_by_a_job(service, stopped)
    shown = client.get(f"/loops/{TAG}").json()
    assert shown["live"]["node_state"] == STOPPED
    found = shown["restore_unconfirmed"]
    assert (found["job"], found["reason"]) == (f"/jobs/{row.id}", "node_not_operational") and STOPPED in found["detail"]
    ready = client.get("/readyz")
    part = ready.json()["parts"][f"loop {TAG}"]
    assert ready.status_code == 503 and not part["ready"]
    for words in (row.id, STOPPED, "start it (NMT)", f"loopwright acknowledge {TAG}"):
        assert words in part["detail"]
    assert b"loopwright_loops_restore_unconfirmed 1.0" in exposition(registry(service.loops, service.store, {}))


def test_a_loop_that_is_away_is_shown_with_what_is_known(service: Service, clock: Clock, client: TestClient) -> None:
    left_by_a_job(service, silent)
    service.jobs.aftercare.check_due_loops()
    answer = client.get(f"/loops/{TAG}")
    assert answer.status_code == 200 and answer.json()["live"] is None
    assert answer.json()["restore_unconfirmed"]["reason"] == "node_lost"
    service.jobs.aftercare.acknowledge(TAG, "me")
    found = client.get(f"/loops/{TAG}").json()
    assert found["live"] is found["restore_unconfirmed"] is None and found["live_error"]["reason"] == "node_lost"


def test_ready_again_once_it_is_home(service: Service, clock: Clock, client: TestClient) -> None:
    left_by_a_job(service, stopped)
    started(service.controller)
    service.jobs.aftercare.check_due_loops()
    ready = client.get("/readyz")
    assert ready.status_code == 200 and ready.json()["parts"] == {}
    assert b"loopwright_loops_restore_unconfirmed 0.0" in exposition(registry(service.loops, service.store, {}))


def test_a_person_answers_for_it(service: Service, clock: Clock, client: TestClient) -> None:
    row = left_by_a_job(service, stopped)
    for jobs in ([f"/jobs/{row.id}"], []):  # the second time there is nothing to end, and no entry
        answer = client.post(f"/loops/{TAG}/acknowledge", json={"by": "night shift"})
        assert (answer.status_code, answer.json()) == (200, {"loop": TAG, "jobs": jobs})
    assert not service.store.get(row.id).restore_unconfirmed
    entries = audit.trail(service.store.engine, 10, what=["acknowledge"])
    assert [(entry.subject, entry.loop, entry.by) for entry in entries] == [(row.id, TAG, "night shift")]
    assert [event.data for event in service.store.events(row.id) if event.kind == "acknowledged"] == [
        {"by": "night shift"}
    ]
    assert client.post("/loops/NONE/acknowledge").status_code == 404


def test_while_a_job_has_the_loop_nobody_can_answer_for_it(service: Service, clock: Clock, client: TestClient) -> None:
    left_by_a_job(service, stopped)
    active = service.store.create(TAG, {}, "me", False)
    answer = client.post(f"/loops/{TAG}/acknowledge")
    assert answer.status_code == 409 and answer.json()["job"] == f"/jobs/{active.id}"


def test_the_command(service: Service, clock: Clock, client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    row = left_by_a_job(service, stopped)
    monkeypatch.setattr(Client, "post", lambda self, path, body: client.post(path, json=body).json())
    for words in (f"Acknowledged: /jobs/{row.id}", f"{TAG}: there was nothing to acknowledge."):
        ran = CliRunner().invoke(cli.app, ["acknowledge", TAG])
        assert ran.exit_code == 0 and words in ran.stdout
