"""Loops that somebody has locked: no test and no decision touches them until they are unlocked.

Whoever is about to begin one asks in the transaction in which it begins. There the row of the loop is held, so that on
a server a lock comes before or after it, and not beside it.
"""

from __future__ import annotations

from sqlalchemy import select
from sqlalchemy.orm import Session

from loopwright.service.errors import Locked, LockedOtherwise
from loopwright.service.store import audit
from loopwright.service.store.clock import now
from loopwright.service.store.tables import LoopLockRow, LoopRow


def lock(session: Session, loop: str, reason: str, by: str) -> LoopLockRow:
    """Locks the loop. Asked again with the same reason it stays as it is. Raises LockedOtherwise."""
    _hold(session, loop)
    row = session.get(LoopLockRow, loop)
    if row is None:
        row = LoopLockRow(loop=loop, reason=reason, by=by, since=now())
        session.add(row)
        audit.record(session, "lock", loop, after=_shown(row), loop=loop, by=by)
    elif row.reason != reason:
        raise LockedOtherwise(words(row))
    return row


def unlock(session: Session, loop: str, by: str) -> LoopLockRow | None:
    """What the loop was locked for; None: it was not."""
    _hold(session, loop)
    row = session.get(LoopLockRow, loop)
    if row is not None:
        session.delete(row)
        audit.record(session, "unlock", loop, before=_shown(row), loop=loop, by=by)
    return row


def check(session: Session, loop: str) -> None:
    """Raises Locked. Until the transaction ends nobody locks the loop."""
    _hold(session, loop, read=True)
    row = session.get(LoopLockRow, loop)
    if row is not None:
        raise Locked(words(row))


def every(session: Session) -> dict[str, LoopLockRow]:
    """The locks by loop, of every host."""
    return {row.loop: row for row in session.scalars(select(LoopLockRow))}


def _hold(session: Session, loop: str, read: bool = False) -> None:
    """SQLite has one writer at a time anyway."""
    session.execute(select(LoopRow.tag).where(LoopRow.tag == loop).with_for_update(read=read))


def _shown(row: LoopLockRow) -> dict[str, str]:
    return {"reason": row.reason, "by": row.by, "since": row.since}


def words(row: LoopLockRow) -> str:
    """Who has locked the loop, since when and why."""
    return f"loop {row.loop} is locked by {row.by} since {row.since}: {row.reason}"
