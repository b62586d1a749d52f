"""Runs one job to its end, in the thread of the job, and stores its result.

This thread steps the loop (heartbeat and lease renewals are sent in `step`), so its work between two samples is short:
reports go to the journal, which another thread writes.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Unpack

from sqlalchemy.exc import SQLAlchemyError

from loopwright.service.errors import Locked
from loopwright.service.execution.procedures import Hooks, Outcome, Rehearse, Tune
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.inputs.request import (
    BadLimits,
    RetuneRequest,
    check_setpoint_source,
    excitations,
    retune_request,
    within,
)
from loopwright.service.jobs.active_job import Running
from loopwright.service.jobs.database_retries import STOP_PATIENCE_S, DatabaseRetries
from loopwright.service.jobs.journal import Journal
from loopwright.service.jobs.loop_directory import LoopDirectory
from loopwright.service.jobs.loop_model import loop_model
from loopwright.service.jobs.machine import Machine
from loopwright.service.jobs.operation import OperationKnowledge, outdated_by
from loopwright.service.jobs.recovery import FALSE_PV_WORDS
from loopwright.service.jobs.registry import Registry
from loopwright.service.loops.loop import Loop
from loopwright.service.loops.observed_loop import ObservedLoop
from loopwright.service.loops.restoration import restore_abandoned
from loopwright.service.observing.kept_knowledge import KeptKnowledge
from loopwright.service.planning.known_loop import known
from loopwright.service.planning.t95 import t95_mismatch
from loopwright.service.results import TransferModelView
from loopwright.service.states.job_state import ACTIVE, GOOD, IllegalMove, JobState, state_after
from loopwright.service.states.loop_state import (
    LoopState,
    after_false_pv,
    differences,
    loop_state,
    same_gains,
    state_json,
)
from loopwright.service.store import unconfirmed_restorations
from loopwright.service.store.job_rows import NoSuchJob
from loopwright.service.store.jobs import Job, JobColumns
from loopwright.service.store.lock import FolderInUse
from loopwright.service.store.store import Store
from loopwright.service.telemetry.logs import about
from loopwright.tuning.fast.excitation_choice import NOT_ASKED
from loopwright.tuning.fast.known_plant.plant import NothingKnown, ObservedPlant
from loopwright.tuning.fast.record import Excitation
from loopwright.tuning.plan import Event, Note
from loopwright.tuning.reasons import Aborted, Ended, Failed, FalsePv, Reason

log = logging.getLogger(__name__)


class Worker:
    """Runs jobs on the loops of the directory.

    tune: runs a job on the loop itself.
    rehearse: runs a dry run.
    knowledge: keeps what the tests tell of their loops.
    operation: tells what operation has shown of them before.
    ended: called with each job at its end, when its loop is restored and the end is stored; it returns at once.
    """

    def __init__(
        self,
        store: Store,
        journal: Journal,
        directory: LoopDirectory,
        registry: Registry,
        tune: Tune,
        rehearse: Rehearse,
        machine: Machine,
        knowledge: KeptKnowledge,
        operation: OperationKnowledge,
        ended: Callable[[Job], None] = lambda job: None,
    ) -> None:
        self.store = store
        self.journal = journal
        self._knowledge = knowledge
        self._operation = operation
        self._ended = ended
        self._directory = directory
        self._registry = registry
        self._tune = tune
        self._rehearse = rehearse
        self._machine = machine
        self._lasting = DatabaseRetries(machine, registry)

    def work(self, job_id: str) -> None:
        """Runs a job to its end, or resumes it after a crash. The engine calls it; a job that is over is left alone.

        Raises FolderInUse when the job belongs to another host.
        """
        try:
            row = self._lasting(lambda: self.store.get(job_id))
            before_s = self._lasting(lambda: self.store.last_sample_s(job_id)) if row.attempt else 0.0
            retune = self._lasting(lambda: self.store.retune_of(job_id))
        except NoSuchJob:
            log.error(
                "job %s was begun and is not in the database: it is lost, the database is older than the engine's file "
                "or was damaged; look at the loops, and at `loopwright check-data`",
                job_id,
            )
            return
        before_s = max(row.plant_time_s, before_s)
        running = Running(job_id, row.loop, self.journal, before_s, self._machine.monotonic, retune)
        if not self._registry.enter(running):
            return
        try:
            # Read again: before the job was registered as running, an abort would have ended it as a waiting one.
            row = self._lasting(lambda: self.store.get(job_id))
            if row.state not in ACTIVE:
                return
            if row.stop_reason is not None:
                running.stop_reason = running.stop_reason or row.stop_reason
            with about(job=job_id, loop=row.loop):
                self._to_the_end(running, row)
        finally:
            self._registry.leave(running)

    def _to_the_end(self, running: Running, row: Job) -> None:
        log.info("job started, attempt %d", row.attempt + 1)
        try:
            self._finish(running, self._run(running, row), row.dry_run)
        except FolderInUse as error:
            log.error("another service writes the end of the job: %s", error)
            raise
        except Exception:
            log.exception("the end of the job could not be written")

    def _run(self, running: Running, row: Job) -> Outcome:
        try:
            request = retune_request(**row.request)
            config = within(self._directory.config(row.loop), request)
            check_setpoint_source(config, request)
            if row.dry_run:
                return self._dry(running, row, config, request)
            outcome = self._live(running, row, config, request)
            self._compare_t95(running, outcome, config)
            return outcome
        except Ended as ended:
            return Outcome(None, ended, None, {})
        except BadLimits as error:
            return Outcome(None, Failed(Reason.BAD_LIMITS, str(error)), None, {})
        except Exception as error:
            log.exception("a defect in the job")
            return Outcome(None, Failed(Reason.INTERNAL, f"{type(error).__name__}: {error}"), None, {})

    def _compare_t95(self, running: Running, outcome: Outcome, config: LoopConfig) -> None:
        """Notes where T95 of the configuration is not that of the model found. The end of the job does not depend on
        it."""
        try:
            model = None if outcome.result is None else outcome.result.model
            if model is None or (isinstance(model, TransferModelView) and model.integrating):
                return
            record_s = sum(outcome.plant_time_s.values()) or math.inf
            if text := t95_mismatch(model.process_model(), config.t95_s, record_s):
                running.on_event(Note(text))
        except Exception:
            log.exception("T95 could not be compared with the model found")

    def _live(self, running: Running, row: Job, config: LoopConfig, request: RetuneRequest) -> Outcome:
        self._check_stop_request(running)
        plant = self._plant_known(running, row, config, request)
        self._check_stop_request(running)
        loop = ObservedLoop(self._directory.open_loop(config))
        try:
            running.loop = loop
            with self._directory.alone_with(row.loop):
                try:
                    state = self._begun(loop, row)
                except (Locked, FalsePv) as ended:  # an earlier attempt is restored already
                    return Outcome(None, ended, None if row.session is None else loop.read(), {})
            earlier = self.store.events(row.id) if row.found is not None else ()
            hooks = Hooks(
                running.on_event, running.on_samples, lambda: running.stop_reason, earlier,
                lambda session: self._lasting(lambda: self.store.note_session(row.id, session)),
                lambda home: self._note_home(row.id, state, home), plant=plant,
                model=self._lasting(lambda: loop_model(self.store, self._knowledge, config, request, state.gains)),
            )  # fmt: skip
            return self._tune(config, request, loop, state, hooks)
        finally:
            running.loop = None  # what it was at the end is not what it is while the end waits for the database
            loop.close()

    def _plant_known(
        self, running: Running, row: Job, config: LoopConfig, request: RetuneRequest
    ) -> ObservedPlant | NothingKnown:
        """Returns what operation has shown of the plant, where the test may begin with it."""
        spec = request.design
        if spec is None or Excitation.OBSERVE not in excitations(config, request):
            return NOT_ASKED
        earlier = self._lasting(lambda: self.store.events(row.id)) if row.found is not None else ()
        why = outdated_by(earlier)
        if why is not None:
            return NothingKnown(f"an earlier attempt has tried gains from operation: {why}")
        return self._lasting(lambda: self._operation.known(row, config, spec, lambda: running.stop_reason is not None))

    def _note_home(self, job_id: str, read: LoopState, home: LoopState) -> None:
        """Stores the state before the test as the controller noted it at the opening, where it changed after the
        service's reading. The note goes through the journal: the session is open, and waits for no database."""
        columns: JobColumns = {}
        if differences(home, read):
            columns = {"found": state_json(home), "previous_gains": asdict(home.gains)}
        self.journal.put(unconfirmed_restorations.opened(job_id, columns))
        if not same_gains(home.gains, read.gains):  # the plan is based on the gains that were read
            raise Aborted(Reason.GAINS_CHANGED, "other gains were accepted as the test was about to begin")

    def _begun(self, loop: Loop, row: Job) -> LoopState:
        """Returns the state of the loop at the start of an attempt, stored before the loop is touched."""
        if row.found is None or row.session is None:
            # No attempt has touched the loop; the state that an earlier one read may have been another tuner's test.
            state = loop.read(beside_tests=True)
            columns: JobColumns = {"previous_gains": asdict(state.gains), "found": state_json(state)}
            self._ask_what_was_found(loop, row.loop)
            if row.found is None:
                columns["attempt"] = 1
                self._move(row.id, JobState.RUNNING, **columns)
            else:
                self._lasting(lambda: self.store.note(row.id, **columns))
                self._resumed(row, "the loop had not been touched")
            return state
        safe = restore_abandoned(loop, loop_state(row.found), row.session)
        if safe.state is None:
            raise Failed(safe.reason or Reason.NODE_LOST, safe.text)
        if safe.held:
            raise FalsePv(Reason.BAD_SAMPLE, FALSE_PV_WORDS)
        if safe.reason is not None:
            raise Aborted(safe.reason, safe.text)
        self._resumed(row, safe.text)
        return safe.state

    def _ask_what_was_found(self, loop: Loop, tag: str) -> None:
        """Notes a test that was cut off and has had this loop held, where no look has found that yet: the controller
        knows it only until the next session."""
        for earlier in self._lasting(lambda: unconfirmed_restorations.rows(self.store, tag)):
            if earlier.found is None or earlier.session is None:
                continue
            safe = restore_abandoned(loop, loop_state(earlier.found), earlier.session)
            if safe.held and safe.state is not None:
                restored, text = state_json(safe.state), safe.text
                self._lasting(
                    partial(unconfirmed_restorations.confirmed, self.store, earlier.id, restored, text, held=True)
                )

    def _dry(self, running: Running, row: Job, config: LoopConfig, request: RetuneRequest) -> Outcome:
        if row.state is JobState.QUEUED:
            self._move(row.id, JobState.RUNNING, attempt=1)
        else:
            self._resumed(row, "a rehearsal begins anew")

        def on_event(event: Event) -> None:
            self._check_stop_request(running)
            running.on_event(event)

        ground = self._lasting(lambda: known(self.store, row.loop, lambda: self._directory.present(row.loop)))
        hooks = Hooks(on_event, running.on_samples, lambda: running.stop_reason, ground=ground)
        return self._rehearse(config, request, hooks)

    def _move(self, job_id: str, wanted: JobState, **columns: Unpack[JobColumns]) -> Job:
        """Moves a job of this thread, once. Where the connection broke before the answer, the job may be moved already:
        nobody else on this host moves it then."""
        broke = False

        def move() -> Job:
            nonlocal broke
            try:
                return self.store.move(job_id, wanted, **columns)
            except SQLAlchemyError:
                broke = True
                raise
            except IllegalMove:
                job = self.store.get(job_id)
                if not broke or (job.state, job.host) != (wanted, self.store.host):
                    raise
                return job

        return self._lasting(move)

    def _resumed(self, row: Job, text: str) -> None:
        details = {"attempt": row.attempt + 1, "text": text}
        self._lasting(lambda: self.store.resumed(row.id, details, attempt=row.attempt + 1))

    @staticmethod
    def _check_stop_request(running: Running) -> None:
        if running.stop_reason is not None:
            raise Aborted(running.stop_reason, "stopped before the next stage")

    def _finish(self, running: Running, outcome: Outcome, dry_run: bool) -> None:
        running.flush()
        while not self.journal.flush(1.0):
            if self._registry.stopping and self.journal.behind_s > STOP_PATIENCE_S:
                log.error("the database accepts nothing, the last reports of the job are lost")
                break
        events = self._lasting(lambda: self.store.events(running.job_id))
        earlier = {done.stage: done.stage_time_s for event in events if (done := event.stage_ended())}
        times = earlier | outcome.plant_time_s
        columns: JobColumns = {
            "result": outcome.result,
            "stage_times_s": times,
            "plant_time_s": max(running.progress.plant_time_s, running.before_s + sum(outcome.plant_time_s.values())),
        }
        if outcome.restored is not None:
            columns["restored"] = state_json(outcome.restored)
        elif self._lasting(lambda: self.store.get(running.job_id)).session is not None:
            columns["restore_unconfirmed"] = True
        state = JobState.REHEARSED if dry_run else JobState.PROPOSED
        if outcome.ended is not None:
            state = state_after(outcome.ended)
            columns |= {"reason": outcome.ended.reason.value, "detail": outcome.ended.detail}
            if isinstance(outcome.ended, FalsePv) and not dry_run:
                columns |= {"false_pv": True, "detail": _with_what_it_left(outcome.ended, outcome.restored)}
        job = self._move(running.job_id, state, **columns)
        self._lasting(lambda: self._operation.outdated(job, events))
        self._knowledge.tested(job, running.pv_range, running.mv_range)
        self._ended(job)
        if outcome.ended is None:
            log.info("job is rehearsed" if dry_run else "job proposes new gains")
        else:
            level = logging.INFO if state in GOOD else logging.WARNING
            log.log(level, "job %s, %s: %s", state.value, outcome.ended.reason.value, outcome.ended.detail)


def _with_what_it_left(found: FalsePv, restored: LoopState | None) -> str:
    """Returns how PV was false, and what the loop was left in."""
    unknown = "the loop could not be read back: it may be in automatic on this PV, so look at it now"
    left = unknown if restored is None else after_false_pv(restored)
    return f"{found.detail}; {left}"
