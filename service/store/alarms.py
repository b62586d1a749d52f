"""What the database tells of alarms: tests whose loop was not confirmed to be as before, and what was acknowledged."""

from __future__ import annotations

import hashlib
from collections.abc import Collection
from dataclasses import dataclass

from sqlalchemy import func, or_, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from loopwright.service.jsonable import JsonObject
from loopwright.service.store import audit, idempotency_effects
from loopwright.service.store.clock import now
from loopwright.service.store.false_pv import FALSE_PV, not_acknowledged
from loopwright.service.store.store import Store
from loopwright.service.store.tables import AlarmAcknowledgementRow, JobRow
from loopwright.tuning.reasons import Reason

NOT_RESTORED = "not_restored"
"""The kind of the alarm that a loop is not confirmed to be as before a test."""
NOT_RESTORED_TEXT = "Not confirmed that the loop is as before the test"
_TEXTS = {NOT_RESTORED: NOT_RESTORED_TEXT, FALSE_PV: "The test found PV to be false"}


class AlreadyAcknowledged(Exception):
    """Somebody has acknowledged the alarm before."""

    def __init__(self, row: AlarmAcknowledgementRow) -> None:
        super().__init__(f"alarm {row.alarm_id} was acknowledged by {row.by} at {row.at}: {row.text}")


@dataclass(frozen=True, slots=True)
class FalsePvJob:
    """A test that has found PV to be false, which nobody has acknowledged.

    at: when it ended: UTC, ISO 8601.
    restored: the loop as read back; None: it was not.
    """

    id: str
    loop: str
    host: str
    at: str
    reason: Reason | None
    restored: JsonObject | None


@dataclass(frozen=True, slots=True)
class UnconfirmedJob:
    """A test at whose end the loop was not confirmed to be as before, and that nobody has acknowledged.

    at: when it ended: UTC, ISO 8601.
    monitored: whether the loop is still looked at until it is as before.
    """

    id: str
    loop: str
    host: str
    at: str
    reason: Reason | None
    monitored: bool


def alarm_id(*parts: str) -> str:
    """Returns the id of an alarm: the same on every gateway, and after a restart. parts: kind and subject."""
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:12]


def unconfirmed(store: Store) -> list[UnconfirmedJob]:
    """Returns those of every host, oldest first. Raises SQLAlchemyError."""
    signed = select(AlarmAcknowledgementRow.job_id).where(
        AlarmAcknowledgementRow.job_id == JobRow.id, AlarmAcknowledgementRow.kind == NOT_RESTORED
    )
    wanted = (
        select(
            JobRow.id, JobRow.loop, JobRow.host, func.coalesce(JobRow.ended_at, JobRow.created_at), JobRow.reason,
            JobRow.restore_unconfirmed,
        )
        .where(
            or_(JobRow.reason == Reason.RESTORE_UNCONFIRMED, JobRow.restore_unconfirmed.is_(True)),
            JobRow.dry_run.is_(False),
            ~signed.exists(),
        )
        .order_by(JobRow.number)
    )  # fmt: skip
    with store.reading() as session:
        return [UnconfirmedJob(*row) for row in session.execute(wanted)]


def false_pvs(store: Store) -> list[FalsePvJob]:
    """Returns those of every host, oldest first. Raises SQLAlchemyError."""
    with store.reading() as session:
        return [
            FalsePvJob(job.id, job.loop, job.host, job.ended_at or job.created_at, job.reason, job.restored)
            for job in not_acknowledged(session)
        ]


def acknowledged(store: Store, alarms: Collection[str]) -> frozenset[str]:
    """Returns which of these alarms were acknowledged. Raises SQLAlchemyError."""
    with store.reading() as session:
        wanted = select(AlarmAcknowledgementRow.alarm_id).where(AlarmAcknowledgementRow.alarm_id.in_(alarms))
        return frozenset(session.scalars(wanted))


def find(store: Store, wanted: str) -> AlarmAcknowledgementRow | None:
    """Returns an alarm that was acknowledged; None: it was not."""
    with store.reading() as session:
        return session.get(AlarmAcknowledgementRow, wanted)


def acknowledge(store: Store, row: AlarmAcknowledgementRow) -> AlarmAcknowledgementRow:
    """Stores that an alarm is acknowledged, with its entry in the audit log. Raises AlreadyAcknowledged."""
    try:
        with store.writing() as session:
            earlier = session.get(AlarmAcknowledgementRow, row.alarm_id)
            if earlier is not None:
                raise AlreadyAcknowledged(earlier)
            _add(session, row)
            idempotency_effects.changed(session, f"/alarms/{row.alarm_id}")
    except IntegrityError:  # another gateway was faster by a moment
        faster = find(store, row.alarm_id)
        if faster is None:
            raise
        raise AlreadyAcknowledged(faster) from None
    return row


def acknowledged_with(session: Session, job: JobRow, kind: str, by: str) -> None:
    """Acknowledges an alarm within a transaction in which a person answers for the loop, unless it was before.

    kind: NOT_RESTORED, FALSE_PV.
    """
    of_it = select(AlarmAcknowledgementRow).where(
        AlarmAcknowledgementRow.job_id == job.id, AlarmAcknowledgementRow.kind == kind
    )
    if session.scalars(of_it).first() is None:
        _add(
            session,
            AlarmAcknowledgementRow(
                alarm_id=alarm_id(kind, job.id), priority=1, kind=kind, host=job.host, loop=job.loop, job_id=job.id,
                text=_TEXTS[kind], since=job.ended_at or job.created_at, by=by, at=now(),
            ),
        )  # fmt: skip


def _add(session: Session, row: AlarmAcknowledgementRow) -> None:
    session.add(row)
    session.flush()
    before = {"priority": row.priority, "kind": row.kind, "text": row.text, "since": row.since, "job": row.job_id}
    audit.record(session, "acknowledge_alarm", row.alarm_id, before=before, loop=row.loop, by=row.by)
