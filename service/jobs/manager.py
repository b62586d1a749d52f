"""Jobs: the engine starts them, a thread pumps each, the store is the memory, the table of moves the law.

This is their manager: it starts, stops and aborts them, and finds what the engine has lost. What runs one is `worker`,
what decides one `decisions`; `service.server.assembly` puts them together.
"""

from __future__ import annotations

import logging
import threading
from contextlib import suppress

from sqlalchemy.exc import SQLAlchemyError

from loopwright.service.config import LoopConfig
from loopwright.service.errors import Stopping
from loopwright.service.job_states import ACTIVE, IllegalMove, JobState
from loopwright.service.jobs.active_job import Running
from loopwright.service.jobs.aftercare import Aftercare
from loopwright.service.jobs.decisions import Decisions
from loopwright.service.jobs.engine import WORKFLOW_VERSION, Engine
from loopwright.service.jobs.journal import Journal
from loopwright.service.jobs.locking import Locking
from loopwright.service.jobs.loop_directory import LoopDirectory
from loopwright.service.jobs.machine import Machine
from loopwright.service.jobs.recovery import Recovery
from loopwright.service.jobs.registry import Registry
from loopwright.service.jobs.until_answered import STOP_PATIENCE_S, UntilAnswered
from loopwright.service.jobs.worker import Worker
from loopwright.service.request import RetuneRequest, within
from loopwright.service.store.jobs import Job
from loopwright.service.store.lock import CHECK_S
from loopwright.service.store.store import FolderInUse, Store, WithJob
from loopwright.tuning.reasons import Reason

log = logging.getLogger(__name__)

REHEARSALS_AT_ONCE = 4
_WATCH_S = 0.2
_RECONCILE_S = 15.0
_AT_BOOT = 16
ENDS_S = 75.0
"""Wall time in which a job that is told to stop has ended: its loop restored (tried for 4 s, and every answer of the
last try may be late, 25 s in all), its reports and its end written or given up (twice STOP_PATIENCE_S and a wait of
the database). Shorter than TimeoutStopSec of the unit, which would end the service without a word."""


class Jobs:
    """Starts and stops jobs of this host's loops; shows, starts and aborts those of the others.

    decisions, locking: parts that the manager does not use itself; the API is given them with the jobs.
    machine: clock and threads.
    """

    def __init__(
        self,
        store: Store,
        engine: Engine,
        journal: Journal,
        registry: Registry,
        directory: LoopDirectory,
        worker: Worker,
        decisions: Decisions,
        locking: Locking,
        aftercare: Aftercare,
        recovery: Recovery,
        machine: Machine,
    ) -> None:
        self.store = store
        self.engine = engine
        self.journal = journal
        self.registry = registry
        self.directory = directory
        self.worker = worker
        self.decisions = decisions
        self.locking = locking
        self.aftercare = aftercare
        self._recovery = recovery
        self._machine = machine
        self._lasting = UntilAnswered(machine, registry)
        self._watched = self._machine.monotonic()
        self._lost: set[str] = set()
        self._ended = threading.Event()
        self._watcher = self._machine.thread(self._watch, "watcher")
        self._name_holder = self._machine.thread(self._hold_name, "name holder")

    @property
    def stopping(self) -> bool:
        return self.registry.stopping

    @property
    def why_stopping(self) -> str:
        """Says why no more jobs are taken, as readiness shows it."""
        return self.registry.why_stopping

    @property
    def resumes(self) -> bool:
        """Says whether jobs that a dead service left go on at the next start."""
        return self._recovery.resumes

    # at the start of the service
    def boot(self) -> None:
        """Takes this host's loops, makes those of its active jobs safe, then lets the engine go on with the jobs.

        Raises ForeignLoop.
        """
        self.store.own_loops({tag: config.model_dump(mode="json") for tag, config in self.directory.loops.items()})
        self._machine.side_by_side(self._recovery.recover, self.store.unfinished(), _AT_BOOT)
        if self.stopping:  # told to end meanwhile: what is left of the jobs is left to the next start
            return
        queues = {self._queue(config): self.directory.at_once(config.bus) for config in self.directory.loops.values()}
        self.engine.launch(self.worker.work, queues | {self._rehearsals(self.store.host): REHEARSALS_AT_ONCE})
        self.reconcile(at_once=True)
        if not self.stopping:
            self._watcher.start()
            if self.store.shared:
                self._name_holder.start()
            self.aftercare.start()

    def reconcile(self, at_once: bool = False) -> None:
        """Hands the engine what it has lost (an enqueue that failed, a file that was deleted or is older than ours).

        at_once: without waiting for a second look, which keeps a job that is just being started from being lost.
        """
        self._end_unqueued()
        with self.registry.lock:
            apart = self.registry.running.keys() | self.registry.unqueued.keys()
            idle = [row for row in self.store.unfinished() if row.id not in apart]
        lost = {row.id for row in idle} - self.engine.known([row.id for row in idle])
        for row in idle:
            if row.id in lost and (at_once or row.id in self._lost):
                self.engine.forget([row.id])
                self.engine.enqueue(row.id, self._queue_of(row))
        self._lost = lost

    def _queue_of(self, row: Job) -> str:
        return self._rehearsals(row.host) if row.dry_run else self._queue(self.directory.loops[row.loop])

    def _queue(self, config: LoopConfig, host: str | None = None) -> str:
        """Returns the queue of the loop's bus. A bus has its name from its host: two hosts may both have a vcan0."""
        return f"{host or self.store.host}:{config.bus}"

    @staticmethod
    def _rehearsals(host: str) -> str:
        return f"{host}:rehearsals"

    # what there is
    def running(self, job_id: str) -> Running | None:
        return self.registry.running.get(job_id)

    def under_test(self) -> dict[str, str]:
        """Returns the tags of the loops that a job works on, by job."""
        return self.registry.under_test()

    # start and stop
    def start(self, tag: str, request: RetuneRequest, also: WithJob | None = None) -> Job:
        """Queues a job on the host that has the loop. Raises UnknownLoop, BadLimits, Busy, Locked, Stopping.

        also: what is written in the same transaction; when it raises, there is no job.
        """
        config, host = self.directory.owner(tag)
        within(config, request)
        if self.stopping:
            raise Stopping(self.why_stopping)
        asked = request.asked()
        row = self.store.create(tag, asked, request.requested_by, request.dry_run, host, WORKFLOW_VERSION, also)
        try:
            self.engine.enqueue(row.id, self._rehearsals(host) if row.dry_run else self._queue(config, host))
        except Exception:
            # Whoever asked is told that it failed: it must not begin later.
            self.registry.unqueued[row.id] = row
            self._end_unqueued()
            raise
        return row

    def _end_unqueued(self) -> None:
        """Ends the jobs that could not be queued, as far as the database takes it."""
        for job_id, row in list(self.registry.unqueued.items()):
            try:
                if row.host == self.store.host:
                    self._request_stop_of(job_id, Reason.INTERNAL, JobState.FAILED, "it could not be queued")
                else:  # its own host may have found and begun it: only that one can tell
                    with suppress(IllegalMove):
                        self.store.request_stop(job_id, Reason.INTERNAL, "service")
            except SQLAlchemyError as error:
                log.error(
                    "job %s of loop %s could not be queued, and its end not be written: it does not begin, and holds "
                    "the loop until the database takes its end, which is tried every %.0f s: %s",
                    job_id, row.loop, _RECONCILE_S, error,
                )  # fmt: skip
            else:
                self.registry.unqueued.pop(job_id, None)

    def abort(self, job_id: str, by: str) -> Job:
        """Asks an active job to stop; it ends as aborted once the loop is restored. Raises IllegalMove.

        A job that runs here hears of it before it is written down: the loop does not wait for the database.
        """
        heard = self.tell_to_stop(job_id)
        row = self.store.request_stop(job_id, Reason.OPERATOR, by, heard)
        if row.host == self.store.host:
            self._request_stop_of(job_id, Reason.OPERATOR)
        return self.store.get(job_id)

    def tell_to_stop(self, job_id: str) -> bool:
        """Lets a job that runs here hear that an operator wants it to end; returns at once, and writes nothing down.
        Returns False where no job hears of it."""
        running = self.registry.running.get(job_id)
        if running is None:
            return False
        running.stop_reason = running.stop_reason or Reason.OPERATOR
        return running.stop_reason is Reason.OPERATOR

    def _request_stop_of(
        self,
        job_id: str,
        reason: Reason,
        state: JobState = JobState.ABORTED,
        detail: str = "stopped while it waited for its turn",
    ) -> None:
        """Asks one job to stop. A job that runs hears of it at its next sample; one that waits for its turn has nothing
        to restore, and ends in that state."""
        with self.registry.lock:
            running = self.registry.running.get(job_id)
            if running is not None:
                running.stop_reason = running.stop_reason or reason
                return
            row = self.store.get(job_id)
            if row.state in ACTIVE:
                self.store.move(job_id, state, reason=reason.value, detail=detail)

    def request_stop(self) -> None:
        """Tells every job to end; returns at once."""
        self.registry.stopping = True
        self.aftercare.request_stop()
        for running in list(self.registry.running.values()):
            running.stop_reason = running.stop_reason or Reason.SERVICE_STOPPED

    def give_up(self, why: str) -> None:
        """Ends every job and takes no more, while requests go on being answered; why: as readiness says it."""
        if not self.stopping:
            log.critical("%s; every job is ended, no more are taken", why)
            self.registry.why_stopping = why
            self.request_stop()

    def stop(self) -> None:
        """Ends every job, waits until each has restored its loop, and gives the engine up.

        A job whose thread hangs does not hold up the others' ends for ever.
        """
        if self._ended.is_set():
            return
        with self.registry.lock:
            self.request_stop()
        give_up = self._machine.monotonic() + ENDS_S
        for running in list(self.registry.running.values()):
            if not running.over.wait(max(0.0, give_up - self._machine.monotonic())):
                log.error(
                    "job %s of loop %s has not ended in %.0f s: whether its loop is restored is unknown, and its end "
                    "is not written; look at the controller, which goes back by itself when it hears no more of the "
                    "service; the next start looks at the loop again",
                    running.job_id, running.tag, ENDS_S,
                )  # fmt: skip
        self.aftercare.close()
        self.stop_watching()
        if self._watcher.ident is not None:  # a service that did not come to its start leaves the jobs as they are
            try:
                for row in self._lasting(self.store.unfinished):
                    self._request_stop_of(row.id, Reason.SERVICE_STOPPED)
            except (SQLAlchemyError, FolderInUse) as error:
                log.error("the end of the waiting jobs could not be written, they go on at the next start: %s", error)
            if self._name_holder.ident is not None:
                self._name_holder.join(STOP_PATIENCE_S)
        self.engine.close()
        self.journal.close(STOP_PATIENCE_S)

    def stop_watching(self) -> None:
        """Ends the thread that hears of jobs to stop, and leaves jobs and loops as they are; a `stop` after it does
        nothing."""
        self._ended.set()
        if self._watcher.ident is not None:
            self._watcher.join()

    def _watch(self) -> None:
        """Hears of jobs to stop, from whatever host, and finds what the engine has lost."""
        reconciled = self._machine.monotonic()
        while not self._ended.wait(_WATCH_S):
            self._watched = self._machine.monotonic()
            if self.store.damaged is not None:
                self.give_up(self.store.damaged)
                continue
            try:
                for job_id, reason in self.store.stop_requests().items():
                    self._request_stop_of(job_id, reason)
                if self._machine.monotonic() - reconciled > _RECONCILE_S:
                    self.reconcile()
                    reconciled = self._machine.monotonic()
            except FolderInUse as error:
                self.give_up(str(error))
            except SQLAlchemyError as error:
                log.warning("the database does not answer: %s", error)
            except Exception:  # whatever it is, aborts from other hosts must go on being heard
                log.exception("watching the jobs")

    def unwatched_s(self) -> float:
        """Returns for how long nobody has heard of jobs to stop, s of wall time."""
        return self._machine.monotonic() - self._watched

    def _hold_name(self) -> None:
        """Keeps the lock on our host name. Nothing else in this thread waits for anything: another service waits only
        so long for us to come for it."""
        while not self._ended.wait(CHECK_S):
            try:
                self.store.check_lock()
            except FolderInUse as error:
                self.give_up(str(error))
                return
            except Exception:
                log.exception("holding the name of the host")
