from __future__ import annotations

import threading
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from sqlalchemy import MetaData, Table, func, inspect, select, update

from loopwright.service.jobs.dbos_engine import DurableEngine
from loopwright.service.jobs.retention import Retention, RetentionPolicy, delete_old_samples, forget_finished
from loopwright.service.states.job_state import JobState
from loopwright.service.store import audit
from loopwright.service.store.clock_watch import ClockWatch
from loopwright.service.store.store import Store
from loopwright.service.store.tables import JobRow
from loopwright.service.telemetry.metrics import CLOCK_JUMPS
from loopwright.tuning.plan import Sample
from tests.unit.service.fakes import ThreadEngine, add_samples

NOW = datetime.now(UTC)


def job(store: Store, loop: str, *states: JobState, dry: bool = False, days_ago: float = 0.0, host: str = "") -> str:
    """A job with ten samples that went through these states and ended so long ago."""
    row = store.create(loop, {}, "me", dry, host or None)
    add_samples(store, row.id, "relay", [Sample(0.1 * n, 50.0, 50.0, 40.0, 2) for n in range(10)])
    for state in states:
        ended = (NOW - timedelta(days=days_ago)).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        store.move(row.id, state)
        if state is not JobState.RUNNING:
            with store.writing() as session:
                session.execute(update(JobRow).where(JobRow.id == row.id).values(ended_at=ended))
    return row.id


def kept(store: Store, ids: list[str]) -> list[bool]:
    return [bool(store.samples(job_id)) for job_id in ids]


R, P, X = JobState.RUNNING, JobState.PROPOSED, JobState.FAILED


def test_the_newest_jobs_of_each_loop_keep_theirs(store: Store) -> None:
    a = [job(store, "A", R, X) for _ in range(4)]
    b = [job(store, "B", R, X)]
    dry = [job(store, "A", R, X, dry=True) for _ in range(3)]  # do not push the experiments out
    foreign = [job(store, "C", R, X, host="other") for _ in range(3)]
    assert delete_old_samples(store, RetentionPolicy(jobs=2)) == 3
    assert kept(store, a) == [False, False, True, True] and kept(store, b) == [True]
    assert kept(store, dry) == [False, True, True] and all(kept(store, foreign))
    assert delete_old_samples(store, RetentionPolicy(jobs=2)) == 0


def test_active_and_proposed_jobs_keep_theirs_always(store: Store) -> None:
    proposed, decided = job(store, "A", R, P, days_ago=99), job(store, "A", R, P, JobState.ACCEPTED, days_ago=99)
    declined, queued = job(store, "A", R, P, JobState.ROLLED_BACK, days_ago=99), job(store, "B")
    running = job(store, "A", R)
    newer = job(store, "C", R, X, days_ago=0.5)
    assert delete_old_samples(store, RetentionPolicy(days=1.0), NOW) == 2
    assert kept(store, [proposed, decided, declined, queued, running, newer]) == [True, False, False, True, True, True]


def test_one_reason_is_enough_to_keep(store: Store) -> None:
    ids = [job(store, "A", R, X, days_ago=days) for days in (9, 8, 0.5, 0.4)]
    assert delete_old_samples(store, RetentionPolicy(jobs=1, days=1.0), NOW) == 2 and kept(store, ids) == [
        False,
        False,
        True,
        True,
    ]
    assert delete_old_samples(store, RetentionPolicy(), NOW + timedelta(days=1e4)) == 0


def test_what_is_deleted_is_written_down_and_the_rest_of_the_job_stays(store: Store) -> None:
    ids = [job(store, "A", R, X) for _ in range(121)]
    assert delete_old_samples(store, RetentionPolicy(jobs=1)) == 120, "in several transactions"
    rows = [row for row in audit.trail(store.engine, 1000) if row.what == "samples_delete"]
    told = [(row.key, row.before, row.after) for row in reversed(rows)]
    assert [before and (len(before["jobs"]), before["samples"]) for _, before, _ in told] == [
        (50, 500), (50, 500), (20, 200),
    ]  # fmt: skip
    assert told[0][0] == "service" and told[0][2] == {"kept": "samples are kept of the newest 1 jobs of each loop"}
    assert [event.kind for event in store.events(ids[0])] == ["state", "state", "state", "samples_deleted"]
    assert store.get(ids[0]).state == "failed"


def rows_of_the_engine(engine: DurableEngine) -> dict[str, dict[str, int]]:
    """By job, how many rows each table of the engine has of it: read with SQL, not with the engine's own words."""
    found: dict[str, dict[str, int]] = {}
    schema = None if engine.database.dialect.name == "sqlite" else "dbos"
    with engine.database.connect() as connection:
        for name in inspect(engine.database).get_table_names(schema=schema):
            table = Table(name, MetaData(), schema=schema, autoload_with=connection)
            if "workflow_uuid" in table.c:
                job_id = table.c.workflow_uuid
                for row in connection.execute(select(job_id, func.count()).group_by(job_id)):
                    found.setdefault(row[0], {})[name] = row[1]
    return found


def test_the_engine_forgets_jobs_that_are_over_and_no_others(store: Store, tmp_path: Path) -> None:
    engine = DurableEngine(tmp_path, store.engine if store.shared else None, store.host, 0.02)
    hold, begun = threading.Event(), []

    def run(job_id: str) -> None:
        begun.append(job_id)
        if job_id in (running, lost):
            hold.wait(20)
        if job_id != lost:  # its end was not written: for us it is active
            store.move(job_id, R)
            store.move(job_id, X)

    over = [store.create(f"L{n}", {}, "me", False, None).id for n in range(3)]
    running, lost, queued = (store.create(tag, {}, "me", False, None).id for tag in ("R", "U", "Q"))
    foreign = store.create("F", {}, "me", False, "other").id
    try:
        engine.launch(run, {"mine": 2})
        for job_id in (*over, lost, running, queued):
            engine.enqueue(job_id, "mine")
        engine.enqueue(foreign, "theirs")
        deadline = time.monotonic() + 120
        while (len(begun) < 5 or len(engine.over(9)) < 3) and time.monotonic() < deadline:
            time.sleep(0.01)
        before = rows_of_the_engine(engine)
        assert set(before) == {*over, running, lost, queued, foreign}
        assert forget_finished(store, engine) == 3
        assert set(rows_of_the_engine(engine)) == {running, lost, queued, foreign}
        assert [store.get(job_id).state for job_id in over] == ["failed"] * 3, "ours stay"
        hold.set()
        while engine.known([running, lost, queued]) and time.monotonic() < deadline:
            time.sleep(0.01)
        assert forget_finished(store, engine) == 2, "the lost one is still active for us"
        assert set(rows_of_the_engine(engine)) == {lost, foreign}
        assert forget_finished(store, engine) == 0
    finally:
        hold.set()
        engine.close()


def test_it_is_done_at_the_start_and_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(tmp_path)
    times, twice = [], threading.Event()

    def count(*_: object) -> int:
        times.append(1)
        if len(times) > 1:
            twice.set()
        return 0

    monkeypatch.setattr("loopwright.service.jobs.retention.delete_old_samples", count)
    retention = Retention(store, ThreadEngine(), RetentionPolicy(jobs=1), every_s=0.001, clock_check_s=0.001)
    retention.start()
    assert twice.wait(60)
    retention.close()
    for_ever = Retention(store, ThreadEngine(), RetentionPolicy(), every_s=0.001, clock_check_s=0.001)
    for_ever.start()
    for_ever.close()
    store.close()


class Clocks:
    """A wall clock that somebody sets, and the time that passes."""

    def __init__(self) -> None:
        self.wall, self.passed_s = datetime.now(UTC), 1000.0  # jobs are stored by the clock as it is

    def go_on(self, days: float) -> None:
        self.wall, self.passed_s = self.wall + timedelta(days=days), self.passed_s + 86400.0 * days

    def retention(self, store: Store, days: float = 30.0) -> Retention:
        """That of a service which is started now."""
        watch = ClockWatch(lambda: self.wall, lambda: self.passed_s)
        return Retention(store, ThreadEngine(), RetentionPolicy(days=days), watch=watch)


def clock_jumps() -> float:
    ((counted, *_),) = [metric.samples for metric in CLOCK_JUMPS.collect()]
    return counted.value


def once(retention: Retention) -> None:
    """One turn of its thread."""
    retention.check_clock()
    retention.tidy()


def test_a_clock_a_year_ahead_deletes_nothing(store: Store) -> None:
    ids = [job(store, "A", R, X, days_ago=days) for days in (40, 20, 1)]
    clocks = Clocks()
    retention, before = clocks.retention(store), clock_jumps()
    once(retention)
    assert kept(store, ids) == [False, True, True] and retention.note() is None
    clocks.wall += timedelta(days=365)  # and for three days nobody sees it
    for _ in range(3):
        clocks.go_on(1)
        once(retention)
        assert kept(store, ids) == [False, True, True]
    assert clock_jumps() == before + 1, "it is said once"
    note = retention.note()
    assert note is not None and "none are deleted for their age before" in note
    (told,) = [row for row in audit.trail(store.engine, 100) if row.what == "clock_jump"]
    assert told.after is not None and "jumped forward by 365 days" in told.after["text"]
    clocks.wall -= timedelta(days=365)
    once(retention)
    assert kept(store, ids) == [False, True, True]
    clocks.go_on(29)
    once(retention)
    assert kept(store, ids) == [False, True, True]
    clocks.go_on(1.1)  # thirty days that the service itself has seen
    once(retention)
    assert kept(store, ids) == [False, False, False] and retention.note() is None


def test_a_clock_that_jumped_while_the_service_was_stopped_deletes_nothing(store: Store) -> None:
    ids = [job(store, "A", R, X, days_ago=20)]
    clocks = Clocks()
    once(clocks.retention(store))
    clocks.wall += timedelta(days=365)
    for _ in range(2):  # the second start finds the clock where it was: the jump is remembered
        retention = clocks.retention(store)
        once(retention)
        assert kept(store, ids) == [True] and retention.note() is not None
    clocks.go_on(31)
    once(retention)
    assert kept(store, ids) == [False]


def test_before_the_first_look_the_jobs_say_what_time_it_was(store: Store) -> None:
    """A database of the version before, and a clock that is wrong at the very first start."""
    ids = [job(store, "A", R, X, days_ago=40), job(store, "A", R, X, days_ago=0)]
    with store.writing() as session:
        for job_id in ids:
            session.execute(update(JobRow).where(JobRow.id == job_id).values(created_at="2020-01-01T00:00:00.000Z"))
    clocks = Clocks()
    clocks.wall += timedelta(days=365)
    once(clocks.retention(store))
    assert kept(store, ids) == [True, True]


def test_what_a_clock_that_was_behind_has_stamped_is_not_old(store: Store) -> None:
    """A machine whose clock stands at 2020 until it hears of the time."""
    clocks = Clocks()
    retention = clocks.retention(store)
    once(retention)
    clocks.wall -= timedelta(days=2000)
    once(retention)
    ids = [job(store, "A", R, X, days_ago=2000)]
    clocks.wall += timedelta(days=2000)
    once(retention)
    assert kept(store, ids) == [True]
    clocks.go_on(31)
    once(retention)
    assert kept(store, ids) == [False]
