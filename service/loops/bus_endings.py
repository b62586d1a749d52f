"""The end of a session, as the controller reports it, and whether the loop is in its state before the test."""

from __future__ import annotations

from loopwright.protocol.profile import Cause, OutsideChange, RelayState, node_name
from loopwright.protocol.real32 import same
from loopwright.protocol.tuner import Tuner
from loopwright.service.loops.bus_reading import BusReading
from loopwright.service.loops.loop import Restored
from loopwright.service.states.loop_state import LoopState, differences
from loopwright.tuning.plan import Mode
from loopwright.tuning.reasons import Aborted, Ended, Failed, Reason

_OUTSIDE_CHANGES = {
    OutsideChange.SETPOINT: (Reason.SETPOINT_CHANGED, "set-point", {"set-point"}),
    OutsideChange.MODE: (Reason.MODE_CHANGED, "mode", {"mode", "output"}),
    OutsideChange.OUTPUT: (Reason.OUTPUT_CHANGED, "output", {"output"}),
    OutsideChange.GAINS: (Reason.GAINS_CHANGED, "gains", {"gains", "trial"}),
    OutsideChange.LIMITS: (Reason.LIMITS_CHANGED, "limits", set[str]()),
}
"""For each kind of change by an operator or another master: the reason, its name, and in what the loop may differ from
its state before the test because of it."""


def cause_of(tuner: Tuner) -> Cause:
    """Returns why the last session ended, as the controller says."""
    return Cause(int(tuner.number("controller_cause")))


def words_of(cause: Cause) -> str:
    """Returns the cause in words."""
    return f"cause: {cause.name.lower().replace('_', ' ')}"


def outside_changes_of(tuner: Tuner) -> OutsideChange:
    """Returns what an operator or another master has changed since the opening."""
    return OutsideChange(int(tuner.number("controller_outside_changes")))


def why_over(reading: BusReading, number: int, pv_silence_s: float) -> Ended:
    """Returns why the session of that number has ended without its tuner. Raises Failed(NODE_NOT_OPERATIONAL)."""
    tuner = reading.tuner
    if int(tuner.number("controller_session_last")) != number:
        return Failed(Reason.NODE_LOST, f"controller node {node_name(reading.controller)} restarted")
    cause = cause_of(tuner)
    match cause:
        case Cause.OUTSIDE_CHANGE:
            changes = outside_changes_of(tuner)
            moved = [entry for bit, entry in _OUTSIDE_CHANGES.items() if bit in changes]
            reason = moved[0][0] if moved else Reason.MODE_CHANGED
            return Aborted(reason, f"an operator or another master changed: {', '.join(name for _, name, _ in moved)}")
        case Cause.PV_LIMIT:
            return Failed(Reason.PV_LIMIT, f"{_pv_left(tuner)}; the controller ended the test")
        case Cause.NO_PV:
            reading.check_plant_operational()
            text = f"the controller has had no valid PV for {pv_silence_s:g} s"
            return Failed(Reason.BAD_SAMPLE, f"{text}; it ended the test and holds the MV of before")
        case Cause.NMT:
            node = f"controller node {node_name(reading.controller)}"
            return Failed(Reason.NODE_NOT_OPERATIONAL, f"{node} has left the operational state, by an NMT command")
    text = f"the controller ended the test by itself ({words_of(cause)})"
    if cause is Cause.LEASE:
        text += f"; at most {tuner.longest_between_renewals_s:.1f} s passed between two renewals of the lease"
    return Failed(Reason.SESSION_ENDED_BY_DEVICE, text)


def _pv_left(tuner: Tuner) -> str:
    """Returns which limits PV has left, with PV as it is read, which is a little later."""
    by_relay = int(tuner.number("controller_relay_state")) == RelayState.ENDED_BY_LIMIT
    low, high = (tuner.number(f"controller_{'relay' if by_relay else 'session'}_pv_{end}") for end in ("low", "high"))
    return f"PV left {low:.5g} .. {high:.5g} and is {tuner.number('controller_received_pv'):.5g} now"


def read_back(reading: BusReading, home: LoopState, number: int, how: str) -> Restored:
    """Reads the loop back after the session of that number (0: none was opened). Differences from `home` are either
    changes by an operator or another master, which are reported, or not confirmed.

    home: the state before the test, as the tuner knows it.
    how: the end of the session, in words.
    Raises Failed(RESTORE_UNCONFIRMED | NODE_NOT_OPERATIONAL).
    """
    tuner = reading.tuner
    reading.identify_controller()
    state = reading.state()
    if not reading.controls(state):
        raise Failed(Reason.NODE_NOT_OPERATIONAL, f"{state.node_state}: nothing controls, MV stays where it is")
    holder = int(tuner.number("controller_session_holder"))
    is_own = bool(number) and int(tuner.number("controller_session_last")) == number and not holder
    if is_own:  # the controller noted the state at the moment of the opening, and what HOLD has put in its place
        home = reading.home()
    changes = outside_changes_of(tuner)  # read last, so that it includes every change so far
    differing = differences(state, home)
    if holder:
        differing["session"] = f"the tuner with node-ID {node_name(holder)} holds the loop"
    explained = set(differing)
    if is_own:
        explained = set().union(*(may_differ for bit, (_, _, may_differ) in _OUTSIDE_CHANGES.items() if bit in changes))
    unconfirmed = [words for name, words in differing.items() if name not in explained]
    if (
        is_own
        and not changes
        and state.mode is Mode.AUTOMATIC
        and _ended_without_pv(tuner)
        and not same(state.mv, home.mv)
    ):
        unconfirmed.append(f"MV is {state.mv:.6g} without a valid PV, was {home.mv:.6g}")
    if unconfirmed:
        raise Failed(Reason.RESTORE_UNCONFIRMED, "; ".join(unconfirmed))
    return Restored(state, how, differing, held=is_own and cause_of(tuner) is Cause.HELD)


def _ended_without_pv(tuner: Tuner) -> bool:
    """Returns whether PV was away when the session ended, and still is: MV then has to be that of `home`. Where PV goes
    away later, MV stays where the control law has brought it."""
    return cause_of(tuner) in (Cause.NO_PV, Cause.NMT) and not tuner.number("controller_pv_valid")
