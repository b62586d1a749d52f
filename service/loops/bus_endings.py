"""How a session has ended, as the controller tells it, and whether the loop is home after it."""

from __future__ import annotations

from loopwright.protocol.profile import Cause, Hand
from loopwright.protocol.real32 import same
from loopwright.protocol.tuner import Tuner
from loopwright.service.loop_state import LoopState, differences
from loopwright.service.loops.bus_reading import BusReading
from loopwright.service.loops.loop import Restored
from loopwright.tuning.plan import Mode
from loopwright.tuning.reasons import Aborted, Ended, Failed, Reason

_HANDS = {
    Hand.SETPOINT: (Reason.SETPOINT_CHANGED, "set-point", {"set-point"}),
    Hand.MODE: (Reason.MODE_CHANGED, "mode", {"mode", "output"}),
    Hand.OUTPUT: (Reason.OUTPUT_CHANGED, "output", {"output"}),
    Hand.GAINS: (Reason.GAINS_CHANGED, "gains", {"gains", "trial"}),
    Hand.LIMITS: (Reason.LIMITS_CHANGED, "limits", set[str]()),
}
"""By what a hand has moved: the reason, its name, and in what the loop may differ from home for it."""


def cause_of(tuner: Tuner) -> Cause:
    return Cause(int(tuner.number("controller_cause")))


def words_of(cause: Cause) -> str:
    return f"cause: {cause.name.lower().replace('_', ' ')}"


def hand_of(tuner: Tuner) -> Hand:
    """What another hand has moved since the opening."""
    return Hand(int(tuner.number("controller_hand")))


def why_over(reading: BusReading, number: int, pv_silence_s: float) -> Ended:
    """Why the session of that number has ended without its tuner. Raises Failed(NODE_NOT_OPERATIONAL)."""
    tuner = reading.tuner
    if int(tuner.number("controller_session_last")) != number:
        return Failed(Reason.NODE_LOST, f"controller node {reading.controller:02X}h restarted")
    cause = cause_of(tuner)
    match cause:
        case Cause.HAND:
            hand = hand_of(tuner)
            moved = [entry for bit, entry in _HANDS.items() if bit in hand]
            reason = moved[0][0] if moved else Reason.MODE_CHANGED
            return Aborted(reason, f"another hand on the loop: {', '.join(name for _, name, _ in moved)}")
        case Cause.PV_LIMIT:
            return Failed(Reason.PV_LIMIT, "PV left its limits during the relay; the controller ended the test")
        case Cause.NO_PV:
            reading.check_plant_operational()
            text = f"the controller has had no valid PV for {pv_silence_s:g} s"
            return Failed(Reason.BAD_SAMPLE, f"{text}; it ended the test and holds the MV of before")
        case Cause.NMT:
            node = f"controller node {reading.controller:02X}h"
            return Failed(Reason.NODE_NOT_OPERATIONAL, f"{node} has left the operational state, by another's command")
    return Failed(Reason.DEVICE_WENT_BACK, f"the controller ended the test by itself ({words_of(cause)})")


def read_back(reading: BusReading, home: LoopState, number: int, how: str) -> Restored:
    """The loop after the session of that number (0: none was opened). What differs from home is another's doing, or is
    not confirmed: Failed(RESTORE_UNCONFIRMED | NODE_NOT_OPERATIONAL).

    home: as the tuner knows it.  how: what has ended the session, in words.
    """
    tuner = reading.tuner
    reading.identify_controller()
    state = reading.state()
    if not reading.controls(state):
        raise Failed(Reason.NODE_NOT_OPERATIONAL, f"{state.node_state}: nothing controls, MV stays where it is")
    holder = int(tuner.number("controller_session_holder"))
    ours = bool(number) and int(tuner.number("controller_session_last")) == number and not holder
    if ours:  # the controller noted it in the moment of the opening
        home = reading.home()
    hand = hand_of(tuner)  # last: what has moved by now is in it
    found = differences(state, home)
    if holder:
        found["session"] = f"the tuner with node-ID {holder:02X}h holds the loop"
    theirs = set(found)
    if ours:
        theirs = set().union(*(may_differ for bit, (_, _, may_differ) in _HANDS.items() if bit in hand))
    unconfirmed = [words for name, words in found.items() if name not in theirs]
    if ours and not hand and state.mode is Mode.AUTOMATIC and _ended_without_pv(tuner) and not same(state.mv, home.mv):
        unconfirmed.append(f"MV is {state.mv:.6g} without a valid PV, was {home.mv:.6g}")
    if unconfirmed:
        raise Failed(Reason.RESTORE_UNCONFIRMED, "; ".join(unconfirmed))
    return Restored(state, how, found)


def _ended_without_pv(tuner: Tuner) -> bool:
    """PV was away as the session ended, and is: the output is to be that of home. Where PV goes away later, MV stays
    where the law has brought it."""
    return cause_of(tuner) in (Cause.NO_PV, Cause.NMT) and not tuner.number("controller_pv_valid")
