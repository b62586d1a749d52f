from __future__ import annotations

import sqlite3
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import func, select
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from loopwright.service.jobs.active_job import Running
from loopwright.service.jobs.journal import Journal
from loopwright.service.store.journal_writes import Write, event_of
from loopwright.service.store.store import Store
from loopwright.service.store.tables import ChunkRow
from loopwright.tuning.plan import Sample, StageDone, StageStarted


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    store = Store(tmp_path)
    yield store
    store.close()


def notes(store: Store, job_id: str) -> list[str]:
    return [event.data["text"] for event in store.events(job_id) if event.kind == "note"]


def test_what_the_database_does_not_take_waits_and_is_written_in_order(store: Store) -> None:
    row = store.create("A", {}, "me", False)
    journal = Journal(store)
    away = threading.Event()
    away.set()

    def fails_while_away(_session: Session) -> None:
        if away.is_set():
            raise OperationalError("INSERT", {}, sqlite3.OperationalError("database or disk is full"))

    journal.put(event_of(row.id, "note", {"text": "0"}, 0.0))
    journal.put(fails_while_away)
    began = time.monotonic()
    for n in range(1, 300):
        journal.put(event_of(row.id, "note", {"text": str(n)}, float(n)))
    assert time.monotonic() - began < 1.0  # nobody who reports waits
    assert not journal.flush(0.3) and journal.behind_s > 0
    away.clear()
    assert journal.flush(10) and journal.behind_s == 0
    assert notes(store, row.id) == [str(n) for n in range(300)]
    assert store.get(row.id).plant_time_s == 299.0
    journal.close(1)


def test_what_the_database_will_never_take_does_not_stop_the_rest(
    store: Store, caplog: pytest.LogCaptureFixture
) -> None:
    row = store.create("A", {}, "me", False)
    journal = Journal(store)
    journal.put(event_of("no such job", "note", {"text": "lost"}, 0.0))
    journal.put(event_of(row.id, "note", {"text": "kept"}, 0.0))
    assert journal.flush(10)
    assert notes(store, row.id) == ["kept"] and "could not be written" in caplog.text
    journal.close(1)


def test_closing_writes_what_waits_and_gives_up_in_time(store: Store) -> None:
    row = store.create("A", {}, "me", False)
    journal = Journal(store)
    journal.put(event_of(row.id, "note", {"text": "last"}, 0.0))
    journal.close(5)
    assert notes(store, row.id) == ["last"]

    def never(_session: Session) -> None:
        raise OperationalError("INSERT", {}, sqlite3.OperationalError("locked"))

    journal = Journal(store)
    journal.put(never)
    began = time.monotonic()
    journal.close(0.3)
    assert time.monotonic() - began < 2.0


def test_a_finished_stage_is_stored_after_its_samples(store: Store) -> None:
    """Whoever reads the one finds the other, whenever the service died."""
    row = store.create("A", {}, "me", False)
    journal = Journal(store)
    running = Running(row.id, "A", journal)
    running.on_event(StageStarted("relay", 1.0, 0.0))
    running.on_samples([Sample(0.1 * n, 50.0, 50.0, 40.0, 2) for n in range(30)])
    found: list[int] = []
    put = journal.put

    def look_first(write: Write) -> None:
        put(lambda session: found.append(session.scalar(select(func.sum(ChunkRow.count))) or 0))
        put(write)

    journal.put = look_first  # type: ignore[method-assign]
    running.on_event(StageDone("relay", None))
    assert journal.flush(10)
    assert found[-1] == 30  # just before the last write, which is the end of the stage
    assert store.events(row.id)[-1].kind == "stage_done"
    journal.close(1)
