"""The watches of loops after gains were accepted, one for each acceptance."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from datetime import UTC, datetime

from sqlalchemy import select
from sqlalchemy.orm import Session

from loopwright.service.states.acceptance_watch import AcceptanceWatch, WatchEnd
from loopwright.service.store.clock import now, stamp
from loopwright.service.store.store import Store
from loopwright.service.store.tables import JobRow, LoopRow, WatchRow


@dataclass(frozen=True, slots=True)
class WatchWithAlarm:
    """A watch that has found something of which an alarm is made, with its job, loop and host."""

    job_id: str
    loop: str
    host: str
    watch: AcceptanceWatch


Change = Callable[[AcceptanceWatch], AcceptanceWatch]
"""Makes of a watch what it is from now on."""


def begin(session: Session, job: JobRow, watch: AcceptanceWatch) -> None:
    """Stores a new watch in the transaction of the acceptance, and ends those of earlier acceptances of the loop."""
    noticed = WatchRow.open.is_(True) | WatchRow.alarm.is_(True)
    for row in session.scalars(select(WatchRow).where(WatchRow.loop == job.loop, noticed)):
        if row.open:
            _set(row, ended(row.watch, WatchEnd.RETUNED))
        row.alarm = False  # what was said of it is of gains that are no longer in effect
    of_loop = select(JobRow.id).where(JobRow.loop == job.loop, JobRow.dry_run.is_(False))
    watch = watch.model_copy(update={"latest_job": session.scalar(of_loop.order_by(JobRow.number.desc()).limit(1))})
    session.merge(WatchRow(job_id=job.id, loop=job.loop, open=True, alarm=False, watch=watch))


def rolled_back(session: Session, job: JobRow) -> None:
    """Ends the watch in the transaction of the rollback; who has rolled back has seen what was wrong."""
    row = session.get(WatchRow, job.id)
    if row is not None:
        if row.open:
            _set(row, ended(row.watch, WatchEnd.ROLLED_BACK))
        row.alarm = False


def put_back(session: Session, job: JobRow) -> None:
    """As `rolled_back`, for the rollback of a watch by itself, which nobody has seen."""
    row = session.get(WatchRow, job.id)
    if row is not None:
        _set(row, ended(settled(row.watch, rolled_back=True, reason=None), WatchEnd.ROLLED_BACK))


def settled(watch: AcceptanceWatch, rolled_back: bool, reason: str | None) -> AcceptanceWatch:
    """The watch, which has found trouble, with what was done about it."""
    assert watch.trouble is not None
    trouble = watch.trouble.model_copy(update={"rolled_back": rolled_back, "reason": reason})
    return watch.model_copy(update={"trouble": trouble})


def ended(watch: AcceptanceWatch, why: WatchEnd) -> AcceptanceWatch:
    """The watch, ended now."""
    return watch.model_copy(update={"end": why, "ended_at": now()})


def set_back(watch: AcceptanceWatch, now_s: float) -> AcceptanceWatch:
    """The watch after the clock was set back, perhaps behind its beginning: what is heard from now on counts. now_s:
    wall time, s."""
    since = stamp(datetime.fromtimestamp(min(watch.since_s, now_s), UTC))
    return watch.model_copy(update={"since": since, "looked_to_s": min(watch.looked_to_s, now_s)})


def open_here(store: Store) -> dict[str, tuple[str, AcceptanceWatch]]:
    """Returns the loop and the watch of every acceptance on this host that is watched, by job. Raises
    SQLAlchemyError."""
    mine = select(WatchRow).join(LoopRow, LoopRow.tag == WatchRow.loop).where(LoopRow.host == store.host)
    with store.reading() as session:
        return {row.job_id: (row.loop, row.watch) for row in session.scalars(mine.where(WatchRow.open.is_(True)))}


def of_jobs(store: Store, job_ids: Collection[str]) -> dict[str, AcceptanceWatch]:
    """Returns the watches of these jobs, by job. Raises SQLAlchemyError."""
    if not job_ids:
        return {}
    with store.reading() as session:
        wanted = select(WatchRow).where(WatchRow.job_id.in_(job_ids))
        return {row.job_id: row.watch for row in session.scalars(wanted)}


def change(store: Store, job_id: str, make: Change) -> AcceptanceWatch | None:
    """Changes a watch that goes on, in a transaction of its own. Returns it as it is now; None: it has ended. Raises
    SQLAlchemyError, FolderInUse."""
    with store.writing() as session:
        row = session.scalars(select(WatchRow).where(WatchRow.job_id == job_id).with_for_update()).one_or_none()
        if row is None or not row.open:
            return None
        _set(row, make(row.watch))
        return row.watch


def settle(store: Store, job_id: str, make: Change) -> None:
    """Changes a watch that may have ended meanwhile. Raises SQLAlchemyError, FolderInUse."""
    with store.writing() as session:
        row = session.scalars(select(WatchRow).where(WatchRow.job_id == job_id).with_for_update()).one_or_none()
        if row is not None:
            _set(row, make(row.watch))


def with_alarm(store: Store) -> list[WatchWithAlarm]:
    """Returns the watches of every host of which an alarm is made, oldest first. Raises SQLAlchemyError."""
    wanted = (
        select(WatchRow, JobRow.host)
        .join(JobRow, JobRow.id == WatchRow.job_id)
        .where(WatchRow.alarm.is_(True))
        .order_by(JobRow.number)
    )
    with store.reading() as session:
        return [WatchWithAlarm(row.job_id, row.loop, host, row.watch) for row, host in session.execute(wanted)]


def _set(row: WatchRow, watch: AcceptanceWatch) -> None:
    row.watch, row.open, row.alarm = watch, watch.end is None, watch.alarm
