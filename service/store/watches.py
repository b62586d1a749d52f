"""The watches of loops after gains were accepted, one for each acceptance."""

from __future__ import annotations

from collections.abc import Callable, Collection

from sqlalchemy import select
from sqlalchemy.orm import Session

from loopwright.service.states.acceptance_watch import AcceptanceWatch, WatchEnd
from loopwright.service.store.clock import now
from loopwright.service.store.store import Store
from loopwright.service.store.tables import JobRow, LoopRow, WatchRow

Change = Callable[[AcceptanceWatch], AcceptanceWatch]
"""Makes of a watch what it is from now on."""


def begin(session: Session, job: JobRow, watch: AcceptanceWatch) -> None:
    """Stores a new watch in the transaction of the acceptance, and ends those of earlier acceptances of the loop."""
    for row in session.scalars(select(WatchRow).where(WatchRow.loop == job.loop, WatchRow.open.is_(True))):
        _set(row, ended(row.watch, WatchEnd.RETUNED))
    session.merge(WatchRow(job_id=job.id, loop=job.loop, open=True, watch=watch))


def rolled_back(session: Session, job: JobRow) -> None:
    """Ends the watch in the transaction of the rollback."""
    row = session.get(WatchRow, job.id)
    if row is not None and row.open:
        _set(row, ended(row.watch, WatchEnd.ROLLED_BACK))


def ended(watch: AcceptanceWatch, why: WatchEnd) -> AcceptanceWatch:
    """The watch, ended now."""
    return watch.model_copy(update={"end": why, "ended_at": now()})


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


def _set(row: WatchRow, watch: AcceptanceWatch) -> None:
    row.watch, row.open = watch, watch.end is None
