"""Jobs as the API shows them, with what other tables and other gateways know of them."""

from __future__ import annotations

from collections.abc import Sequence

from loopwright.service.api.job_views import JobView, job_view
from loopwright.service.jobs.manager import Jobs
from loopwright.service.live.other_gateways import OtherGateways
from loopwright.service.live.snapshot import JobProgress
from loopwright.service.states.job_state import ACTIVE
from loopwright.service.store import decision_requests, watches
from loopwright.service.store.job_figures import with_record
from loopwright.service.store.jobs import Job
from loopwright.service.store.live_jobs import latest_jobs

MAX_EVENTS = 2000
"""Events read for the view of a job. Those of the stages come first; failed decisions may follow without end."""


class ShownJobs:
    """Makes the API's view of each job. others: know how far jobs of other gateways have come."""

    def __init__(self, jobs: Jobs, others: OtherGateways) -> None:
        self._jobs, self._others = jobs, others

    def all(self, rows: Sequence[Job]) -> list[JobView]:
        store, ids = self._jobs.store, [row.id for row in rows]
        events = store.events_by_job(ids, limit=MAX_EVENTS)
        loops = {row.loop for row in rows}
        latest = latest_jobs(store, loops.pop() if len(loops) == 1 else None)
        asked = decision_requests.latest(store, ids)
        recorded = with_record(store, ids)
        watched = watches.of_jobs(store, ids)
        return [
            job_view(
                row,
                events[row.id],
                self._jobs.running(row.id),
                latest.get(row.loop),
                asked.get(row.id),
                self.progress_elsewhere(row),
                row.id in recorded,
                watched.get(row.id),
            )
            for row in rows
        ]

    def one(self, row: Job) -> JobView:
        return self.all([row])[0]

    def progress_elsewhere(self, row: Job) -> JobProgress | None:
        """How far a job of another gateway has come; None where it has not said so."""
        if row.host == self._jobs.store.host or row.state not in ACTIVE:
            return None
        self._others.look()
        return self._others.progress(row.id, row.host)
