"""The manager of the jobs: it starts, stops and aborts them, and finds those that the engine has lost.

The engine starts each job in a thread, the store holds its state, and the table of job states decides which changes are
legal. `worker` runs a job, `decisions` decides one; `service.server.assembly` connects the parts.
"""

from __future__ import annotations

import logging
import threading
from contextlib import suppress

from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from loopwright.service.errors import NotKnown, Stopping
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.inputs.request import RetuneRequest, check_setpoint_source, within
from loopwright.service.jobs.active_job import Running
from loopwright.service.jobs.aftercare import Aftercare
from loopwright.service.jobs.database_retries import STOP_PATIENCE_S, DatabaseRetries
from loopwright.service.jobs.decisions import Decisions
from loopwright.service.jobs.engine import WORKFLOW_VERSION, Engine
from loopwright.service.jobs.journal import Journal, temporary
from loopwright.service.jobs.locking import Locking
from loopwright.service.jobs.loop_directory import LoopDirectory
from loopwright.service.jobs.machine import Machine
from loopwright.service.jobs.operation import OperationKnowledge
from loopwright.service.jobs.recovery import Recovery
from loopwright.service.jobs.registry import Registry
from loopwright.service.jobs.requested_decisions import RequestedDecisions
from loopwright.service.jobs.worker import Worker
from loopwright.service.observing.kept_knowledge import KeptKnowledge
from loopwright.service.security.principal import signed
from loopwright.service.states.job_state import ACTIVE, IllegalMove, JobState
from loopwright.service.store.job_rows import NoSuchJob
from loopwright.service.store.jobs import Job
from loopwright.service.store.journal_writes import stop_of
from loopwright.service.store.lock import CHECK_S, FolderInUse
from loopwright.service.store.store import Store, WithJob
from loopwright.service.store.tables import JobRow
from loopwright.tuning.reasons import Reason

log = logging.getLogger(__name__)

REHEARSALS_AT_ONCE = 4
"""Number of dry runs that one host runs at once."""
_WATCH_S = 0.2
_RECONCILE_S = 15.0
_AT_BOOT = 16
ENDS_S = 75.0
"""Wall time in which a job that is asked to stop has ended, s: its loop restored (retried for 4 s, and every answer of
the last try may be late, 25 s in all), its reports and its end written or given up (twice STOP_PATIENCE_S and a wait
for the database). It is shorter than TimeoutStopSec of the unit, after which systemd kills the service."""


class Jobs:
    """Starts and stops jobs of this host's loops; shows, starts and aborts those of the other hosts.

    decisions, locking, knowledge, operation: parts that the manager does not use itself; the API and the server get
    them together with the jobs.
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
        requested_decisions: RequestedDecisions,
        aftercare: Aftercare,
        recovery: Recovery,
        machine: Machine,
        knowledge: KeptKnowledge,
        operation: OperationKnowledge,
    ) -> None:
        self.store = store
        self.engine = engine
        self.journal = journal
        self.registry = registry
        self.directory = directory
        self.worker = worker
        self.decisions = decisions
        self.locking = locking
        self.requested_decisions = requested_decisions
        self.aftercare = aftercare
        self.knowledge = knowledge
        self.operation = operation
        self._recovery = recovery
        self._machine = machine
        self._lasting = DatabaseRetries(machine, registry)
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
        """Returns why no more jobs are accepted, in the words of the readiness check."""
        return self.registry.why_stopping

    @property
    def resumes(self) -> bool:
        """Returns whether jobs of a dead service are resumed at the next start."""
        return self._recovery.resumes

    # at the start of the service
    def boot(self) -> None:
        """Registers this host's loops, restores those of its active jobs, then lets the engine continue the jobs.

        Where jobs are not resumed, the database may come from a back-up, older than the last decisions.

        Raises ForeignLoop.
        """
        self.store.own_loops({tag: config.model_dump(mode="json") for tag, config in self.directory.loops.items()})
        if not self.resumes:
            self.store.doubt_proposals("the service was started with --no-resume")
        self._machine.side_by_side(self._recovery.recover, self.store.unfinished(), _AT_BOOT)
        if self.stopping:  # asked to end meanwhile: the remaining jobs are left to the next start
            return
        queues = {self._queue(config): self.directory.at_once(config.bus) for config in self.directory.loops.values()}
        self.engine.launch(self.worker.work, queues | {self._rehearsals(self.store.host): REHEARSALS_AT_ONCE})
        self.reconcile(at_once=True)
        if not self.stopping:
            self._watcher.start()
            if self.store.shared:
                self._name_holder.start()
                self.requested_decisions.start()
            self.aftercare.start()

    def reconcile(self, at_once: bool = False) -> None:
        """Queues the jobs that the engine has lost (an enqueue that failed, a file that was deleted or is older than
        the store).

        at_once: without waiting for a second round, which keeps a job that is just being started from counting as lost.
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
        """Returns the queue of the loop's bus. The name includes the host, because two hosts may both have a vcan0."""
        return f"{host or self.store.host}:{config.bus}"

    @staticmethod
    def _rehearsals(host: str) -> str:
        return f"{host}:rehearsals"

    # queries
    def running(self, job_id: str) -> Running | None:
        return self.registry.running.get(job_id)

    def under_test(self) -> dict[str, str]:
        """Returns the tags of the loops that a job works on, by job."""
        return self.registry.under_test()

    # start and stop
    def start(self, tag: str, request: RetuneRequest, also: WithJob | None = None) -> Job:
        """Queues a job on the host that has the loop. Raises UnknownLoop, BadLimits, RemoteSetpoint, Busy,
        Locked, Stopping.

        also: writes in the same transaction; when it raises, there is no job.
        """
        config, host = self.directory.owner(tag)
        narrowed = within(config, request)
        check_setpoint_source(narrowed, request)
        if self.stopping:
            raise Stopping(self.why_stopping)
        asked = request.asked()
        if request.design is not None and narrowed.setpoint_weight_max is not None:
            asked["setpoint_weight_max"] = narrowed.setpoint_weight_max  # it stays with the job
        made: list[Job] = []

        def make(session: Session, row: JobRow) -> None:
            if also is not None:
                also(session, row)
            made.append(Job.from_row(row))

        try:
            by = signed(request.by)
            row = self.store.create(tag, asked, by, request.dry_run, host, WORKFLOW_VERSION, make)
            self.engine.enqueue(row.id, self._rehearsals(host) if row.dry_run else self._queue(config, host))
        except Exception:
            # The caller is told that the start failed, so the job must not begin later. It may be stored even where
            # that has failed: the answer to the COMMIT alone may be lost.
            for job in made:
                self.registry.unqueued[job.id] = job
                self._end_unqueued(job.id)
            raise
        return row

    def _end_unqueued(self, latest: str | None = None) -> None:
        """Ends the jobs that could not be queued, as far as the database accepts it.

        latest: the job whose start has just failed. Where it is not found yet, its COMMIT may still be under way.
        """
        for job_id, row in list(self.registry.unqueued.items()):
            try:
                if row.host == self.store.host:
                    self._request_stop_of(job_id, Reason.INTERNAL, JobState.FAILED, "it could not be queued")
                else:  # its own host may have found and begun it; only that host knows
                    with suppress(IllegalMove):
                        self.store.request_stop(job_id, Reason.INTERNAL, "service")
            except NoSuchJob:
                if job_id != latest:
                    self.registry.unqueued.pop(job_id, None)
            except SQLAlchemyError as error:
                log.error(
                    "job %s of loop %s could not be queued, and its end could not be written: it does not begin, and "
                    "holds the loop until the database accepts its end, which is tried every %.0f s: %s",
                    job_id, row.loop, _RECONCILE_S, error,
                )  # fmt: skip
            else:
                self.registry.unqueued.pop(job_id, None)

    def abort(self, job_id: str, by: str) -> Job:
        """Asks an active job to stop, as `ask_to_stop` does. Raises IllegalMove, NotKnown."""
        heard = self.ask_to_stop(job_id, by)
        try:
            return self.store.get(job_id)
        except SQLAlchemyError as error:
            if not heard or not temporary(error):
                raise
            raise NotKnown(
                f"job {job_id} has been told to stop, and restores its loop; the database does not answer: what has "
                "become of the job can be seen, and who has stopped it is stored, when the database is back"
            ) from error

    def ask_to_stop(self, job_id: str, by: str) -> bool:
        """Asks an active job to stop; it ends as aborted once the loop is restored. Returns whether a job that runs
        here has heard. Raises IllegalMove.

        A job that runs here is asked before the abort is stored, so the loop does not wait for the database. While the
        database does not take the abort of such a job, the abort waits in the journal.
        """
        self.tell_to_stop(job_id)
        heard = self._heard(job_id)
        try:
            row = self.store.request_stop(job_id, Reason.OPERATOR, by, heard)
        except SQLAlchemyError as error:
            if not heard or not temporary(error):
                raise
            self.journal.put(stop_of(job_id, Reason.OPERATOR, by))
        else:
            if row.host == self.store.host and not heard:
                self._request_stop_of(job_id, Reason.OPERATOR)
        finally:
            self.registry.unrecorded.discard(job_id)
        return heard

    def tell_to_stop(self, job_id: str) -> bool:
        """Asks a job that runs here to stop for an operator; returns at once, and stores nothing: `ask_to_stop`
        does, or `record_stop` where that does not follow.

        Returns False where no such job runs here, or it was asked before.
        """
        running = self.registry.running.get(job_id)
        if running is None or running.stop_reason is not None:
            return False
        self.registry.unrecorded.add(job_id)
        running.stop_reason = Reason.OPERATOR
        return True

    def tell_all_of(self, batch_id: str) -> list[str]:
        """Asks the jobs of a batch that run here to stop for an operator, as `tell_to_stop` does.
        Returns those that are being stopped for one."""
        mine = [job_id for job_id, each in self.registry.running.copy().items() if each.retune == batch_id]
        for job_id in mine:
            self.tell_to_stop(job_id)
        return [job_id for job_id in mine if self._heard(job_id)]

    def record_stop(self, job_id: str, by: str) -> None:
        """Hands to the journal who has told a job to stop, where nobody has noted that; returns at once."""
        if job_id in self.registry.unrecorded:
            self.journal.put(stop_of(job_id, Reason.OPERATOR, by))
            self.registry.unrecorded.discard(job_id)

    def _heard(self, job_id: str) -> bool:
        """Returns whether a job that runs here, or did a moment ago, was told to stop for an operator."""
        running = self.registry.running.get(job_id)
        stopped_for_one = running is not None and running.stop_reason is Reason.OPERATOR
        return stopped_for_one or job_id in self.registry.unrecorded

    def _request_stop_of(
        self,
        job_id: str,
        reason: Reason,
        state: JobState = JobState.ABORTED,
        detail: str = "stopped while it waited for its turn",
    ) -> None:
        """Asks one job to stop. A running job sees it at its next sample; a waiting one has nothing to restore, and
        ends in that state."""
        with self.registry.lock:
            running = self.registry.running.get(job_id)
            if running is not None:
                running.stop_reason = running.stop_reason or reason
                return
            row = self.store.get(job_id)
            if row.state in ACTIVE:
                self.store.move(job_id, state, reason=reason.value, detail=detail)

    def request_stop(self) -> None:
        """Asks every job to stop; returns at once."""
        self.registry.stopping = True
        self.aftercare.request_stop()
        for running in list(self.registry.running.values()):
            running.stop_reason = running.stop_reason or Reason.SERVICE_STOPPED

    def give_up(self, why: str) -> None:
        """Ends every job and accepts no more, while requests are still answered.

        why: the reason, in the words of the readiness check.
        """
        if not self.stopping:
            log.critical("%s; every job is ended, no more are accepted", why)
            self.registry.why_stopping = why
            self.request_stop()

    def stop(self) -> None:
        """Ends every job, waits until each has restored its loop, and closes the engine.

        A job whose thread hangs does not delay the end of the others for ever.
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
                    "is not written; look at the controller, which restores the loop by itself when the service falls "
                    "silent; the next start checks the loop again",
                    running.job_id, running.tag, ENDS_S,
                )  # fmt: skip
        self.aftercare.close()
        self.requested_decisions.close()
        self.stop_watching()
        if self._watcher.ident is not None:  # a service that never started leaves the jobs as they are
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
        """Ends the thread that watches for stop requests, and leaves jobs and loops as they are; a later `stop` does
        nothing."""
        self._ended.set()
        if self._watcher.ident is not None:
            self._watcher.join()

    def _watch(self) -> None:
        """Watches for stop requests from any host, and finds jobs that the engine has lost."""
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
            except Exception:  # after any error, aborts from other hosts must still be processed
                log.exception("defect while watching the jobs")

    def unwatched_s(self) -> float:
        """Returns for how long no stop requests have been read, s of wall time."""
        return self._machine.monotonic() - self._watched

    def _hold_name(self) -> None:
        """Holds the lock on the host's name. Nothing else in this thread may block: another service waits only a
        limited time for the renewal."""
        while not self._ended.wait(CHECK_S):
            try:
                self.store.check_lock()
            except FolderInUse as error:
                self.give_up(str(error))
                return
            except Exception:
                log.exception("defect while holding the name of the host")
