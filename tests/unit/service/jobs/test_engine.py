"""The engine itself: queues, ids, a restart. DBOS is one per process, so each test closes what it has opened."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from sqlalchemy import Engine as Database

from loopwright.service.jobs.dbos_engine import DurableEngine
from loopwright.service.store.database import close_database, open_database

Make = Callable[[str], DurableEngine]


@pytest.fixture(params=["sqlite", "postgresql"])
def make(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Make]:
    """Makes an engine of a host on the same database; the one before must be closed."""
    url = None if request.param == "sqlite" else request.getfixturevalue("postgres").database()
    databases: list[Database] = []
    engines: list[DurableEngine] = []

    def make(host: str) -> DurableEngine:
        database = None
        if url is not None:
            database = open_database(tmp_path, url, host)
            databases.append(database)
        engines.append(DurableEngine(tmp_path, database, host, 0.02))
        return engines[-1]

    yield make
    for engine in engines:
        engine.close()
    for database in databases:
        close_database(database)


class Runs:
    """Notes what was run; `hold` keeps a run from ending."""

    def __init__(self) -> None:
        self.ids: list[str] = []
        self.hold = threading.Event()
        self.hold.set()

    def __call__(self, job_id: str) -> None:
        self.ids.append(job_id)
        self.hold.wait(120)

    def until(self, count: int) -> list[str]:
        deadline = time.monotonic() + 120
        while len(self.ids) < count and time.monotonic() < deadline:
            time.sleep(0.01)
        return self.ids


def test_a_job_is_run_once_and_no_more_than_so_many_at_once(make: Make) -> None:
    engine, runs = make("a"), Runs()
    engine.launch(runs, {"a:bus": 2})
    runs.hold.clear()
    for job_id in ("1", "1", "2", "3"):
        engine.enqueue(job_id, "a:bus")
    assert sorted(runs.until(2)) == ["1", "2"] and engine.known(["1", "2", "3", "4"]) == {"1", "2", "3"}
    time.sleep(0.2)
    assert len(runs.ids) == 2
    runs.hold.set()
    assert sorted(runs.until(3)) == ["1", "2", "3"] and engine.alive()
    deadline = time.monotonic() + 120
    while engine.known(["1", "2", "3"]) and time.monotonic() < deadline:
        time.sleep(0.01)
    engine.enqueue("1", "a:bus")  # over: not again
    assert sorted(engine.over(9)) == ["1", "2", "3"] and len(engine.over(2)) == 2
    engine.forget(["1"])
    assert sorted(engine.over(9)) == ["2", "3"]
    engine.enqueue("1", "a:bus")
    assert runs.until(4)[3] == "1"
    time.sleep(0.2)
    assert len(runs.ids) == 4


def test_what_waits_or_runs_at_the_end_is_run_by_the_next_start(make: Make) -> None:
    engine, runs = make("a"), Runs()
    engine.launch(runs, {"a:bus": 1})
    runs.hold.clear()
    engine.enqueue("1", "a:bus")
    runs.until(1)
    engine.enqueue("2", "a:bus")
    engine.close()
    assert not engine.alive()
    again = Runs()
    other = make("a")
    other.launch(again, {"a:bus": 1})
    assert sorted(again.until(2)) == ["1", "2"] and runs.ids == ["1"]
    runs.hold.set()


def test_a_host_runs_what_is_on_its_own_queues_only(make: Make) -> None:
    engine, runs = make("a"), Runs()
    engine.launch(runs, {"a:bus": 8})
    engine.enqueue("for b", "b:bus")
    engine.enqueue("for a", "a:bus")
    runs.until(1)
    time.sleep(0.3)
    assert runs.ids == ["for a"] and engine.known(["for b"]) == set()
    engine.close()
    runs_of_b = Runs()
    engine = make("b")
    engine.launch(runs_of_b, {"b:bus": 8})
    assert runs_of_b.until(1) == ["for b"] and runs.ids == ["for a"]


def test_a_job_that_outlasts_the_engine_is_said_in_one_line(make: Make, caplog: pytest.LogCaptureFixture) -> None:
    engine, runs = make("a"), Runs()
    engine.launch(runs, {"a:bus": 1})
    engine_log = logging.getLogger("dbos")
    engine_log.addHandler(caplog.handler)
    try:
        runs.hold.clear()
        engine.enqueue("1", "a:bus")
        runs.until(1)
        engine.close()
        runs.hold.set()
        deadline = time.monotonic() + 120
        while not caplog.records and time.monotonic() < deadline:
            time.sleep(0.01)
    finally:
        engine_log.removeHandler(caplog.handler)
    assert [record.exc_info for record in caplog.records] == [None]
    assert caplog.records[0].getMessage().startswith("a job outlasted the engine, the next start goes on with it (")
    # and the next start runs it again
    again = make("a")
    again.launch(runs, {"a:bus": 1})
    assert runs.until(2) == ["1", "1"]
