"""What a screen shows of the jobs, in a few light queries: the live ones, the latest of each loop, new events."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy import and_, func, or_, select

from loopwright.service.job_states import ACTIVE, JobState
from loopwright.service.store.jobs import JobEvent
from loopwright.service.store.store import Store
from loopwright.service.store.tables import EventRow, JobRow

_ACTIVE = [state.value for state in ACTIVE]
_EVENTS_AT_ONCE = 2000


@dataclass(frozen=True, slots=True)
class JobInBrief:
    """A job without its request and its result. stopping: whether somebody has asked it to stop."""

    id: str
    loop: str
    host: str
    state: JobState
    dry_run: bool
    requested_by: str
    stage: str | None
    plant_time_s: float
    stopping: bool


_BRIEF = select(
    JobRow.id, JobRow.loop, JobRow.host, JobRow.state, JobRow.dry_run, JobRow.requested_by, JobRow.stage,
    JobRow.plant_time_s, JobRow.stop_reason.is_not(None),
)  # fmt: skip


def live_jobs(store: Store) -> list[JobInBrief]:
    """Returns the jobs in an active state, of every host, dry runs included, oldest first."""
    with store.reading() as session:
        rows = session.execute(_BRIEF.where(JobRow.state.in_(_ACTIVE)).order_by(JobRow.number))
        return [JobInBrief(*row) for row in rows]


def latest_jobs(store: Store) -> dict[str, JobInBrief]:
    """Returns the latest job by loop, of every host; dry runs do not count."""
    last = select(func.max(JobRow.number)).where(JobRow.dry_run.is_(False)).group_by(JobRow.loop)
    with store.reading() as session:
        rows = session.execute(_BRIEF.where(JobRow.number.in_(last)))
        found = [JobInBrief(*row) for row in rows]
    return {job.loop: job for job in found}


def new_events(store: Store, after: Mapping[str, int]) -> Sequence[JobEvent]:
    """Returns the events of these jobs that come after the given numbers, in order."""
    if not after:
        return []
    of_each = (and_(EventRow.job_id == job_id, EventRow.seq > seq) for job_id, seq in after.items())
    wanted = select(EventRow).where(or_(*of_each)).order_by(EventRow.job_id, EventRow.seq).limit(_EVENTS_AT_ONCE)
    with store.reading() as session:
        return [JobEvent.from_row(event) for event in session.scalars(wanted)]
