"""Tests of the time before alarms could be signed off: only those that nothing has followed wait for a person."""

from __future__ import annotations

from sqlalchemy import text

from loopwright.service.store import alarms
from loopwright.service.store.store import Store
from tests.unit.service.store.test_store import migrate

JOBS = (
    # id, loop, reason, dry_run, session, look_after
    ("followed", "A", "restore_unconfirmed", False, 1, False),
    ("later", "A", None, False, 2, False),
    ("last", "B", "restore_unconfirmed", False, 1, False),
    ("rehearsal", "B", None, True, None, False),
    ("refused", "B", "not_at_rest", False, None, False),
    ("looked-after", "C", "node_lost", False, 1, True),
    ("lost", "D", "node_lost", False, 1, False),
)


def test_what_a_later_test_has_followed_counts_as_signed_off(store: Store) -> None:
    insert = text(
        "INSERT INTO jobs (id, loop, state, dry_run, request, requested_by, created_at, ended_at, plant_time_s, reason,"
        " session, look_after) VALUES (:id, :loop, 'failed', :dry_run, '{}', 'me', '2026-01-01', '2026-01-02', 0,"
        " :reason, :session, :look_after)"
    )
    names = ("id", "loop", "reason", "dry_run", "session", "look_after")
    with store.engine.begin() as connection:
        migrate(connection, "0013")
        for job in JOBS:
            connection.execute(insert, dict(zip(names, job, strict=True)))
        migrate(connection, "head")
    found = alarms.unconfirmed(store)
    assert [(job.id, job.at, job.looked_after) for job in found] == [
        ("last", "2026-01-02", False), ("looked-after", "2026-01-02", True),
    ]  # fmt: skip
    with store.engine.begin() as connection:
        migrate(connection, "0013")
        migrate(connection, "head")
    assert alarms.unconfirmed(store) == found, "down and up again"
