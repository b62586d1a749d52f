"""The restoration of a loop that a job has left unconfirmed: it closes the session and compares the loop with its state
before the job."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from loopwright.service.inputs.config import LoopConfig
from loopwright.service.loops.loop import Loop
from loopwright.service.states.loop_state import LoopState, after_false_pv, loop_state
from loopwright.service.store.jobs import Job
from loopwright.tuning.reasons import Ended, Reason

log = logging.getLogger(__name__)

_REASONS = {
    "session": Reason.LOOP_IN_USE,
    "mode": Reason.MODE_CHANGED,
    "set-point": Reason.SETPOINT_CHANGED,
    "output": Reason.OUTPUT_CHANGED,
    "gains": Reason.GAINS_CHANGED,
    "trial": Reason.GAINS_CHANGED,
}


@dataclass(frozen=True)
class Restoration:
    """The result of a restoration.

    state: the loop as read at the end; None when it could not be read, or is not confirmed to be as before the job.
    text: what was done and found, in words.
    reason: why a job on this loop should not go on; None where it may.
    held: whether the job had found PV to be false, and the controller has held the loop for it.
    """

    state: LoopState | None
    text: str
    reason: Reason | None = None
    held: bool = False


def restore_abandoned(loop: Loop, home: LoopState, session: int | None) -> Restoration:
    """Closes the session of the job if it is still open, and reads the loop back. Raises no error of the loop.

    session: its number; None where none was opened, so the job has not touched the loop.
    Later changes by an operator or another master are reported and stay.
    """
    try:
        restored = loop.restore(home, session or 0)
    except Ended as ended:
        return Restoration(None, f"not confirmed: {ended.detail}; the controller restores it by itself", ended.reason)
    if restored.held:
        text = f"{restored.how}; {after_false_pv(restored.state)}"
        if restored.changed:
            text += f"; changed meanwhile, and left so: {'; '.join(restored.changed.values())}"
        return Restoration(restored.state, text, Reason.BAD_SAMPLE, held=True)
    if not restored.changed:
        return Restoration(restored.state, f"{restored.how}: mode, set-point and gains as before the job, read back")
    reason = next((reason for name, reason in _REASONS.items() if name in restored.changed), Reason.SERVICE_STOPPED)
    text = f"{restored.how}; not as before the job, left so: {'; '.join(restored.changed.values())}"
    return Restoration(restored.state, text, reason)


def restore_loop_of(row: Job, loops: Mapping[str, LoopConfig], open_loop: Callable[[LoopConfig], Loop]) -> Restoration:
    """Opens the loop of a job and restores it. Raises nothing: one loop must not keep others from being restored."""
    config = loops.get(row.loop)
    if config is None:
        return Restoration(None, "the loop is no longer configured here", Reason.SERVICE_STOPPED)
    try:
        loop = open_loop(config)
        try:
            return restore_abandoned(loop, loop_state(row.found or {}), row.session)
        finally:
            loop.close()
    except Exception as error:
        log.exception("loop %s", row.loop)
        return Restoration(None, f"not reached: {error}; the controller restores it by itself", Reason.BUS_LOST)
