from __future__ import annotations

from datetime import UTC, datetime, timedelta

from sqlalchemy import update

from loopwright.service.states.job_state import JobState
from loopwright.service.store.store import Store
from loopwright.service.store.tables import JobRow
from loopwright.service.store.under_test import times_under_test

NOW = datetime.now(UTC)


def job(store: Store, loop: str, ended_h: float | None, session: int | None = 1, dry_run: bool = False) -> str:
    """A job that began five hours ago, and ended so many hours ago."""
    row = store.create(loop, {}, "me", dry_run)
    store.move(row.id, JobState.RUNNING, session=session)
    if ended_h is not None:
        store.move(row.id, JobState.FAILED)
    times = {"started_at": NOW - timedelta(hours=5.0)} | (
        {} if ended_h is None else {"ended_at": NOW - timedelta(hours=ended_h)}
    )
    with store.writing() as session_:
        session_.execute(
            update(JobRow)
            .where(JobRow.id == row.id)
            .values({k: v.isoformat().replace("+00:00", "Z") for k, v in times.items()})
        )
    return row.id


def test_the_times_of_the_tests_of_some_loops(store: Store) -> None:
    old, recent = job(store, "A", 4.0), job(store, "A", 1.0)
    waiting, running = job(store, "B", None, session=None), job(store, "A", None)
    job(store, "A", 1.0, dry_run=True)
    job(store, "C", 1.0)
    since = times_under_test(store, ("A", "B"), NOW - timedelta(hours=2.0))
    assert [(each.job_id, each.session) for each in since] == [(recent, True), (waiting, False), (running, True)]
    now_s = NOW.timestamp()
    hours = [[(at - now_s) / 3600.0 for at in each.within(now_s - 36000.0, now_s) or ()] for each in since]
    assert [[round(at, 2) for at in each] for each in hours] == [[-5.0, -1.0], [-5.0, 0.0], [-5.0, 0.0]]
    assert since[0].within(now_s - 1800.0, now_s) is None
    assert [each.job_id for each in times_under_test(store, ("A", "B"))] == [waiting, running]
    assert len(times_under_test(store, ("A",), NOW - timedelta(hours=9.0))) == 3 and old
    assert times_under_test(store, ()) == []


def test_a_test_in_which_the_clock_was_put_back_may_have_begun_at_any_time_before_its_end(store: Store) -> None:
    """It ended, says the clock, before it began; when it began on the present time is not known."""
    ended = job(store, "A", 8.0)
    (found,) = times_under_test(store, ("A",), NOW - timedelta(hours=9.0))
    now_s = NOW.timestamp()
    within = found.within(now_s - 36000.0, now_s)
    assert found.job_id == ended and within is not None
    assert [round((at - now_s) / 3600.0, 2) for at in within] == [-10.0, -8.0]
