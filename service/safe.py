"""A loop that a dead service left: brought back where its controller has not done so itself, and compared with how
the job had found it."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

from service.loop import Loop, LoopState
from tuning.gains import Gains
from tuning.plan import Mode
from tuning.reasons import Ended, Reason

PATIENCE_S = 4.5
"""Wall time in which a controller has ended a session by itself: its heartbeat time (1 s), or its lease (3 s)."""

_AS_BEFORE = "mode, set-point and gains as before the job, read back"


@dataclass(frozen=True)
class Safe:
    """The loop as read at the end, and what was done and found about it, in words.

    state: None when it could not be read.  reason: why a job on it should not go on, if so.
    """

    state: LoopState | None
    text: str
    reason: Reason | None = None


def make_safe(loop: Loop, home: LoopState, patience_s: float = PATIENCE_S) -> Safe:
    """Brings the loop back to `home` unless somebody else has had a hand on it since. Raises nothing of the loop's.

    A controller goes back by itself when its tuner dies; until then the loop is given time, and what it still shows
    of a test (gains on trial, a relay) is ended. A set-point, mode or gains that differ after that are somebody's
    decision, and stay.
    """
    try:
        state = loop.read()
        on_test = state.on_trial or state.mode is Mode.EXPERIMENT
        give_up = time.monotonic() + patience_s
        while not on_test and differences(state, home) and time.monotonic() < give_up:
            time.sleep(0.1)
            state = loop.read()
            on_test = state.on_trial or state.mode is Mode.EXPERIMENT
        if on_test:
            state = loop.restore(home)
            return Safe(state, f"found on test and brought back: {_AS_BEFORE}")
    except Ended as ended:
        return Safe(None, f"not reached: {ended.detail}; the controller goes back by itself", ended.reason)
    changed = differences(state, home)
    if not changed:
        return Safe(state, f"the controller has gone back by itself: {_AS_BEFORE}")
    reason = Reason.SERVICE_STOPPED
    if "mode" in changed:
        reason = Reason.MODE_CHANGED
    elif "set-point" in changed:
        reason = Reason.SETPOINT_CHANGED
    text = "; ".join(changed.values())
    return Safe(state, f"changed by somebody else since the job began, and left so: {text}", reason)


def differences(state: LoopState, home: LoopState) -> dict[str, str]:
    """In what the loop is not as it was, each in words."""
    same_sp = math.isclose(state.sp, home.sp, rel_tol=1e-6, abs_tol=1e-12)
    pairs = (
        ("mode", state.mode.name.lower(), home.mode.name.lower(), state.mode is home.mode),
        ("set-point", f"{state.sp:.6g}", f"{home.sp:.6g}", same_sp),
        ("gains", state.gains, home.gains, same(state.gains, home.gains)),
    )
    return {name: f"{name} is {is_}, was {was}" for name, is_, was, equal in pairs if not equal}


def same(one: Gains, other: Gains) -> bool:
    """Equal as far as the bus can tell: gains travel as float32 (24 bits, 6e-8)."""
    return all(
        math.isclose(getattr(one, name), getattr(other, name), rel_tol=1e-6, abs_tol=1e-9)
        for name in Gains.__dataclass_fields__
    )
