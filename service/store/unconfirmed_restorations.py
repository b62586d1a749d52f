"""The loops that are monitored: those of jobs whose end did not confirm that they were restored, until they are or
somebody says so.

The column is `JobRow.restore_unconfirmed`; everything that ends it writes an event of the job.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sqlalchemy import distinct, func, select
from sqlalchemy.orm import Session

from loopwright.service.jsonable import json_object
from loopwright.service.store import alarms, audit, false_pv
from loopwright.service.store.job_rows import append, set_columns
from loopwright.service.store.jobs import Job, JobColumns
from loopwright.service.store.journal_writes import Write
from loopwright.service.store.store import Store
from loopwright.service.store.tables import JobRow


def rows(store: Store, loop: str | None = None) -> Sequence[Job]:
    """The jobs of this host with a loop not confirmed as restored, or those of one loop on whatever host; the latest
    first."""
    mine = JobRow.host == store.host if loop is None else JobRow.loop == loop
    with store.reading() as session:
        wanted = select(JobRow).where(mine, JobRow.restore_unconfirmed.is_(True)).order_by(JobRow.number.desc())
        return [Job.from_row(row) for row in session.scalars(wanted)]


def count(session: Session, host: str) -> int:
    """How many loops of a host are not confirmed as restored."""
    wanted = select(func.count(distinct(JobRow.loop))).where(JobRow.host == host, JobRow.restore_unconfirmed.is_(True))
    return session.scalar(wanted) or 0


def confirmed(store: Store, job_id: str, restored: Mapping[str, object], text: str, held: bool = False) -> bool:
    """The loop was read back. False when somebody else was faster to end it.

    held: whether it is held in manual, because its PV was found to be false."""
    with store.writing() as session:
        wanted = select(JobRow).where(JobRow.id == job_id, JobRow.restore_unconfirmed.is_(True)).with_for_update()
        row = session.scalars(wanted).one_or_none()
        if row is None:
            return False
        row.restore_unconfirmed, row.restored, row.false_pv = False, json_object(restored), row.false_pv or held
        append(session, row.id, "loop_found", {"text": text}, row.plant_time_s)
        return True


def opened(job_id: str, columns: JobColumns) -> Write:
    """The job has opened a session of its own: the restoration after earlier jobs is not looked for any more. columns:
    what else is now known of the job."""
    text = f"monitored no more: job {job_id} has opened a session on the loop"

    def write(session: Session) -> None:
        job = session.scalars(select(JobRow).where(JobRow.id == job_id).with_for_update()).one()
        set_columns(job, columns)
        for row in _of_loop(session, job.loop):
            if row.id != job_id:
                row.restore_unconfirmed = False
                append(session, row.id, "loop_found", {"text": text}, row.plant_time_s)

    return write


def acknowledged(store: Store, loop: str, by: str) -> list[str]:
    """A person answers for the loop. Returns the ids of the jobs after which it was not confirmed as restored, or that
    had found its PV to be false."""
    with store.writing() as session:
        false = false_pv.not_acknowledged(session, loop, lock=True)
        found = {row.id: row for row in (*_of_loop(session, loop), *false)}
        for row in found.values():
            before = {"restore_unconfirmed": row.restore_unconfirmed, "reason": row.reason}
            append(session, row.id, "acknowledged", {"by": by}, row.plant_time_s)
            audit.record(
                session,
                "acknowledge",
                row.id,
                before=before,
                after={"restore_unconfirmed": False},
                loop=loop,
                by=by,
            )
            if row.restore_unconfirmed:
                row.restore_unconfirmed = False
                alarms.acknowledged_with(session, row, alarms.NOT_RESTORED, by)
            if row in false:
                alarms.acknowledged_with(session, row, false_pv.FALSE_PV, by)
        return list(found)


def _of_loop(session: Session, loop: str) -> Sequence[JobRow]:
    wanted = select(JobRow).where(JobRow.loop == loop, JobRow.restore_unconfirmed.is_(True)).order_by(JobRow.number)
    return session.scalars(wanted.with_for_update()).all()
