"""What was known of a loop from operation as a job began, so that a resumed job begins with the same."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import func, select, update

from loopwright.service.store.clock import stamp
from loopwright.service.store.store import Store
from loopwright.service.store.tables import JobKnowledgeRow


def keep(store: Store, job_id: str, loop: str, data: bytes) -> None:
    """Stores what is known as the job begins."""
    with store.writing() as session:
        session.merge(JobKnowledgeRow(job_id=job_id, loop=loop, data=data))


def kept(store: Store, job_id: str) -> bytes | None:
    """Returns what was known as the job began; None where nothing was stored, or it was deleted with the samples."""
    with store.reading() as session:
        return session.scalar(select(JobKnowledgeRow.data).where(JobKnowledgeRow.job_id == job_id))


def outdated(store: Store, job_id: str, at: datetime) -> None:
    """Stores that the trial of the job has shown another plant than operation before it."""
    with store.writing() as session:
        row = update(JobKnowledgeRow).where(JobKnowledgeRow.job_id == job_id)
        session.execute(row.values(outdated_at=stamp(at)))


def outdated_until_s(store: Store, loop: str) -> float | None:
    """Returns the time up to which the history of a loop is of another plant, seconds since 1970 UTC; None where no
    trial has shown such a change."""
    with store.reading() as session:
        at = session.scalar(select(func.max(JobKnowledgeRow.outdated_at)).where(JobKnowledgeRow.loop == loop))
    return None if at is None else datetime.fromisoformat(at).timestamp()
