"""Jobs: the engine starts them, a thread pumps each, the store is the memory, the table of moves the law.

A job's thread is the one that pumps the loop (heartbeat and lease go out from `step`), so what it does between two
samples is kept short: what it has to tell goes into the journal, which another thread writes.
"""

from __future__ import annotations

import logging
import threading
from collections import defaultdict
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, suppress
from dataclasses import asdict, replace
from typing import Any, TypeVar

from sqlalchemy.exc import SQLAlchemyError

from loopwright.service.config import BusConfig, LoopConfig
from loopwright.service.errors import Conflict, Locked, Stopping, UnknownLoop
from loopwright.service.execution.procedures import Hooks, Outcome, Rehearse, Tune
from loopwright.service.job_states import ACTIVE, GOOD, IllegalMove, JobState, shown, state_after
from loopwright.service.jobs.active_job import Running
from loopwright.service.jobs.aftercare import Aftercare
from loopwright.service.jobs.engine import WORKFLOW_VERSION, Engine
from loopwright.service.jobs.journal import Journal, temporary
from loopwright.service.jobs.recovery import Recovery
from loopwright.service.loop_state import LoopState, differences, gains_of, loop_state, same_gains, state_json
from loopwright.service.loops.gain_change import ForeignGains, replace_accepted
from loopwright.service.loops.loop import Loop
from loopwright.service.loops.observed_loop import ObservedLoop
from loopwright.service.loops.restoration import restore_abandoned
from loopwright.service.machine import Machine
from loopwright.service.planning.known_loop import known
from loopwright.service.request import BadLimits, RetuneRequest, retune_request, within
from loopwright.service.store import looked_after, loop_locks
from loopwright.service.store.lock import CHECK_S
from loopwright.service.store.store import Busy, FolderInUse, NoSuchJob, Store, WithJob
from loopwright.service.store.tables import JobRow, LoopLockRow
from loopwright.service.telemetry.logs import about
from loopwright.tuning.plan import Event
from loopwright.tuning.reasons import Aborted, Ended, Failed, Reason

log = logging.getLogger(__name__)
T = TypeVar("T")

LoopFactory = Callable[[LoopConfig], Loop]
REHEARSALS_AT_ONCE = 4
_WATCH_S = 0.2
_RECONCILE_S = 15.0
_AT_BOOT = 16
_STOP_PATIENCE_S = 20.0
_WRITES_S = 10.0
"""Wall time for which a lock waits for a decision that has begun to write to the loop: each of its few answers comes
within a second or two."""
_ENDS_S = 75.0
"""Wall time in which a job that is told to stop has ended: its loop restored (tried for 4 s, and every answer of the
last try may be late, 25 s in all), its reports and its end written or given up (twice _STOP_PATIENCE_S and a wait of
the database). Shorter than TimeoutStopSec of the unit, which would end the service without a word."""


class Jobs:
    """Starts, stops and decides jobs of this host's loops; shows, starts and aborts those of the others.

    buses: what is configured for them.  resume: whether jobs that a dead service left go on at the next start.
    machine: clock and threads.
    """

    def __init__(
        self,
        loops: Mapping[str, LoopConfig],
        store: Store,
        open_loop: LoopFactory,
        tune: Tune,
        rehearse: Rehearse,
        *,
        engine: Engine,
        buses: Mapping[str, BusConfig] | None = None,
        resume: bool = True,
        machine: Machine | None = None,
    ) -> None:
        self.loops = loops
        self.store = store
        self.engine = engine
        self._machine = machine or Machine()
        self.journal = Journal(store, beside=self._machine.writes_beside)
        self.stopping = False
        self._watched = self._machine.monotonic()
        self.why_stopping = "the service is shutting down"
        self._open_loop = open_loop
        self._tune = tune
        self._rehearse = rehearse
        self._buses = buses or {}
        self.resumes = resume
        self._running: dict[str, Running] = {}
        # Guards the registry of running jobs and `stopping`.
        self._lock = threading.Lock()
        # By loop: who is about to begin a job on it, or to decide one.
        self._hands: defaultdict[str, AbstractContextManager[Any]] = defaultdict(self._machine.lock)
        self.aftercare = Aftercare(
            loops, store, lambda config: self._open_loop(config), self._hands, machine=self._machine
        )
        # By loop: set once a decision that writes to its controller has ended.
        self._writes: dict[str, threading.Event] = {}
        self._lost: set[str] = set()
        # By id: jobs whose asker was told that they could not be queued, and whose end could not be written either.
        self._unqueued: dict[str, JobRow] = {}
        self._ended = threading.Event()
        self._watcher = self._machine.thread(self._watch, "watcher")
        self._name_holder = self._machine.thread(self._hold_name, "name holder")

    # at the start of the service
    def boot(self) -> None:
        """Takes this host's loops, makes those of its active jobs safe, then lets the engine go on with the jobs.

        Raises ForeignLoop.
        """
        self.store.own_loops({tag: config.model_dump(mode="json") for tag, config in self.loops.items()})
        recovery = Recovery(self.loops, self.store, self._open_loop, self.resumes, lambda: self.stopping)
        self._machine.side_by_side(recovery.recover, self.store.unfinished(), _AT_BOOT)
        if self.stopping:  # told to end meanwhile: what is left of the jobs is left to the next start
            return
        queues = {self._queue(config): self.at_once(config.bus) for config in self.loops.values()}
        self.engine.launch(self.work, queues | {self._rehearsals(self.store.host): REHEARSALS_AT_ONCE})
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
        with self._lock:
            apart = self._running.keys() | self._unqueued.keys()
            idle = [row for row in self.store.unfinished() if row.id not in apart]
        lost = {row.id for row in idle} - self.engine.known([row.id for row in idle])
        for row in idle:
            if row.id in lost and (at_once or row.id in self._lost):
                self.engine.forget([row.id])
                self.engine.enqueue(row.id, self._queue_of(row))
        self._lost = lost

    def _queue_of(self, row: JobRow) -> str:
        return self._rehearsals(row.host) if row.dry_run else self._queue(self.loops[row.loop])

    def _queue(self, config: LoopConfig, host: str | None = None) -> str:
        """A bus has its name from its host: two hosts may both have a vcan0."""
        return f"{host or self.store.host}:{config.bus}"

    @staticmethod
    def _rehearsals(host: str) -> str:
        return f"{host}:rehearsals"

    def at_once(self, bus: str) -> int:
        """How many loops of one of our buses may be under test at the same time."""
        return self._buses.get(bus, BusConfig()).at_once

    # what there is
    def config(self, tag: str) -> LoopConfig:
        return self.owner(tag)[0]

    def owner(self, tag: str) -> tuple[LoopConfig, str]:
        """The loop's configuration, and the host that has it. Raises UnknownLoop."""
        if tag in self.loops:
            return self.loops[tag], self.store.host
        row = self.store.foreign_loop(tag)
        if row is None:
            raise UnknownLoop(tag)
        return LoopConfig.model_validate(row.config), row.host

    def everywhere(self) -> list[tuple[LoopConfig, str]]:
        """Every loop of every host: ours first."""
        ours = [(config, self.store.host) for config in self.loops.values()]
        return ours + [(LoopConfig.model_validate(row.config), row.host) for row in self.store.foreign_loops()]

    def running(self, job_id: str) -> Running | None:
        return self._running.get(job_id)

    def under_test(self) -> dict[str, str]:
        """The tags of the loops that a job has in its hands, by job."""
        return {job_id: running.tag for job_id, running in self._running.copy().items()}

    def live(self, tag: str) -> LoopState | None:
        """The present state of a loop: from the job if one runs, else read from the bus; None on another host."""
        if tag not in self.loops:
            self.owner(tag)
            return None
        active = self.store.active(tag)
        running = self.running(active.id) if active else None
        state = running.loop.latest if running and running.loop else None
        if state:
            return state
        return self._read(tag)

    def _read(self, tag: str) -> LoopState:
        """A loop of ours, read from the bus. Raises Ended."""
        loop = self._open_loop(self.loops[tag])
        try:
            return loop.read()
        finally:
            loop.close()

    # start and stop
    def start(self, tag: str, request: RetuneRequest, also: WithJob | None = None) -> JobRow:
        """Queues a job on the host that has the loop. Raises UnknownLoop, BadLimits, Busy, Locked, Stopping.

        also: what is written in the same transaction; when it raises, there is no job.
        """
        config, host = self.owner(tag)
        within(config, request)
        if self.stopping:
            raise Stopping(self.why_stopping)
        asked = request.asked()
        row = self.store.create(tag, asked, request.requested_by, request.dry_run, host, WORKFLOW_VERSION, also)
        try:
            self.engine.enqueue(row.id, self._rehearsals(host) if row.dry_run else self._queue(config, host))
        except Exception:
            # Whoever asked is told that it failed: it must not begin later.
            self._unqueued[row.id] = row
            self._end_unqueued()
            raise
        return row

    def _end_unqueued(self) -> None:
        """Ends the jobs that could not be queued, as far as the database takes it."""
        for job_id, row in list(self._unqueued.items()):
            try:
                if row.host == self.store.host:
                    self._heed(job_id, Reason.INTERNAL, JobState.FAILED, "it could not be queued")
                else:  # its own host may have found and begun it: only that one can tell
                    with suppress(IllegalMove):
                        self.store.wish_to_stop(job_id, Reason.INTERNAL.value, "service")
            except SQLAlchemyError as error:
                log.error(
                    "job %s of loop %s could not be queued, and its end not be written: it does not begin, and holds "
                    "the loop until the database takes its end, which is tried every %.0f s: %s",
                    job_id, row.loop, _RECONCILE_S, error,
                )  # fmt: skip
            else:
                self._unqueued.pop(job_id, None)

    def abort(self, job_id: str, by: str) -> JobRow:
        """Asks an active job to stop; it ends as aborted once the loop is restored. Raises IllegalMove.

        One that runs here hears of it before it is written down: the loop does not wait for the database.
        """
        heard = self.tell_to_stop(job_id)
        row = self.store.wish_to_stop(job_id, Reason.OPERATOR.value, by, heard)
        if row.host == self.store.host:
            self._heed(job_id, Reason.OPERATOR)
        return self.store.get(job_id)

    def tell_to_stop(self, job_id: str) -> bool:
        """A job that runs here hears that an operator wants it to end; returns at once, and writes nothing down. False
        where no job hears of it."""
        running = self._running.get(job_id)
        if running is None:
            return False
        running.stop_reason = running.stop_reason or Reason.OPERATOR
        return running.stop_reason is Reason.OPERATOR

    def _heed(
        self,
        job_id: str,
        reason: Reason,
        state: JobState = JobState.ABORTED,
        detail: str = "stopped while it waited for its turn",
    ) -> None:
        """A job that runs hears of it at its next sample; one that waits for its turn has nothing to restore, and
        ends in that state."""
        with self._lock:
            running = self._running.get(job_id)
            if running is not None:
                running.stop_reason = running.stop_reason or reason
                return
            row = self.store.get(job_id)
            if JobState(row.state) in ACTIVE:
                self.store.move(job_id, state, reason=reason.value, detail=detail)

    def request_stop(self) -> None:
        """Tells every job to end; returns at once."""
        self.stopping = True
        self.aftercare.request_stop()
        for running in list(self._running.values()):
            running.stop_reason = running.stop_reason or Reason.SERVICE_STOPPED

    def give_up(self, why: str) -> None:
        """Ends every job and takes no more, while requests go on being answered; why: as readiness says it."""
        if not self.stopping:
            log.critical("%s; every job is ended, no more are taken", why)
            self.why_stopping = why
            self.request_stop()

    def stop(self) -> None:
        """Ends every job, waits until each has restored its loop, and gives the engine up.

        A job whose thread hangs does not hold up the others' ends for ever.
        """
        if self._ended.is_set():
            return
        with self._lock:
            self.request_stop()
        give_up = self._machine.monotonic() + _ENDS_S
        for running in list(self._running.values()):
            if not running.over.wait(max(0.0, give_up - self._machine.monotonic())):
                log.error(
                    "job %s of loop %s has not ended in %.0f s: whether its loop is restored is unknown, and its end "
                    "is not written; look at the controller, which goes back by itself when it hears no more of the "
                    "service; the next start looks at the loop again",
                    running.job_id, running.tag, _ENDS_S,
                )  # fmt: skip
        self.aftercare.close()
        self._ended.set()
        if self._watcher.ident is not None:  # a service that did not come to its start leaves the jobs as they are
            self._watcher.join()
            try:
                for row in self._lasting(self.store.unfinished):
                    self._heed(row.id, Reason.SERVICE_STOPPED)
            except (SQLAlchemyError, FolderInUse) as error:
                log.error("the end of the waiting jobs could not be written, they go on at the next start: %s", error)
            if self._name_holder.ident is not None:
                self._name_holder.join(_STOP_PATIENCE_S)
        self.engine.close()
        self.journal.close(_STOP_PATIENCE_S)

    def _watch(self) -> None:
        """Hears of jobs to stop, from whatever host; finds what the engine has lost."""
        reconciled = self._machine.monotonic()
        while not self._ended.wait(_WATCH_S):
            self._watched = self._machine.monotonic()
            if self.store.damaged is not None:
                self.give_up(self.store.damaged)
                continue
            try:
                for job_id, reason in self.store.wishes_to_stop().items():
                    self._heed(job_id, Reason(reason))
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
        """For how long nobody has heard of jobs to stop, s of wall time."""
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

    # loops looked after
    def dismiss(self, tag: str, by: str) -> list[str]:
        """A person answers for a loop that is looked after: it is not looked at any more. The jobs it was for; none
        when it was not looked after. Raises UnknownLoop, Busy."""
        if not looked_after.rows(self.store, tag):
            self.owner(tag)
            return []
        active = self.store.active(tag)
        if active is not None:
            raise Busy(tag, active.id)
        return looked_after.dismissed(self.store, tag, by)

    # locks
    def lock(self, tag: str, reason: str, by: str) -> tuple[LoopLockRow, JobRow | None]:
        """From now on no test begins on the loop, whatever host it is on, and no decision writes to it. Returns the
        lock, and the job whose test was running already and goes on. Raises UnknownLoop, LockedOtherwise."""
        self.owner(tag)
        with self.store.writing() as session:
            row = loop_locks.lock(session, tag, reason, by)
        writes = self._writes.get(tag)
        if writes is not None and not writes.wait(_WRITES_S):
            raise Conflict(
                f"loop {tag} is locked now, but a decision that began before is still writing to its controller; "
                "look again in a moment"
            )
        active = self.store.active(tag)
        return row, active if active is not None and active.state == JobState.RUNNING else None

    def unlock(self, tag: str, by: str) -> LoopLockRow | None:
        """What the loop was locked for; None: it was not. Raises UnknownLoop."""
        self.owner(tag)
        with self.store.writing() as session:
            return loop_locks.unlock(session, tag, by)

    def locks(self) -> dict[str, LoopLockRow]:
        """The locks by loop, of every host."""
        with self.store.reading() as session:
            return loop_locks.every(session)

    # decide
    def accept(self, job_id: str, by: str) -> JobRow:
        """Makes the proposed gains the accepted ones of the controller, and reads them back.

        After an error it is asked again, which finishes what was begun, or rolled back.
        """
        return self._decide(job_id, JobState.ACCEPTED, by)

    def rollback(self, job_id: str, by: str) -> JobRow:
        """Declines a proposal (the loop has its old gains already), or takes back a change that is accepted or was
        begun to be. Gains that somebody else has put in since stay: a proposal is declined, an accepted change is not
        taken back (Conflict)."""
        return self._decide(job_id, JobState.ROLLED_BACK, by)

    def _decide(self, job_id: str, wanted: JobState, by: str) -> JobRow:
        row = self.store.get(job_id)
        with self._hands[row.loop]:
            row = self.store.get(job_id)
            now = shown(row.state, row.dry_run)
            if now not in (JobState.PROPOSED, JobState.ACCEPTED) or now is wanted:
                raise IllegalMove(now, wanted)
            active = self.store.active(row.loop)
            if active is not None:
                raise Busy(row.loop, active.id)
            if wanted is JobState.ROLLED_BACK and (declined := self.store.decline(job_id, by)) is not None:
                return declined
            with self.store.reading() as session:
                loop_locks.check(session, row.loop)
            config, host = self.owner(row.loop)
            if host != self.store.host:
                raise Conflict(f"loop {row.loop} is on the bus of host {host}: only the service there can write to it")
            old, new = gains_of(row.old_gains), gains_of((row.result or {}).get("gains"))
            before, after = (old, new) if wanted is JobState.ACCEPTED else (new, old)
            begun = self.store.decision_begun(job_id)
            over = self._machine.event()

            def begin() -> None:
                self._writes[row.loop] = over  # a lock that finds the decision begun waits for its end
                self.store.begin_decision(job_id, wanted, by)

            try:
                loop = self._open_loop(config)
                try:
                    state = replace_accepted(loop, before, after, begun, begin)
                finally:
                    loop.close()
            except ForeignGains as foreign:
                # An acceptance that broke off, and then other gains by hand: there is nothing left to take back.
                if not (begun and now is JobState.PROPOSED and wanted is JobState.ROLLED_BACK):
                    raise
                detail = f"declined; the controller holds {foreign.found.gains}: somebody else's, left as they are"
                return self.store.move(job_id, wanted, by=by, restored=state_json(foreign.found), detail=detail)
            except Locked:  # before anything was written
                raise
            except Ended as ended:
                self.store.decision_failed(job_id, wanted, by, f"{ended.reason.value}: {ended.detail}")
                if ended.reason is Reason.GAINS_CHANGED:
                    raise Conflict(ended.detail) from ended
                raise
            finally:
                self._writes.pop(row.loop, None)
                over.set()
            return self.store.move(job_id, wanted, by=by, restored=state_json(state))

    # the thread of a job
    def work(self, job_id: str) -> None:
        """Runs a job to its end, or its rest after a crash. Called by the engine; a job that is over is left alone.

        Raises FolderInUse: the job is another's by now.
        """
        try:
            row = self._lasting(lambda: self.store.get(job_id))
            before_s = self._lasting(lambda: self.store.last_sample_s(job_id)) if row.attempt else 0.0
        except NoSuchJob:
            log.error(
                "job %s was begun and is not in the database: it is lost, the database is older than the engine's file "
                "or was damaged; look at the loops, and at `loopwright check-data`",
                job_id,
            )
            return
        with self._lock:
            if self.stopping or job_id in self._running or job_id in self._unqueued:
                return
            before_s = max(row.plant_time_s, before_s)
            running = Running(job_id, row.loop, self.journal, before_s, self._machine.monotonic)
            self._running[job_id] = running
        try:
            # Read anew: until it was among those that run, an abort ended it as one that waits for its turn.
            row = self._lasting(lambda: self.store.get(job_id))
            if JobState(row.state) not in ACTIVE:
                return
            if row.stop_reason is not None:
                running.stop_reason = running.stop_reason or Reason(row.stop_reason)
            with about(job=job_id, loop=row.loop):
                self._to_the_end(running, row)
        finally:
            with self._lock:
                self._running.pop(job_id, None)
            running.over.set()

    def _to_the_end(self, running: Running, row: JobRow) -> None:
        log.info("job started, attempt %d", row.attempt + 1)
        try:
            self._finish(running, self._run(running, row), row.dry_run)
        except FolderInUse as error:
            log.error("the end of the job is another's to write: %s", error)
            raise
        except Exception:
            log.exception("the end of the job could not be written")

    def _run(self, running: Running, row: JobRow) -> Outcome:
        try:
            request = retune_request(**row.request)
            config = within(self.config(row.loop), request)
            run = self._dry if row.dry_run else self._live
            return run(running, row, config, request)
        except Ended as ended:
            return Outcome(None, ended, None, {})
        except BadLimits as error:
            return Outcome(None, Failed(Reason.BAD_LIMITS, str(error)), None, {})
        except Exception as error:
            log.exception("a defect in the job")
            return Outcome(None, Failed(Reason.INTERNAL, f"{type(error).__name__}: {error}"), None, {})

    def _live(self, running: Running, row: JobRow, config: LoopConfig, request: RetuneRequest) -> Outcome:
        self._check_stop(running)
        loop = ObservedLoop(self._open_loop(config))
        try:
            running.loop = loop
            with self._hands[row.loop]:
                try:
                    state = self._begun(loop, row)
                except Locked as locked:  # what an attempt before has left is home already
                    return Outcome(None, locked, None if row.session is None else loop.read(), {})
            earlier = self.store.events(row.id) if row.found is not None else ()
            hooks = Hooks(
                running.on_event, running.on_samples, lambda: running.stop_reason, earlier,
                lambda session: self._lasting(lambda: self.store.note_session(row.id, session)),
                lambda home: self._note_home(row.id, state, home),
            )  # fmt: skip
            return self._tune(config, request, loop, state, hooks)
        finally:
            loop.close()

    def _note_home(self, job_id: str, read: LoopState, home: LoopState) -> None:
        """What the controller noted as it opened the session counts, where a hand was faster than our reading.

        Through the journal: the session is open, and waits for no database.
        """
        columns: dict[str, Any] = {}
        if differences(home, read):
            columns = {"found": state_json(home), "old_gains": asdict(home.gains)}
        self.journal.put(looked_after.opened(job_id, columns))
        if not same_gains(home.gains, read.gains):  # the plan reckons with those that were read
            raise Aborted(Reason.GAINS_CHANGED, "other gains were accepted as the test was about to begin")

    def _begun(self, loop: Loop, row: JobRow) -> LoopState:
        """The state of the loop as an attempt begins, written down before anything is touched."""
        if row.found is None or row.session is None:
            # No attempt has touched it. What an earlier one had read may have been another tuner's test.
            state = loop.read(beside_tests=True)
            columns: dict[str, Any] = {"old_gains": asdict(state.gains), "found": state_json(state)}
            if row.found is None:
                self._lasting(lambda: self.store.move(row.id, JobState.RUNNING, attempt=1, **columns))
            else:
                self._lasting(lambda: self.store.note(row.id, **columns))
                self._resumed(row, "the loop had not been touched")
            return state
        safe = restore_abandoned(loop, loop_state(row.found), row.session)
        if safe.state is None:
            raise Failed(safe.reason or Reason.NODE_LOST, safe.text)
        if safe.reason is not None:
            raise Aborted(safe.reason, safe.text)
        self._resumed(row, safe.text)
        return safe.state

    def _dry(self, running: Running, row: JobRow, config: LoopConfig, request: RetuneRequest) -> Outcome:
        if JobState(row.state) is JobState.QUEUED:
            self._lasting(lambda: self.store.move(row.id, JobState.RUNNING, attempt=1))
        else:
            self._resumed(row, "a rehearsal begins anew")

        def on_event(event: Event) -> None:
            self._check_stop(running)
            running.on_event(event)

        ground = self._lasting(lambda: known(self.store, row.loop, lambda: self._present(row.loop)))
        hooks = Hooks(on_event, running.on_samples, lambda: running.stop_reason, ground=ground)
        return self._rehearse(config, request, hooks)

    def _present(self, tag: str) -> LoopState:
        """The loop as its controller has it, or as the job that has the loop now found it. Raises Ended."""
        active = self.store.active(tag)
        if active is not None and active.found is not None:
            return replace(loop_state(active.found), gains=gains_of(active.old_gains))
        return self._read(tag)

    def _resumed(self, row: JobRow, text: str) -> None:
        told = {"attempt": row.attempt + 1, "text": text}
        self._lasting(lambda: self.store.resumed(row.id, told, attempt=row.attempt + 1))

    @staticmethod
    def _check_stop(running: Running) -> None:
        if running.stop_reason is not None:
            raise Aborted(running.stop_reason, "stopped before the next stage")

    def _finish(self, running: Running, outcome: Outcome, dry_run: bool) -> None:
        running.flush()
        while not self.journal.flush(1.0):
            if self.stopping and self.journal.behind_s > _STOP_PATIENCE_S:
                log.error("the database takes nothing, the last reports of the job are lost")
                break
        times = self._earlier_times(running.job_id) | outcome.plant_time_s
        columns: dict[str, Any] = {
            "result": outcome.result,
            "stage_times_s": times,
            "plant_time_s": max(running.progress.plant_time_s, running.before_s + sum(outcome.plant_time_s.values())),
        }
        if outcome.restored is not None:
            columns["restored"] = state_json(outcome.restored)
        elif self._lasting(lambda: self.store.get(running.job_id)).session is not None:
            columns["look_after"] = True
        state = JobState.REHEARSED if dry_run else JobState.PROPOSED
        if outcome.ended is not None:
            state = state_after(outcome.ended)
            columns |= {"reason": outcome.ended.reason.value, "detail": outcome.ended.detail}
        self._lasting(lambda: self.store.move(running.job_id, state, **columns))
        if outcome.ended is None:
            log.info("job is rehearsed" if dry_run else "job proposes new gains")
        else:
            level = logging.INFO if state in GOOD else logging.WARNING
            log.log(level, "job %s, %s: %s", state.value, outcome.ended.reason.value, outcome.ended.detail)

    def _earlier_times(self, job_id: str) -> dict[str, float]:
        """Plant time of the stages that any attempt has finished, s."""
        events = self._lasting(lambda: self.store.events(job_id))
        return {e.data["stage"]: e.data["stage_time_s"] for e in events if e.kind == "stage_done"}

    def _lasting(self, wish: Callable[[], T]) -> T:
        """The answer of the database, asked until it gives one; while the service stops, for a while only."""
        since = self._machine.monotonic()
        while True:
            try:
                return wish()
            except SQLAlchemyError as error:
                if not temporary(error) or (self.stopping and self._machine.monotonic() - since > _STOP_PATIENCE_S):
                    raise
                self._machine.sleep(0.5)
