"""Deletes old samples, old history and finished engine records, at the start of the service and once an hour.

Jobs, their events and results stay. The audit log lists the jobs whose samples are deleted, and each job gets an event.
After a jump of the clock nothing is deleted for its age: service/store/clock_watch.py.
"""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from sqlalchemy import ColumnElement, delete, func, select, update

from loopwright.service.jobs.engine import Engine
from loopwright.service.jobs.repeated import Repeated
from loopwright.service.states.job_state import ACTIVE, JobState
from loopwright.service.store import audit, history, hosts, knowledge
from loopwright.service.store.clock import stamp
from loopwright.service.store.clock_watch import ClockWatch, longest_stop
from loopwright.service.store.job_rows import append
from loopwright.service.store.store import Store
from loopwright.service.store.tables import ChunkRow, JobFiguresRow, JobKnowledgeRow, JobRow
from loopwright.service.telemetry.metrics import CLOCK_JUMPS

log = logging.getLogger(__name__)

EVERY_S = 3600.0
CLOCK_CHECK_S = 60.0
"""Wall time between two checks of the clock, s."""
_AT_ONCE = 50
_FORGOTTEN_AT_ONCE = 500
_KEPT = [state.value for state in (*ACTIVE, JobState.PROPOSED)]


@dataclass(frozen=True)
class RetentionPolicy:
    """Which jobs keep their samples; active and proposed jobs always do.

    jobs: the newest `jobs` of each loop keep them; None disables the criterion.
    days: jobs that ended in the last `days` keep them; None disables the criterion. With both None, all jobs keep them.
    history_days: the stored history of the loops, and what was known of them, is kept for this time; None for ever.
    """

    jobs: int | None = None
    days: float | None = None
    history_days: float | None = 7.0

    def __bool__(self) -> bool:
        return self.jobs is not None or self.days is not None


def delete_old_samples(
    store: Store, policy: RetentionPolicy, at: datetime | None = None, ages_from: datetime | None = None
) -> int:
    """Deletes the old samples of this host's jobs. Returns the number of jobs.

    at: the present time; by default that of the clock.
    ages_from: no sample counts as older than this time.
    """
    at = at or datetime.now(UTC)
    if policy.days is not None and ages_from is not None and ages_from > at - timedelta(days=policy.days):
        return 0  # no job is known to be old enough
    count = 0
    while policy and (jobs := _some(store, policy, at)):
        count += len(jobs)
    return count


def delete_old_history(store: Store, policy: RetentionPolicy, at: datetime, ages_from: datetime | None = None) -> int:
    """Deletes the old history of this host's loops, and what was known of them before. Returns the number of blocks.

    at, ages_from: as for `delete_old_samples`.
    """
    if policy.history_days is None:
        return 0
    before = at - timedelta(days=policy.history_days)
    if ages_from is not None and ages_from > before:
        return 0
    knowledge.delete_older(store, stamp(before))
    return history.delete_older(store, before.timestamp())


def forget_finished(store: Store, engine: Engine) -> int:
    """Deletes the engine's records of jobs that are over, whose state is in the service's own tables. Returns their
    number."""
    count = 0
    while ids := engine.over(_FORGOTTEN_AT_ONCE):
        # A job that is over for the engine alone is queued again (Jobs.reconcile) under the same id.
        active = store.active_among(ids)
        over = [job_id for job_id in ids if job_id not in active]
        if not over:
            break
        engine.forget(over)
        count += len(over)
    if count:
        log.info("the engine's records of %d finished jobs are deleted", count)
    return count


def _some(store: Store, policy: RetentionPolicy, at: datetime) -> list[JobRow]:
    """Returns the first few jobs: the transaction has to be short, because others write too."""
    with store.writing() as session:
        old = select(JobRow).where(*_old(store.host, policy, at)).order_by(JobRow.number).limit(_AT_ONCE)
        rows = list(session.scalars(old))
        ids = [row.id for row in rows]
        if rows:
            of_them = ChunkRow.job_id.in_(ids)
            samples = session.scalar(select(func.sum(ChunkRow.count)).where(of_them))
            session.execute(delete(ChunkRow).where(of_them))
            session.execute(update(JobKnowledgeRow).where(JobKnowledgeRow.job_id.in_(ids)).values(data=None))
            session.execute(update(JobFiguresRow).where(JobFiguresRow.job_id.in_(ids)).values(record=None))
            for row in rows:
                append(session, row.id, "samples_deleted", {"text": _why(policy)}, row.plant_time_s)
            before = {"jobs": ids, "samples": samples}
            audit.record(session, "samples_delete", "retention", before=before, after={"kept": _why(policy)})
    if ids:
        log.info("samples of %d old jobs deleted: %s", len(ids), ", ".join(ids))
    return rows


def _old(host: str, policy: RetentionPolicy, at: datetime) -> list[ColumnElement[bool]]:
    with_samples = select(ChunkRow.job_id).where(ChunkRow.job_id == JobRow.id).exists()
    conditions = [JobRow.host == host, JobRow.state.not_in(_KEPT), with_samples]
    if policy.jobs is not None:
        # Rehearsals are counted separately: they must not displace the experiments.
        of_loop = (JobRow.loop, JobRow.dry_run)
        number = func.row_number().over(partition_by=of_loop, order_by=JobRow.number.desc())
        rank = select(JobRow.id, number).subquery()
        conditions.append(JobRow.id.in_(select(rank.c[0]).where(rank.c[1] > policy.jobs)))
    if policy.days is not None:
        conditions.append(JobRow.ended_at < stamp(at - timedelta(days=policy.days)))
    return conditions


def _why(policy: RetentionPolicy) -> str:
    parts = [] if policy.jobs is None else [f"of the newest {policy.jobs} jobs of each loop"]
    parts += [] if policy.days is None else [f"of the last {policy.days:g} days"]
    return "samples are kept " + " and ".join(parts)


class Retention:
    """Deletes from time to time, in a thread; the clock is checked more often."""

    def __init__(
        self,
        store: Store,
        engine: Engine,
        policy: RetentionPolicy,
        every_s: float = EVERY_S,
        clock_check_s: float = CLOCK_CHECK_S,
        watch: ClockWatch | None = None,
    ) -> None:
        self._store, self._engine, self._policy = store, engine, policy
        self._every_s = every_s
        self._watch = watch or ClockWatch()
        self._tidied_s: float | None = None
        self._turns = Repeated(self._turn, clock_check_s, "retention", "old samples could not be deleted")

    def start(self) -> None:
        self._turns.start()

    def close(self) -> None:
        self._turns.close()

    def note(self) -> str | None:
        """Returns why no samples are deleted for their age at present; None where they are."""
        seen, days = self._watch.seen, self._policy.days
        if seen is None or seen.ages_from is None or days is None:
            return None
        until = seen.ages_from + timedelta(days=days)
        if until <= seen.at:
            return None
        return (
            f"the wall clock has jumped, the ages of samples count from {stamp(seen.ages_from)}: "
            f"none are deleted for their age before {stamp(until)}"
        )

    def check_clock(self) -> None:
        """Checks the clock, and stores the result."""
        before = None if self._watch.seen is not None else hosts.last_seen(self._store)
        jump = self._watch.look(before, longest_stop(self._policy.days))
        if jump is not None:
            CLOCK_JUMPS.inc()
            log.warning("%s", jump.text)
        if self._watch.seen is not None:
            hosts.keep_seen(self._store, self._watch.seen, jump)

    def _turn(self) -> None:
        self.check_clock()
        if self._tidied_s is None or time.monotonic() - self._tidied_s >= self._every_s:
            self.tidy()
            self._tidied_s = time.monotonic()

    def tidy(self) -> None:
        """One turn of the thread, without a look at the clock."""
        seen = self._watch.seen
        if seen is not None:
            delete_old_samples(self._store, self._policy, seen.at, seen.ages_from)
            delete_old_history(self._store, self._policy, seen.at, seen.ages_from)
        forget_finished(self._store, self._engine)
