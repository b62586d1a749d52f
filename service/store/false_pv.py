"""The tests that have found PV to be false: no other begins on the loop until a person has acknowledged it, which is to
acknowledge its alarm.

A loop that was in automatic is in manual since, and nothing of ours takes it back. The column is `JobRow.false_pv`.
"""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import Select, select
from sqlalchemy.orm import Session

from loopwright.service.errors import NotAcknowledged
from loopwright.service.store.tables import AlarmAcknowledgementRow, JobRow

FALSE_PV = "false_pv"
"""The kind of its alarm."""


def check(session: Session, loop: str) -> None:
    """Raises NotAcknowledged."""
    job = session.scalars(_not_acknowledged().where(JobRow.loop == loop)).first()
    if job is not None:
        raise NotAcknowledged(words(job))


def not_acknowledged(session: Session, loop: str | None = None, lock: bool = False) -> Sequence[JobRow]:
    """Returns the tests of every host, or of one loop, that nobody has acknowledged, oldest first.

    lock: nobody else changes them or appends to them before this transaction ends."""
    wanted = _not_acknowledged() if loop is None else _not_acknowledged().where(JobRow.loop == loop)
    return session.scalars(wanted.with_for_update() if lock else wanted).all()


def words(job: JobRow) -> str:
    """Returns what was found, and how it is acknowledged."""
    return (
        f"job {job.id} found PV of loop {job.loop} to be false at {job.ended_at}, and nobody has acknowledged that: "
        f"check the sensor and the loop's mode, then acknowledge the alarm, or: loopwright acknowledge {job.loop}"
    )


def _not_acknowledged() -> Select[JobRow]:
    signed = select(AlarmAcknowledgementRow.job_id).where(
        AlarmAcknowledgementRow.job_id == JobRow.id, AlarmAcknowledgementRow.kind == FALSE_PV
    )
    return select(JobRow).where(JobRow.false_pv.is_(True), ~signed.exists()).order_by(JobRow.number)
