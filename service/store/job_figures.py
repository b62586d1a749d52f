"""What was computed of a job after its end, as bytes: its record with the model, and the designs."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import func, select

from loopwright.service.store.packed_figures import PackedFigures
from loopwright.service.store.store import Store
from loopwright.service.store.tables import ChunkRow, JobFiguresRow

_JOBS_AT_ONCE = 100


def keep(store: Store, job_id: str, version: int, figures: PackedFigures) -> None:
    """Stores the figures. The record is left out where the samples were deleted meanwhile.

    version: that of the computation.
    """
    with store.writing() as session:
        has_samples = session.scalar(select(ChunkRow.seq).where(ChunkRow.job_id == job_id).limit(1)) is not None
        record = figures.record if has_samples else None
        session.merge(JobFiguresRow(job_id=job_id, version=version, record=record, designs=figures.designs))


def kept(store: Store, job_id: str, version: int) -> PackedFigures | None:
    """Returns the figures that this version of the computation has stored; None where there are none."""
    with store.reading() as session:
        row = session.get(JobFiguresRow, job_id)
        return None if row is None or row.version != version else PackedFigures(row.record, row.designs)


def with_record(store: Store, job_ids: Sequence[str]) -> set[str]:
    """Returns those of these jobs of which two samples or more are stored. Of a long job, too, two blocks are looked
    at."""
    found: set[str] = set()
    with store.reading() as session:
        for begin in range(0, len(job_ids), _JOBS_AT_ONCE):
            first = (ChunkRow.job_id.in_(job_ids[begin : begin + _JOBS_AT_ONCE]), ChunkRow.seq <= 2)
            found |= set(
                session.scalars(
                    select(ChunkRow.job_id).where(*first).group_by(ChunkRow.job_id).having(func.sum(ChunkRow.count) > 1)
                )
            )
    return found
