"""The audit log: who changed what, when, from what, to what. Written in the transaction of the change itself."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from sqlalchemy import Engine, func, or_, select
from sqlalchemy.orm import Session

from loopwright.service.security.principal import current
from loopwright.service.store.clock import now
from loopwright.service.store.tables import AuditRow


def record(
    session: Session,
    what: str,
    subject: str,
    *,
    before: Mapping[str, object] | None = None,
    after: Mapping[str, object] | None = None,
    loop: str | None = None,
    by: str | None = None,
    at: str | None = None,
) -> None:
    """Adds a row for the present principal. what: retune, abort, accept, rollback, key_create, ...; subject: the id of
    the job or key; at: when it was done, None for now."""
    who = current.get()
    session.add(
        AuditRow(
            at=at or now(), key=who.name, key_id=who.key_id, address=who.address, gateway=who.gateway, by=by,
            what=what, subject=subject, loop=loop, before=before, after=after,
        )
    )  # fmt: skip


def latest(session: Session) -> int:
    """Returns the number of the latest row; 0: there is none."""
    return session.scalar(select(func.max(AuditRow.number))) or 0


def trail(
    engine: Engine,
    limit: int,
    before: int | None = None,
    what: Collection[str] | None = None,
    loop: str | None = None,
    who: str | None = None,
    from_at: str | None = None,
) -> Sequence[AuditRow]:
    """Returns the latest rows first.

    before: only those with a smaller number.  what: only these kinds.  who: only those with this name, of the key or as
    given in the request.  from_at: only those from this time on, UTC, as in the table.
    """
    wanted = select(AuditRow).order_by(AuditRow.number.desc()).limit(limit)
    if before is not None:
        wanted = wanted.where(AuditRow.number < before)
    if what is not None:
        wanted = wanted.where(AuditRow.what.in_(what))
    if loop is not None:
        wanted = wanted.where(AuditRow.loop == loop)
    if who is not None:
        wanted = wanted.where(or_(AuditRow.key == who, AuditRow.by == who))
    if from_at is not None:
        wanted = wanted.where(AuditRow.at >= from_at)
    with Session(engine) as session:
        return session.scalars(wanted).all()
