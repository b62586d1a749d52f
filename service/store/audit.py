"""The audit log: who changed what, when, from what, to what. Written in the transaction of the change itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sqlalchemy import Engine, select
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
    said_by: str | None = None,
) -> None:
    """Adds a row for the present principal. what: retune, abort, accept, rollback, key_create, ...; subject: the id of
    the job or key."""
    who = current.get()
    session.add(
        AuditRow(
            at=now(), who=who.name, key_id=who.key_id, address=who.address, said_by=said_by, what=what,
            subject=subject, loop=loop, before=before, after=after,
        )
    )  # fmt: skip


def trail(
    engine: Engine, limit: int, before: int | None = None, what: str | None = None, loop: str | None = None
) -> Sequence[AuditRow]:
    """The latest rows first; before: only those with a smaller number."""
    wanted = select(AuditRow).order_by(AuditRow.number.desc()).limit(limit)
    if before is not None:
        wanted = wanted.where(AuditRow.number < before)
    if what is not None:
        wanted = wanted.where(AuditRow.what == what)
    if loop is not None:
        wanted = wanted.where(AuditRow.loop == loop)
    with Session(engine) as session:
        return session.scalars(wanted).all()
