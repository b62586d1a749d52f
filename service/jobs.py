"""Jobs: one thread per active job, the store as the memory, the table of moves as the law.

A job's thread is the one that pumps the loop (heartbeat and lease go out from `step`), so what it does between two
samples is kept short: events are one small transaction, samples are gathered into blocks.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

from service.config import LoopConfig
from service.logs import about
from service.loop import Loop, LoopState
from service.metrics import STAGE_SECONDS
from service.observed import ObservedLoop
from service.progress import Progress
from service.request import RetuneRequest, within
from service.states import ACTIVE, IllegalMove, JobState, state_after
from service.store.store import Busy, Store
from service.store.tables import JobRow
from service.work import Hooks, Outcome, Rehearse, Tune, plain
from tuning.gains import Gains
from tuning.plan import Event, Note, Sample, StageDone, StageStarted
from tuning.reasons import Aborted, Ended, Failed, Reason

log = logging.getLogger(__name__)

LoopFactory = Callable[[LoopConfig], Loop]
_BLOCK_SAMPLES = 4096
_BLOCK_WALL_S = 1.0


class UnknownLoop(Exception):
    """No loop of that tag is configured."""

    def __init__(self, tag: str) -> None:
        super().__init__(f"there is no loop {tag}")
        self.tag = tag


class Stopping(Exception):
    """The service is shutting down and takes no new work."""


class Conflict(Exception):
    """The job or its loop is not as the wish supposes."""


class Running:
    """The live part of an active job; other threads read it and may set `stop_reason`."""

    def __init__(self, job_id: str, store: Store) -> None:
        self.job_id = job_id
        self.progress = Progress()
        self.loop: ObservedLoop | None = None
        self.stop_reason: Reason | None = None
        self.thread: threading.Thread | None = None
        self._store = store
        self._buffer: list[Sample] = []
        self._stage = "preflight"
        self._stage_since = 0.0
        self._boundaries: list[tuple[float, str]] = []
        self._last_t = -math.inf
        self._flushed = time.monotonic()

    def on_event(self, event: Event) -> None:
        self.keep_time()
        if isinstance(event, StageStarted):
            self.progress.stage_started(event)
            self._stage_since = self.progress.plant_time_s
            self._boundaries.append((self._last_t, event.stage))
            self._store.update(self.job_id, stage=event.stage, plant_time_s=self.progress.plant_time_s)
            data: dict[str, Any] = {
                "stage": event.stage, "expected_s": event.expected_s, "remaining_s": event.remaining_s,
            }  # fmt: skip
            self._tell("stage_started", data)
        elif isinstance(event, StageDone):
            if self.loop is not None:  # a rehearsal has no plant whose time it takes
                STAGE_SECONDS.labels(event.stage).observe(self.progress.plant_time_s - self._stage_since)
            self._tell("stage_done", {"stage": event.stage, "result": plain(event.result)})
        elif isinstance(event, Note):
            self._tell("note", {"stage": self.progress.stage, "text": event.text})

    def on_samples(self, samples: list[Sample]) -> None:
        """Samples come in the runner's blocks, which do not end where a stage does: split by the stages' times."""
        self.keep_time()
        for sample in samples:
            while self._boundaries and sample.t > self._boundaries[0][0]:
                self.flush()
                self._stage = self._boundaries.pop(0)[1]
            self._buffer.append(sample)
        if len(self._buffer) >= _BLOCK_SAMPLES or time.monotonic() - self._flushed > _BLOCK_WALL_S:
            self.flush()

    def flush(self) -> None:
        """Writes the gathered samples as one block of their stage."""
        if self._buffer:
            self._store.add_samples(self.job_id, self._stage, self._buffer)
            self._buffer = []
        self._flushed = time.monotonic()

    def keep_time(self) -> None:
        """Brings the progress up to the latest sample."""
        t = self.loop.t_s if self.loop else None
        if t is not None:
            self._last_t = t
            self.progress.at(t)

    def _tell(self, kind: str, data: dict[str, Any]) -> None:
        self._store.append(self.job_id, kind, data, self.progress.plant_time_s)


class Jobs:
    """Starts, stops and decides jobs."""

    def __init__(
        self, loops: Mapping[str, LoopConfig], store: Store, open_loop: LoopFactory, tune: Tune, rehearse: Rehearse
    ) -> None:
        self.loops = loops
        self.store = store
        self._open_loop = open_loop
        self._tune = tune
        self._rehearse = rehearse
        self._running: dict[str, Running] = {}
        # Guards starting a job against deciding another one on the same loop, and the two fields around it.
        self._lock = threading.Lock()
        self.stopping = False
        for row in store.unfinished():
            store.move(
                row.id,
                JobState.INTERRUPTED,
                reason=Reason.SERVICE_STOPPED.value,
                detail="the service ended without stopping this job; the controller went back by itself",
            )

    # what there is
    def config(self, tag: str) -> LoopConfig:
        if tag not in self.loops:
            raise UnknownLoop(tag)
        return self.loops[tag]

    def running(self, job_id: str) -> Running | None:
        return self._running.get(job_id)

    def live(self, tag: str) -> tuple[LoopState, str | None]:
        """The present state of a loop and the job it belongs to: from the job if one runs, else read from the bus."""
        config = self.config(tag)
        active = self.store.active(tag)
        running = self.running(active.id) if active else None
        state = running.loop.latest if running and running.loop else None
        if active and state:
            return state, active.id
        loop = self._open_loop(config)
        try:
            return loop.read(), active.id if active else None
        finally:
            loop.close()

    # start and stop
    def start(self, tag: str, request: RetuneRequest) -> JobRow:
        """Queues a job and starts its thread. Raises UnknownLoop, BadLimits, Busy, Stopping."""
        config = within(self.config(tag), request)
        with self._lock:
            if self.stopping:
                raise Stopping("the service is shutting down")
            row = self.store.create(
                tag, request.model_dump(mode="json", exclude_none=True), request.requested_by, request.dry_run
            )
            running = Running(row.id, self.store)
            self._running[row.id] = running
            # Not a daemon: the process must not end before the loop is restored.
            running.thread = threading.Thread(target=self._work, args=(running, config, request), name=f"job-{row.id}")
            running.thread.start()
        return row

    def abort(self, job_id: str, by: str) -> JobRow:
        """Asks an active job to stop; it ends as aborted once the loop is restored."""
        row = self.store.get(job_id)
        running = self.running(job_id)
        if running is None or JobState(row.state) not in ACTIVE:
            raise IllegalMove(JobState(row.state), JobState.ABORTED)
        if running.stop_reason is None:
            running.stop_reason = Reason.OPERATOR
            self.store.abort_requested(job_id, by, running.progress.plant_time_s)
        return row

    def request_stop(self) -> None:
        """Tells every job to end; returns at once."""
        self.stopping = True
        for running in list(self._running.values()):
            running.stop_reason = running.stop_reason or Reason.SERVICE_STOPPED

    def stop(self) -> None:
        """Ends every job and waits until each has restored its loop."""
        with self._lock:
            self.request_stop()
        for running in list(self._running.values()):
            if running.thread is not None:
                running.thread.join()

    # decide
    def accept(self, job_id: str, by: str) -> JobRow:
        """Makes the proposed gains the accepted ones of the controller, and reads them back."""
        return self._decide(job_id, JobState.ACCEPTED, by)

    def rollback(self, job_id: str, by: str) -> JobRow:
        """Declines a proposal (the loop has its old gains already), or takes an accepted change back."""
        return self._decide(job_id, JobState.ROLLED_BACK, by)

    def _decide(self, job_id: str, wanted: JobState, by: str) -> JobRow:
        with self._lock:
            row = self.store.get(job_id)
            now = JobState(row.state)
            if now not in (JobState.PROPOSED, JobState.ACCEPTED) or now is wanted:
                raise IllegalMove(now, wanted)
            if row.dry_run:
                raise Conflict("a dry run touched no loop, there is nothing to accept or to roll back")
            active = self.store.active(row.loop)
            if active is not None:
                raise Busy(row.loop, active.id)
            if now is JobState.PROPOSED and wanted is JobState.ROLLED_BACK:
                return self.store.move(job_id, wanted, by=by)
            old, new = gains_of(row.old_gains), gains_of((row.result or {}).get("gains"))
            before, after = (old, new) if wanted is JobState.ACCEPTED else (new, old)
            try:
                state = self._exchange(self.config(row.loop), before, after)
            except Ended as ended:
                self.store.decision_failed(job_id, wanted, by, f"{ended.reason.value}: {ended.detail}")
                raise
            return self.store.move(job_id, wanted, by=by, restored=state_json(state))

    def _exchange(self, config: LoopConfig, before: Gains, after: Gains) -> LoopState:
        loop = self._open_loop(config)
        try:
            present = loop.read().gains
            if not same(present, before):
                raise Conflict(
                    f"the controller holds {present}, not the {before} this decision is about: "
                    "somebody changed the gains in between; retune instead"
                )
            state = loop.accept(after)
            if not same(state.gains, after):
                raise Failed(Reason.RESTORE_UNCONFIRMED, f"wrote {after}, read back {state.gains}")
            return state
        finally:
            loop.close()

    # the thread of a job
    def _work(self, running: Running, config: LoopConfig, request: RetuneRequest) -> None:
        with about(job=running.job_id, loop=config.tag):
            log.info("job started")
            self._do(running, config, request)

    def _do(self, running: Running, config: LoopConfig, request: RetuneRequest) -> None:
        try:
            outcome = self._dry(running, config, request) if request.dry_run else self._live(running, config, request)
        except Ended as ended:
            outcome = Outcome(None, ended, None, {})
        except Exception as error:
            log.exception("a defect in the job")
            outcome = Outcome(None, Failed(Reason.INTERNAL, f"{type(error).__name__}: {error}"), None, {})
        try:
            self._finish(running, outcome)
        except Exception:
            log.exception("the end of the job could not be written")
        finally:
            self._running.pop(running.job_id, None)

    def _live(self, running: Running, config: LoopConfig, request: RetuneRequest) -> Outcome:
        self._check_stop(running)
        loop = ObservedLoop(self._open_loop(config))
        try:
            running.loop = loop
            state = loop.read()
            self.store.move(running.job_id, JobState.RUNNING, old_gains=asdict(state.gains))
            hooks = Hooks(running.on_event, running.on_samples, lambda: running.stop_reason)
            return self._tune(config, request, loop, state, hooks)
        finally:
            loop.close()

    def _dry(self, running: Running, config: LoopConfig, request: RetuneRequest) -> Outcome:
        self.store.move(running.job_id, JobState.RUNNING)

        def on_event(event: Event) -> None:
            self._check_stop(running)
            running.on_event(event)

        return self._rehearse(config, request, Hooks(on_event, running.on_samples, lambda: running.stop_reason))

    @staticmethod
    def _check_stop(running: Running) -> None:
        if running.stop_reason is not None:
            raise Aborted(running.stop_reason, "stopped before the next stage")

    def _finish(self, running: Running, outcome: Outcome) -> None:
        running.flush()
        columns: dict[str, Any] = {
            "result": outcome.result,
            "stage_times_s": outcome.plant_time_s,
            "plant_time_s": sum(outcome.plant_time_s.values()) or running.progress.plant_time_s,
        }
        if outcome.restored is not None:
            columns["restored"] = state_json(outcome.restored)
        if outcome.ended is None:
            self.store.move(running.job_id, JobState.PROPOSED, **columns)
            log.info("job proposes new gains")
        else:
            ended = outcome.ended
            columns |= {"reason": ended.reason.value, "detail": ended.detail}
            self.store.move(running.job_id, state_after(ended), **columns)
            log.warning("job %s, %s: %s", state_after(ended).value, ended.reason.value, ended.detail)


def gains_of(data: dict[str, Any] | None) -> Gains:
    """Gains from a job's JSON."""
    if not data:
        raise Conflict("the job has no gains to put")
    return Gains(**{name: float(data[name]) for name in Gains.__dataclass_fields__ if data.get(name) is not None})


def state_json(state: LoopState) -> dict[str, Any]:
    """A loop's state as JSON, the mode by name."""
    return asdict(state) | {"mode": state.mode.name.lower()}


def same(one: Gains, other: Gains) -> bool:
    """Equal as far as the bus can tell: gains travel as float32 (24 bits, 6e-8)."""
    return all(
        math.isclose(getattr(one, name), getattr(other, name), rel_tol=1e-6, abs_tol=1e-9)
        for name in Gains.__dataclass_fields__
    )
