"""What a screen shows of the jobs, in a few light queries: the live ones, the latest of each loop, new events."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy import and_, func, or_, select

from loopwright.service.states.job_state import ACTIVE, JobState
from loopwright.service.store.events import events
from loopwright.service.store.jobs import JobEvent
from loopwright.service.store.store import Store
from loopwright.service.store.tables import EventRow, JobRow, LoopRow
from loopwright.tuning.gains import Gains
from loopwright.tuning.reasons import Reason

_ACTIVE = [state.value for state in ACTIVE]
_EVENTS_AT_ONCE = 2000


@dataclass(frozen=True, slots=True)
class JobInBrief:
    """A job without its request and its result.

    at: when it ended, or began, or was made: UTC, ISO 8601.
    stopping: whether somebody has asked it to stop.
    """

    id: str
    loop: str
    host: str
    state: JobState
    dry_run: bool
    by: str
    stage: str | None
    plant_time_s: float
    stopping: bool
    reason: Reason | None
    at: str


@dataclass(frozen=True, slots=True)
class Acceptance:
    """Gains that were accepted. at: UTC, ISO 8601.  by: as given in the request.  Ms: the value asked for; None: the
    method has none."""

    job_id: str
    at: str
    by: str
    gains: Gains
    Ms: float | None


_BRIEF = select(
    JobRow.id, JobRow.loop, JobRow.host, JobRow.state, JobRow.dry_run, JobRow.by, JobRow.stage,
    JobRow.plant_time_s, JobRow.stop_reason.is_not(None), JobRow.reason,
    func.coalesce(JobRow.ended_at, JobRow.started_at, JobRow.created_at),
)  # fmt: skip


def live_jobs(store: Store) -> list[JobInBrief]:
    """Returns the jobs in an active state, of every host, dry runs included, oldest first."""
    with store.reading() as session:
        rows = session.execute(_BRIEF.where(JobRow.state.in_(_ACTIVE)).order_by(JobRow.number))
        return [JobInBrief(*row) for row in rows]


def latest_jobs(store: Store, loop: str | None = None) -> dict[str, JobInBrief]:
    """Returns the latest job by loop, of every host or of one loop; dry runs do not count."""
    last = select(func.max(JobRow.number)).where(JobRow.dry_run.is_(False)).group_by(JobRow.loop)
    if loop is not None:
        last = last.where(JobRow.loop == loop)
    with store.reading() as session:
        rows = session.execute(_BRIEF.where(JobRow.number.in_(last)))
        found = [JobInBrief(*row) for row in rows]
    return {job.loop: job for job in found}


def latest_tests(store: Store) -> dict[str, JobInBrief]:
    """Returns the latest job of each configured loop of every host; dry runs do not count. It costs the same with many
    jobs as with few: the index has the latest of a loop."""
    of_loop = select(JobRow.number).where(JobRow.loop == LoopRow.tag, JobRow.dry_run.is_(False))
    last = of_loop.order_by(JobRow.number.desc()).limit(1).correlate(LoopRow).scalar_subquery()
    with store.reading() as session:
        rows = session.execute(_BRIEF.where(JobRow.number.in_(select(last).select_from(LoopRow))))
        return {job.loop: job for job in (JobInBrief(*row) for row in rows)}


def acceptances(store: Store, loop: str | None = None) -> dict[str, Acceptance]:
    """Returns the acceptance that is in force by loop, of every host or of one loop: the latest that was not rolled
    back."""
    last = select(func.max(JobRow.number)).where(JobRow.state == JobState.ACCEPTED.value).group_by(JobRow.loop)
    if loop is not None:
        last = last.where(JobRow.loop == loop)
    moves = (EventRow.job_id == JobRow.id, EventRow.kind == "state")
    wanted = (
        select(JobRow.loop, JobRow.id, JobRow.result, EventRow.at, EventRow.data)
        .join(EventRow, and_(*moves))
        .where(JobRow.number.in_(last))
        .order_by(EventRow.seq)
    )
    found: dict[str, Acceptance] = {}
    with store.reading() as session:
        for row in session.execute(wanted):
            if row.data.get("state") == JobState.ACCEPTED and row.result is not None and row.result.new_gains:
                Ms = row.result.design.get("Ms")
                by = str(row.data.get("by", ""))
                found[row.loop] = Acceptance(row.id, row.at, by, row.result.new_gains.gains(), Ms)
    return found


def new_events(store: Store, after: Mapping[str, int]) -> Sequence[JobEvent]:
    """Returns the events of these jobs that come after the given numbers, in order."""
    if not after:
        return []
    of_each = (and_(EventRow.job_id == job_id, EventRow.seq > seq) for job_id, seq in after.items())
    with store.reading() as session:
        return events(session, or_(*of_each), limit=_EVENTS_AT_ONCE)
