"""The live jobs, the latest job of each loop, and the events of the loops that somebody watches, as looked up last."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field

from loopwright.service.jobs.manager import Jobs
from loopwright.service.live.messages import JobHappening, LiveJob, LiveJobs, event
from loopwright.service.live.other_gateways import OtherGateways
from loopwright.service.live.snapshot import JobProgress, progress_of
from loopwright.service.live.viewer import Viewer
from loopwright.service.states.job_state import ACTIVE
from loopwright.service.store.jobs import JobEvent
from loopwright.service.store.live_jobs import JobInBrief, latest_jobs, live_jobs, new_events


@dataclass
class _Followed:
    """A job whose events are kept. active: whether the job was active when it was last looked up."""

    loop: str
    active: bool
    last: int = 0
    events: list[tuple[int, str]] = field(default_factory=list)


class LookedUpJobs:
    """What the database said last. `look` is called in a thread, the rest reads what it has put there as a whole."""

    def __init__(self, jobs: Jobs, others: OtherGateways) -> None:
        self._jobs, self._others = jobs, others
        self.live: list[JobInBrief] = []
        self.latest: dict[str, JobInBrief] = {}
        self.locked: dict[str, str] = {}
        """Since when a loop is locked, of the loops that are."""
        self.loops: list[tuple[str, str]] = [(tag, jobs.store.host) for tag in jobs.directory.loops]
        """Tag and host of every loop."""
        self._followed: dict[str, _Followed] = {}

    def look(self, watched: Collection[str], thoroughly: bool) -> None:
        """Asks the database. Raises SQLAlchemyError.

        watched: loops whose events are wanted.
        thoroughly: whether the latest jobs, the locks and the loops of other hosts are asked for too.
        """
        store = self._jobs.store
        if thoroughly:
            self._others.look()
            self.locked = {tag: row.since for tag, row in self._jobs.locking.locks().items()}
        live = live_jobs(store)
        if thoroughly or {job.id for job in live} != {job.id for job in self.live}:
            self.latest = latest_jobs(store)
            self.loops = sorted((config.tag, host) for config, host in self._jobs.directory.everywhere())
        self.live = live
        wanted = {job.id: job for job in (*self.latest.values(), *live) if job.loop in watched}
        after = {job_id: self._followed[job_id].last if job_id in self._followed else 0 for job_id in wanted}
        new: dict[str, list[JobEvent]] = {}
        for each in new_events(store, after):
            new.setdefault(each.job_id, []).append(each)
        followed: dict[str, _Followed] = {}
        for job_id, job in wanted.items():
            before = self._followed.get(job_id, _Followed(job.loop, False))
            texts = [(each.seq, _happening(job.loop, each)) for each in new.get(job_id, [])]
            last = texts[-1][0] if texts else before.last
            followed[job_id] = _Followed(job.loop, job.state in ACTIVE, last, before.events + texts)
        self._followed = followed

    def events_for(self, viewer: Viewer) -> Iterator[str]:
        """Yields the events that a viewer has not had yet. Of a job that was over when it began, only later ones."""
        for job_id, job in self._followed.items():
            if job.loop not in viewer.tags:
                continue
            after = viewer.after.setdefault(job_id, 0 if job.active else job.last)
            viewer.after[job_id] = max(after, job.last)
            yield from (text for seq, text in job.events if seq > after)

    def message(self) -> LiveJobs:
        """Returns the live jobs, with their progress as far as it is known."""
        return LiveJobs(jobs=[self._live_job(job) for job in self.live])

    def _live_job(self, job: JobInBrief) -> LiveJob:
        now = self._progress(job)
        return LiveJob(
            id=job.id,
            url=f"/jobs/{job.id}",
            loop=job.loop,
            gateway=job.host,
            state=job.state,
            dry_run=job.dry_run,
            by=job.by,
            stage=job.stage if now is None or now.stage is None else now.stage,
            progress=None if now is None else now.progress,
            remaining_plant_time_s=None if now is None else now.remaining_plant_time_s,
            remaining_wall_time_s=None if now is None else now.remaining_wall_time_s,
            plant_time_s=round(job.plant_time_s, 1) if now is None else now.plant_time_s,
            stopping=job.stopping or (now is not None and now.stopping),
        )

    def _progress(self, job: JobInBrief) -> JobProgress | None:
        running = self._jobs.running(job.id)
        return self._others.progress(job.id, job.host) if running is None else progress_of(running)


def _happening(loop: str, found: JobEvent) -> str:
    message = JobHappening(
        job=found.job_id, loop=loop, seq=found.seq, kind=found.kind, at=found.at, plant_time_s=found.plant_time_s,
        data=found.shown(),
    )  # fmt: skip
    return event("job", message, f"{found.job_id}.{found.seq}")
