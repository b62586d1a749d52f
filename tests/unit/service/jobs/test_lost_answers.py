"""The connection breaks after a COMMIT was done and before its answer has come, as in a failover of the server."""

from __future__ import annotations

import queue
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from loopwright.service.inputs.request import FastRetune
from loopwright.service.jobs.journal import Journal
from loopwright.service.states.job_state import JobState
from loopwright.service.store.job_rows import NoSuchJob
from loopwright.service.store.jobs import Job
from loopwright.service.store.journal_writes import block_of, event_of
from loopwright.service.store.store import Store
from loopwright.tuning.plan import Sample
from loopwright.tuning.reasons import Reason, Refused
from tests.unit.service.api.test_api import assert_problem
from tests.unit.service.fakes import TAG, Service
from tests.unit.service.processes import PATIENCE_S

Patch = pytest.MonkeyPatch


class LosesAnswers:
    """Loses the answer to the next COMMIT of a store. kept: whether that transaction was committed."""

    def __init__(self, store: Store, patch: Patch) -> None:
        self._writing = store.writing
        self._next: bool | None = None
        patch.setattr(store, "writing", self._losing)

    def lose_next(self, kept: bool = True) -> None:
        self._next = kept

    @property
    def lost(self) -> bool:
        return self._next is None

    @contextmanager
    def _losing(self) -> Iterator[Session]:
        with self._writing() as session:
            yield session
            kept, self._next = self._next, None
            if kept is False:
                self.lose()
        if kept:
            self.lose()

    @staticmethod
    def lose() -> None:
        raise OperationalError("COMMIT", {}, Exception("server closed the connection unexpectedly"))


@pytest.fixture
def answers(service: Service, monkeypatch: Patch) -> LosesAnswers:
    return LosesAnswers(service.store, monkeypatch)


def lose_answer_to_move(store: Store, answers: LosesAnswers, patch: Patch, lost: JobState) -> None:
    """The answer to the first move into that state is lost."""
    move = store.move
    to_lose = [lost]

    def moves(job_id: str, wanted: JobState, *more: Any, **columns: Any) -> Job:
        if wanted in to_lose:
            to_lose.remove(wanted)
            answers.lose_next()
        return move(job_id, wanted, *more, **columns)

    patch.setattr(store, "move", moves)


def states(service: Service, job_id: str) -> list[str]:
    return [event.data["state"] for event in service.store.events(job_id) if event.kind == "state"]


def test_a_retune_that_was_answered_with_503_does_not_begin_by_itself(
    service: Service, client: TestClient, answers: LosesAnswers
) -> None:
    answers.lose_next()
    assert_problem(client.post(f"/loops/{TAG}/retune", json={"by": "me"}), 503)
    assert answers.lost
    for _ in range(3):
        service.jobs.reconcile()
    (row,) = service.store.recent()
    assert (row.state, row.reason, row.detail) == ("failed", "internal", "it could not be queued")
    assert not service.tune.inside.is_set() and not service.jobs.registry.unqueued
    again = client.post(f"/loops/{TAG}/retune", json={"by": "me"})
    assert again.status_code == 202
    service.wait(again.json()["id"])
    assert service.store.get(again.json()["id"]).state == "proposed"


def test_nor_does_one_whose_commit_is_seen_only_later(
    service: Service, answers: LosesAnswers, monkeypatch: Patch
) -> None:
    """The server may still be at the COMMIT when the job is looked for at once."""

    def not_yet(job_id: str) -> Job:
        raise NoSuchJob(job_id)

    answers.lose_next()
    with monkeypatch.context() as patch, pytest.raises(OperationalError):
        patch.setattr(service.store, "get", not_yet)
        service.jobs.start(TAG, FastRetune())
    (row,) = service.store.unfinished()
    service.jobs.worker.work(row.id)  # by an engine that has it, from wherever
    assert service.store.get(row.id).state == "queued" and not service.tune.inside.is_set()
    service.jobs.reconcile()
    assert service.store.get(row.id).state == "failed" and not service.jobs.registry.unqueued


def test_a_retune_of_another_host_is_stopped_there(service: Service, answers: LosesAnswers, monkeypatch: Patch) -> None:
    monkeypatch.setattr(service.jobs.directory, "owner", lambda tag: (service.loops[TAG], "gateway B"))
    answers.lose_next()
    with pytest.raises(OperationalError):
        service.jobs.start(TAG, FastRetune())
    (row,) = service.store.recent()
    assert (row.state, row.stop_reason, row.host) == ("queued", "internal", "gateway B")


@pytest.mark.parametrize("host", [None, "gateway B"])
def test_a_retune_that_was_not_committed_is_forgotten(
    service: Service, answers: LosesAnswers, monkeypatch: Patch, host: str | None
) -> None:
    if host is not None:
        monkeypatch.setattr(service.jobs.directory, "owner", lambda tag: (service.loops[TAG], host))
    answers.lose_next(kept=False)
    with pytest.raises(OperationalError):
        service.jobs.start(TAG, FastRetune())
    service.jobs.reconcile()
    assert not service.store.recent() and not service.jobs.registry.unqueued


@pytest.mark.parametrize("dry_run", [False, True])
def test_a_job_that_is_running_already_goes_on(
    service: Service, answers: LosesAnswers, monkeypatch: Patch, dry_run: bool
) -> None:
    lose_answer_to_move(service.store, answers, monkeypatch, JobState.RUNNING)
    job_id = service.jobs.start(TAG, FastRetune(dry_run=dry_run)).id
    service.wait(job_id)
    row = service.store.get(job_id)
    assert (row.state, row.attempt, row.detail) == ("rehearsed" if dry_run else "proposed", 1, None)
    assert states(service, job_id) == ["queued", "running", row.state]


@pytest.mark.parametrize("ends", [None, Refused(Reason.NO_RESPONSE, "PV did not move")])
def test_what_follows_the_end_of_a_job_is_done(
    service: Service, answers: LosesAnswers, monkeypatch: Patch, ends: Refused | None
) -> None:
    service.tune.ends = ends
    state = JobState.PROPOSED if ends is None else JobState.REFUSED
    lose_answer_to_move(service.store, answers, monkeypatch, state)
    tested: list[Job] = []
    ended: queue.Queue[Job] = queue.Queue()
    monkeypatch.setattr(service.jobs.knowledge, "tested", lambda job, *_: tested.append(job))
    monkeypatch.setattr(service.jobs.worker, "_ended", ended.put)
    job_id = service.jobs.start(TAG, FastRetune()).id
    job = ended.get(timeout=PATIENCE_S)
    assert job == service.store.get(job_id) and job.state is state and tested == [job]
    assert states(service, job_id) == ["queued", "running", state]


@pytest.mark.parametrize("by", ["another attempt here", "another host"])
def test_what_others_have_begun_is_not_taken_for_ones_own(
    service: Service, answers: LosesAnswers, monkeypatch: Patch, by: str
) -> None:
    """Without a lost answer, or on another host, somebody else has the job."""
    move = service.store.move

    def faster(job_id: str, wanted: JobState, *more: Any, **columns: Any) -> Job:
        if wanted is JobState.RUNNING and service.store.get(job_id).state is JobState.QUEUED:
            if by == "another host":
                answers.lose_next()
                columns["host"] = "gateway B"
                return move(job_id, wanted, *more, **columns)
            move(job_id, wanted, *more, **columns)
        return move(job_id, wanted, *more, **columns)

    monkeypatch.setattr(service.store, "move", faster)
    job_id = service.jobs.start(TAG, FastRetune()).id
    service.wait(job_id)
    row = service.store.get(job_id)
    assert (row.state, row.reason) == ("failed", "internal") and not service.tune.inside.is_set()


def test_reports_of_a_job_are_stored_once(store: Store, monkeypatch: Patch) -> None:
    job_id = store.create("A", {}, "me", False).id
    answers, journal = LosesAnswers(store, monkeypatch), Journal(store)
    before, times = len(store.events(job_id)), [float(t) for t in range(12)]
    for t in times:
        if t % 3 == 0:  # as many as there happen to be then go in one transaction
            assert journal.flush(PATIENCE_S)
            answers.lose_next(kept=t % 6 == 0)
        journal.put(block_of(job_id, "relay", [Sample(t, 50.0, 50.0, 40.0 + t / 3, 2)]))
        journal.put(event_of(job_id, "note", {"text": f"at {t}", "figures": (t / 3, None)}, t, "relay"))
    assert journal.flush(PATIENCE_S) and answers.lost
    journal.close(1)
    assert [block.first_t_s for block in store.blocks(job_id)] == times
    assert [event.data["text"] for event in store.events(job_id)[before:]] == [f"at {t}" for t in times]
    assert store.get(job_id).plant_time_s == times[-1]


def test_an_event_whose_number_another_has_taken_is_stored_all_the_same(store: Store, monkeypatch: Patch) -> None:
    """Another gateway asks for an abort between a transaction that was lost and its repetition."""
    job_id = store.create("A", {}, "me", False).id
    write = event_of(job_id, "note", {"text": "once"}, 1.0)
    LosesAnswers(store, monkeypatch).lose_next(kept=False)
    with pytest.raises(OperationalError), store.writing() as session:
        write(session)
    store.append(job_id, "abort_requested", {"by": "gateway B"}, 1.0)
    for _ in range(2):
        with store.writing() as session:
            write(session)
    assert [event.kind for event in store.events(job_id)] == ["state", "abort_requested", "note"]
