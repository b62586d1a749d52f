"""What need not be kept is deleted, at the start of the service and once an hour: the samples of old jobs, as it is
told, and what the engine still knows of jobs that are over, always.

Jobs, their events and results stay. Which samples are deleted is in the audit log, and each job has an event of it.
"""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from sqlalchemy import ColumnElement, delete, func, select
from sqlalchemy.exc import SQLAlchemyError

from service.engine import Engine
from service.security import audit
from service.states import ACTIVE, JobState
from service.store.clock import stamp
from service.store.store import Store, append
from service.store.tables import ChunkRow, JobRow

log = logging.getLogger(__name__)

EVERY_S = 3600.0
_AT_ONCE = 50
_FORGOTTEN_AT_ONCE = 500
_STOP_S = 5.0
_KEPT = [state.value for state in (*ACTIVE, JobState.PROPOSED)]


@dataclass(frozen=True)
class Keep:
    """Which jobs keep their samples: the newest `jobs` of each loop, and those that ended in the last `days`; None:
    that is no reason. Where both are None, all. Active and proposed jobs always do."""

    jobs: int | None = None
    days: float | None = None

    def __bool__(self) -> bool:
        return self.jobs is not None or self.days is not None


def tidy(store: Store, keep: Keep, at: datetime | None = None) -> int:
    """Deletes what need not be kept of this host's jobs. Returns of how many jobs. at: the present."""
    count = 0
    while keep and (jobs := _some(store, keep, at or datetime.now(UTC))):
        count += len(jobs)
    return count


def forget(store: Store, engine: Engine) -> int:
    """Has the engine forget the jobs that are over: our own tables have all of them. Returns how many."""
    count = 0
    while ids := engine.over(_FORGOTTEN_AT_ONCE):
        # What it takes for over while we do not is given to it anew (Jobs.reconcile), under the same id.
        active = store.active_among(ids)
        over = [job_id for job_id in ids if job_id not in active]
        if not over:
            break
        engine.forget(over)
        count += len(over)
    if count:
        log.info("the engine has forgotten %d jobs that are over", count)
    return count


def _some(store: Store, keep: Keep, at: datetime) -> list[JobRow]:
    """The first few: a transaction is short, others want to write, too."""
    with store.writing() as session:
        old = select(JobRow).where(*_old(store.host, keep, at)).order_by(JobRow.number).limit(_AT_ONCE)
        rows = list(session.scalars(old))
        ids = [row.id for row in rows]
        if rows:
            of_them = ChunkRow.job_id.in_(ids)
            samples = session.scalar(select(func.sum(ChunkRow.count)).where(of_them))
            session.execute(delete(ChunkRow).where(of_them))
            for row in rows:
                append(session, row.id, "samples_deleted", {"text": _why(keep)}, row.plant_time_s)
            before = {"jobs": ids, "samples": samples}
            audit.record(session, "samples_delete", "retention", before=before, after={"kept": _why(keep)})
    if ids:
        log.info("samples of %d old jobs deleted: %s", len(ids), ", ".join(ids))
    return rows


def _old(host: str, keep: Keep, at: datetime) -> list[ColumnElement[bool]]:
    with_samples = select(ChunkRow.job_id).where(ChunkRow.job_id == JobRow.id).exists()
    found = [JobRow.host == host, JobRow.state.not_in(_KEPT), with_samples]
    if keep.jobs is not None:
        # Rehearsals are counted apart: they must not push the experiments out.
        of_loop = (JobRow.loop, JobRow.dry_run)
        number = func.row_number().over(partition_by=of_loop, order_by=JobRow.number.desc())
        rank = select(JobRow.id, number).subquery()
        found.append(JobRow.id.in_(select(rank.c[0]).where(rank.c[1] > keep.jobs)))
    if keep.days is not None:
        found.append(JobRow.ended_at < stamp(at - timedelta(days=keep.days)))
    return found


def _why(keep: Keep) -> str:
    parts = [] if keep.jobs is None else [f"of the newest {keep.jobs} jobs of each loop"]
    parts += [] if keep.days is None else [f"of the last {keep.days:g} days"]
    return "samples are kept " + " and ".join(parts)


class Retention:
    """Tidies now and then, in a thread."""

    def __init__(self, store: Store, engine: Engine, keep: Keep, every_s: float = EVERY_S) -> None:
        self._store, self._engine, self._keep, self._every_s = store, engine, keep, every_s
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="retention", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._over.set()
        if self._thread.is_alive():
            self._thread.join(_STOP_S)  # the engine waits for a database that is away

    def _run(self) -> None:
        while not self._over.is_set():
            try:
                tidy(self._store, self._keep)
                forget(self._store, self._engine)
            except SQLAlchemyError as error:
                log.warning("what need not be kept could not be deleted, it will be later: %s", error)
            except Exception:  # whatever it is, it must be tried again
                log.exception("what need not be kept could not be deleted")
            self._over.wait(self._every_s)
