from __future__ import annotations

import threading
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from service.retention import Keep, Retention, tidy
from service.security import audit
from service.states import JobState
from service.store.store import Store
from tuning.plan import Sample

NOW = datetime.now(UTC)


@pytest.fixture(params=["sqlite", "postgresql"])
def store(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Store]:
    database = None if request.param == "sqlite" else request.getfixturevalue("postgres").database()
    store = Store(tmp_path, database)
    yield store
    store.close()


def job(store: Store, loop: str, *states: JobState, dry: bool = False, days_ago: float = 0.0, host: str = "") -> str:
    """A job with ten samples that went through these states and ended so long ago."""
    row = store.create(loop, {}, "me", dry, host or None)
    store.add_samples(row.id, "relay", [Sample(0.1 * n, 50.0, 50.0, 40.0, 2) for n in range(10)])
    for state in states:
        ended = (NOW - timedelta(days=days_ago)).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        store.move(row.id, state)
        if state is not JobState.RUNNING:
            with store.writing() as session:
                session.merge(store.get(row.id)).ended_at = ended
    return row.id


def kept(store: Store, ids: list[str]) -> list[bool]:
    return [bool(store.samples(job_id)) for job_id in ids]


R, P, X = JobState.RUNNING, JobState.PROPOSED, JobState.FAILED


def test_the_newest_jobs_of_each_loop_keep_theirs(store: Store) -> None:
    a = [job(store, "A", R, X) for _ in range(4)]
    b = [job(store, "B", R, X)]
    dry = [job(store, "A", R, X, dry=True) for _ in range(3)]  # do not push the experiments out
    foreign = [job(store, "C", R, X, host="other") for _ in range(3)]
    assert tidy(store, Keep(jobs=2)) == 3
    assert kept(store, a) == [False, False, True, True] and kept(store, b) == [True]
    assert kept(store, dry) == [False, True, True] and all(kept(store, foreign))
    assert tidy(store, Keep(jobs=2)) == 0


def test_active_and_proposed_jobs_keep_theirs_always(store: Store) -> None:
    proposed, decided = job(store, "A", R, P, days_ago=99), job(store, "A", R, P, JobState.ACCEPTED, days_ago=99)
    declined, queued = job(store, "A", R, P, JobState.ROLLED_BACK, days_ago=99), job(store, "B")
    running = job(store, "A", R)
    newer = job(store, "C", R, X, days_ago=0.5)
    assert tidy(store, Keep(days=1.0), NOW) == 2
    assert kept(store, [proposed, decided, declined, queued, running, newer]) == [True, False, False, True, True, True]


def test_one_reason_is_enough_to_keep(store: Store) -> None:
    ids = [job(store, "A", R, X, days_ago=days) for days in (9, 8, 0.5, 0.4)]
    assert tidy(store, Keep(jobs=1, days=1.0), NOW) == 2 and kept(store, ids) == [False, False, True, True]
    assert tidy(store, Keep(), NOW + timedelta(days=1e4)) == 0


def test_what_is_deleted_is_written_down_and_the_rest_of_the_job_stays(store: Store) -> None:
    ids = [job(store, "A", R, X) for _ in range(121)]
    assert tidy(store, Keep(jobs=1)) == 120, "in several transactions"
    rows = [row for row in audit.trail(store.engine, 1000) if row.what == "samples_delete"]
    told = [(row.who, row.before, row.after) for row in reversed(rows)]
    assert [before and (len(before["jobs"]), before["samples"]) for _, before, _ in told] == [
        (50, 500), (50, 500), (20, 200),
    ]  # fmt: skip
    assert told[0][0] == "service" and told[0][2] == {"kept": "samples are kept of the newest 1 jobs of each loop"}
    assert [event.kind for event in store.events(ids[0])] == ["state", "state", "state", "samples_deleted"]
    assert store.get(ids[0]).state == "failed"


def test_it_is_done_at_the_start_and_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(tmp_path)
    times, twice = [], threading.Event()

    def count(*_: object) -> int:
        times.append(1)
        if len(times) > 1:
            twice.set()
        return 0

    monkeypatch.setattr("service.retention.tidy", count)
    retention = Retention(store, Keep(jobs=1), every_s=0.001)
    retention.start()
    assert twice.wait(5)
    retention.close()
    for_ever = Retention(store, Keep(), every_s=0.001)
    for_ever.start()
    for_ever.close()
    store.close()
