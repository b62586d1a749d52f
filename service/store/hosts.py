"""What a host has seen its clock say."""

from __future__ import annotations

import threading
from datetime import UTC, datetime, timedelta

from sqlalchemy import func, select

from loopwright.service.store import audit
from loopwright.service.store.clock import stamp
from loopwright.service.store.clock_watch import ClockWatch, Jump, Seen
from loopwright.service.store.store import Store, of_host
from loopwright.service.store.tables import HostRow, JobRow


def last_seen(store: Store) -> Seen | None:
    """What the clock said when it was last looked at; before there was such a look, when a job last began or ended."""
    with store.reading() as session:
        row = session.get(HostRow, store.host)
        if row is not None and row.seen_at is not None:
            return Seen(_time(row.seen_at), _time(row.ages_from) if row.ages_from else None)
        latest = select(func.max(JobRow.created_at), func.max(JobRow.ended_at)).where(JobRow.host == store.host)
        times = [each for each in session.execute(latest).one() if each]
        return Seen(_time(max(times))) if times else None


def keep_seen(store: Store, seen: Seen, jump: Jump | None) -> None:
    """Writes down what was seen, and in the audit log that the clock has jumped."""
    with store.writing() as session:
        row = of_host(session, store.host)
        row.seen_at = stamp(seen.at)
        row.ages_from = stamp(seen.ages_from) if seen.ages_from else None
        if jump is not None:
            before, after = {"expected": stamp(jump.expected)}, {"clock": stamp(jump.to), "text": jump.text}
            audit.record(session, "clock_jump", "retention", before=before, after=after)


class Ages:
    """What may be taken for old: nothing counts as older than the last jump of the clock. The clock is looked at as
    this is asked, because what is written down of it is up to a minute old.

    longest: how long the service may have been stopped and its clock still be believed.
    Made before the retention writes down what the clock says now. Raises SQLAlchemyError.
    """

    def __init__(self, store: Store, longest: timedelta, clock: ClockWatch | None = None) -> None:
        self._clock, self._longest = clock or ClockWatch(), longest
        self._lock = threading.Lock()
        self._clock.look(last_seen(store), longest)

    def before(self, at: datetime, age: timedelta) -> datetime | None:
        """What is from before this time is older than that at the present `at`; None: nothing is known to be."""
        with self._lock:
            self._clock.look(None, self._longest)
            seen = self._clock.seen
        from_ = None if seen is None else seen.ages_from
        return None if from_ is not None and from_ > at - age else at - age


def _time(text: str) -> datetime:
    return datetime.fromisoformat(text).astimezone(UTC)
