"""The figures of jobs that are over: computed once, at the end of the job or when somebody asks first, and stored."""

from __future__ import annotations

import logging
import threading
from concurrent.futures import Future
from functools import partial

from sqlalchemy.exc import SQLAlchemyError

from loopwright.service.errors import Conflict
from loopwright.service.execution.computing.limits import ComputationKind
from loopwright.service.execution.computing.pool import NotWanted, Pool
from loopwright.service.jobs.job_figures import VERSION, JobFigures, job_figures, unpacked
from loopwright.service.states.job_state import ACTIVE
from loopwright.service.store import job_figures as stored
from loopwright.service.store.jobs import Job
from loopwright.service.store.lock import FolderInUse
from loopwright.service.store.store import Store
from loopwright.tuning.reasons import Ended

log = logging.getLogger(__name__)

_CLOSE_S = 5.0


class KeptFigures:
    """The figures of the jobs. Neither the end of a test nor the restoring of its loop waits for them.

    pool: the processes that compute them.
    """

    def __init__(self, store: Store, pool: Pool) -> None:
        self._store, self._pool = store, pool
        self._lock = threading.Lock()
        self._being_made: dict[str, Future[JobFigures]] = {}
        self._threads: dict[str, threading.Thread] = {}
        self._closed = False

    def kept(self, job_id: str) -> JobFigures | None:
        """Returns the stored figures of a job; None where there are none. Raises SQLAlchemyError."""
        found = stored.kept(self._store, job_id, VERSION)
        return None if found is None else unpacked(found)

    def asked(self, job: Job) -> Future[JobFigures]:
        """Returns the figures of a job that is over, as a future that all who ask meanwhile share.

        The future may raise Ended, NotWanted (the service ends) and SQLAlchemyError. Raises Conflict.
        """
        if job.state in ACTIVE:
            raise Conflict(f"job {job.id} is not over: ask again when it is, or look at /jobs/{job.id}/samples")
        with self._lock:
            if (known := self._being_made.get(job.id)) is not None:
                return known
            future: Future[JobFigures] = Future()
            future.set_running_or_notify_cancel()  # one who asks and goes does not end it for the others
            thread = threading.Thread(target=self._make, args=(job, future), name="figures", daemon=True)
            self._being_made[job.id], self._threads[job.id] = future, thread
            thread.start()
        return future

    def ended(self, job: Job) -> None:
        """Begins to compute the figures of a job that has just ended; returns at once."""
        try:
            future = self.asked(job)
        except (Conflict, RuntimeError) as error:  # the system gives no thread
            log.warning("the figures of job %s are computed when somebody asks: %s", job.id, error)
            return
        future.add_done_callback(partial(_tell, job.id))

    def request_stop(self) -> None:
        """Ends the computations, so that nobody waits for them; returns at once."""
        self._closed = True

    def close(self) -> None:
        """Ends the computations; what they have not stored is computed when somebody asks."""
        self.request_stop()
        with self._lock:
            threads = list(self._threads.values())
        for thread in threads:
            thread.join(_CLOSE_S)

    def _make(self, job: Job, future: Future[JobFigures]) -> None:
        try:
            figures = self._figures(job)
        except BaseException as error:
            self._forget(job.id)
            future.set_exception(error)
        else:
            self._forget(job.id)
            future.set_result(figures)

    def _forget(self, job_id: str) -> None:
        with self._lock:
            self._being_made.pop(job_id, None)
            self._threads.pop(job_id, None)

    def _figures(self, job: Job) -> JobFigures:
        figures = self.kept(job.id)  # another may have stored them meanwhile
        if figures is not None:
            return figures
        events, blocks = self._store.events(job.id), list(self._store.blocks(job.id))
        work = partial(job_figures, job, events, blocks)
        figures = self._pool.run(ComputationKind.TUNING, work, unwanted=lambda: self._closed)
        try:
            stored.keep(self._store, job.id, VERSION, figures.pack())
        except (SQLAlchemyError, FolderInUse) as error:
            log.warning("the figures of job %s could not be stored, they are computed again: %s", job.id, error)
        return figures


def _tell(job_id: str, future: Future[JobFigures]) -> None:
    error = future.exception()
    if isinstance(error, NotWanted):
        log.info("the service ends; the figures of job %s are computed when somebody asks", job_id)
    elif isinstance(error, Ended | SQLAlchemyError):
        log.warning("the figures of job %s could not be computed: %s", job_id, getattr(error, "detail", error))
    elif error is not None:
        log.error("a defect while computing the figures of job %s", job_id, exc_info=error)
