"""The recovery of a job after the death of its service: the loop is restored, and the job resumed or ended."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from loopwright.service.errors import Locked, RemoteSetpoint
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.inputs.request import check_setpoint_source, retune_request, within
from loopwright.service.jobs.engine import WORKFLOW_VERSION
from loopwright.service.loops.loop import Loop
from loopwright.service.loops.restoration import Restoration, restore_loop_of
from loopwright.service.states.job_state import JobState
from loopwright.service.states.loop_state import state_json
from loopwright.service.store import loop_locks
from loopwright.service.store.jobs import Job, JobColumns
from loopwright.service.store.store import Store
from loopwright.tuning.reasons import Reason

log = logging.getLogger(__name__)

FALSE_PV_WORDS = "the test had found PV to be false (the job's events may say how)"
MAX_ATTEMPTS = 10
"""Number of attempts after which a job is not resumed again."""


@dataclass(frozen=True)
class Recovery:
    """Recovers the jobs of a dead service.

    resumes: whether such jobs are resumed.
    stopping: whether this service is to end before it has started; the remaining jobs are then left to the next start.
    """

    loops: Mapping[str, LoopConfig]
    store: Store
    open_loop: Callable[[LoopConfig], Loop]
    resumes: bool
    stopping: Callable[[], bool] = lambda: False

    def recover(self, row: Job) -> None:
        """Restores the loop of the job, and ends the job if it is not to be resumed."""
        if self.stopping():
            return
        safe: Restoration | None = None
        if row.found is not None and row.session is not None:
            safe = restore_loop_of(row, self.loops, self.open_loop)
            self.store.append(row.id, "loop_found", {"text": safe.text}, row.plant_time_s)
        columns: JobColumns = {}
        if safe is not None and safe.state is not None:
            columns["restored"] = state_json(safe.state)
        elif safe is not None:
            columns["restore_unconfirmed"] = True
        if safe is not None and safe.held:
            columns |= {"reason": Reason.BAD_SAMPLE, "false_pv": True}
            columns["detail"] = f"{FALSE_PV_WORDS}, and was cut off by the end of the service: {_loop_words(safe)}"
            self.store.move(row.id, JobState.FAILED, **columns)
            return
        if row.stop_reason is not None:
            columns["reason"] = row.stop_reason
            columns["detail"] = "asked to stop before the service ended; " + _loop_words(safe)
            self.store.move(row.id, JobState.ABORTED, **columns)
            return
        why = self._why_not(row, safe)
        if why is not None:
            reason, text = why
            columns["reason"] = reason
            columns["detail"] = f"cut off by the end of the service, and not resumed: {text}; {_loop_words(safe)}"
            self.store.move(row.id, JobState.INTERRUPTED, **columns)

    def _why_not(self, row: Job, safe: Restoration | None) -> tuple[Reason, str] | None:
        """Returns why a job is not to be resumed, None where it is."""
        config = self.loops.get(row.loop)
        if row.version != WORKFLOW_VERSION:
            return Reason.SERVICE_STOPPED, "it was begun by another version of Loopwright"
        if config is None:
            return Reason.SERVICE_STOPPED, "its loop is no longer configured here"
        if not self.resumes:
            return Reason.SERVICE_STOPPED, "the service was started with --no-resume"
        if row.found is not None and (locked := self._locked(row.loop)) is not None:
            return Reason.LOCKED, locked
        if safe is not None and safe.reason is not None:
            return safe.reason, "the loop is not as the job had found it" if safe.state else "the loop is not reached"
        if row.attempt >= MAX_ATTEMPTS:
            return Reason.SERVICE_STOPPED, f"that was attempt {row.attempt} of at most {MAX_ATTEMPTS}"
        try:
            request = retune_request(**row.request)
            check_setpoint_source(within(config, request), request)
        except RemoteSetpoint as remote:
            return remote.reason, f"the loop's configuration has changed: {remote.detail}"
        except ValueError as error:  # BadLimits too
            return Reason.BAD_LIMITS, f"the loop's configuration has changed: {error}"
        return None

    def _locked(self, loop: str) -> str | None:
        """Returns who has locked the loop, None where it is not locked. A job that has not begun is refused at its
        turn."""
        try:
            with self.store.reading() as session:
                loop_locks.check(session, loop)
        except Locked as locked:
            return locked.detail
        return None


def _loop_words(safe: Restoration | None) -> str:
    return "the loop had not been touched" if safe is None else f"the loop: {safe.text}"
