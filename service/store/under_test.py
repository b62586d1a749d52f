"""When loops were under test."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import select

from loopwright.service.states.job_state import ACTIVE
from loopwright.service.store.clock import stamp
from loopwright.service.store.store import Store
from loopwright.service.store.tables import JobRow

_ACTIVE = [state.value for state in ACTIVE]


@dataclass(frozen=True, slots=True)
class TimeUnderTest:
    """A time in which a job had a loop, seconds since 1970 UTC.

    from_s: minus infinity where the clock was put back meanwhile: what the begin is on the present time is not known.
    to_s: None where the job still has the loop.
    session: whether it has opened a session, before which it moves nothing.
    """

    loop: str
    job_id: str
    from_s: float
    to_s: float | None
    session: bool

    def within(self, from_s: float, to_s: float) -> tuple[float, float] | None:
        """Returns the part of it within another time; None where there is none."""
        begin, end = max(self.from_s, from_s), to_s if self.to_s is None else min(self.to_s, to_s)
        return (begin, end) if begin < end else None


def times_under_test(store: Store, loops: Collection[str], since: datetime | None = None) -> Sequence[TimeUnderTest]:
    """Returns the times in which jobs had these loops, of any host, oldest first; dry runs have none.

    since: the end of the earliest one; None: only those that go on.
    """
    active = JobRow.state.in_(_ACTIVE)
    going_on = active if since is None else active | (JobRow.ended_at >= stamp(since))
    columns = JobRow.loop, JobRow.id, JobRow.created_at, JobRow.started_at, JobRow.ended_at, JobRow.session
    wanted = select(*columns).where(JobRow.loop.in_(loops), JobRow.dry_run.is_(False), going_on)
    with store.reading() as session:
        rows = session.execute(wanted.order_by(JobRow.number)).all()
    return [
        TimeUnderTest(
            row.loop,
            row.id,
            *_begin_and_end(row.started_at or row.created_at, row.ended_at),
            row.session is not None,
        )
        for row in rows
    ]


def _begin_and_end(began_at: str, ended_at: str | None) -> tuple[float, float | None]:
    if ended_at is None:
        return _seconds(began_at), None
    return _seconds(began_at) if began_at <= ended_at else -math.inf, _seconds(ended_at)


def _seconds(at: str) -> float:
    return datetime.fromisoformat(at).timestamp()
