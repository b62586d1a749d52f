from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import create_engine

from service.states import MOVES, IllegalMove, JobState, check
from service.store.store import Busy, FolderInUse, NoSuchJob, Store
from service.store.tables import Base
from tuning.plan import Sample


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    store = Store(tmp_path)
    yield store
    store.close()


def test_migrations_make_the_tables_of_the_code(store: Store, tmp_path: Path) -> None:
    engine = create_engine(f"sqlite:///{tmp_path / 'loopwright.sqlite'}")
    with engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), Base.metadata) == []
    engine.dispose()


def test_wal_and_the_index_hold_in_the_database_itself(store: Store, tmp_path: Path) -> None:
    store.create("A", {}, "me", False)
    connection = sqlite3.connect(tmp_path / "loopwright.sqlite")
    assert connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)
    copy = (
        "INSERT INTO jobs (id, loop, state, dry_run, request, requested_by, created_at, plant_time_s)"
        " SELECT 'x', loop, 'running', dry_run, request, requested_by, created_at, 0 FROM jobs"
    )
    with pytest.raises(sqlite3.IntegrityError):
        connection.execute(copy)
    connection.close()


def test_one_active_job_per_loop(store: Store) -> None:
    first = store.create("A", {}, "me", False)
    with pytest.raises(Busy) as caught:
        store.create("A", {}, "you", False)
    assert caught.value.job_id == first.id
    store.create("A", {}, "you", True)
    store.create("B", {}, "you", False)
    store.move(first.id, JobState.RUNNING)
    with pytest.raises(Busy):
        store.create("A", {}, "you", False)
    store.move(first.id, JobState.PROPOSED)
    store.create("A", {}, "you", False)
    assert [row.loop for row in store.recent()] == ["A", "B", "A", "A"]


def test_what_was_written_is_there_after_reopening(tmp_path: Path) -> None:
    store = Store(tmp_path)
    job = store.create("A", {"sp_deviation": float("nan")}, "me", False)
    store.move(job.id, JobState.RUNNING)
    store.close()
    store = Store(tmp_path)
    row = store.get(job.id)
    assert row.state == "running" and row.request == {"sp_deviation": None} and row.started_at
    assert [event.seq for event in store.events(job.id)] == [1, 2]
    assert [event.kind for event in store.events(job.id, after=1)] == ["state"]
    store.close()


def test_a_data_folder_has_one_service(store: Store, tmp_path: Path) -> None:
    with pytest.raises(FolderInUse):
        Store(tmp_path)


def test_samples_come_back(store: Store) -> None:
    job = store.create("A", {}, "me", False)
    samples = [Sample(86400.0 + 0.02 * n, 50.0, 50.0 + 0.001 * n, 41.3, n % 4) for n in range(5000)]
    store.add_samples(job.id, "relay", samples[:4096])
    store.add_samples(job.id, "verify", samples[4096:])
    blocks = store.samples(job.id)
    assert [(stage, len(block)) for stage, block in blocks] == [("relay", 4096), ("verify", 904)]
    back = [sample for _, block in blocks for sample in block]
    for one, other in zip(back, samples, strict=True):
        assert one == pytest.approx(other, rel=1e-7)
    assert [stage for stage, _ in store.samples(job.id, "verify")] == ["verify"]


def test_unknown_job(store: Store) -> None:
    with pytest.raises(NoSuchJob):
        store.get("none")


@pytest.mark.parametrize("now", list(JobState))
@pytest.mark.parametrize("wanted", list(JobState))
def test_only_the_moves_of_the_table(store: Store, now: JobState, wanted: JobState) -> None:
    if wanted in MOVES[now]:
        check(now, wanted)
    else:
        with pytest.raises(IllegalMove):
            check(now, wanted)


def test_nothing_leaves_an_end_and_every_state_can_be_reached() -> None:
    reachable = {JobState.QUEUED}.union(*MOVES.values())
    assert reachable == set(JobState)
    for end in ("rolled_back", "refused", "aborted", "failed", "interrupted"):
        assert not MOVES[JobState(end)]
