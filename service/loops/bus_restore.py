"""The end of a test or an acceptance: it closes the session and reads the loop back. Where PV is false, it has the
controller hold the loop first."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import TypeVar

from loopwright.protocol.profile import Cause, Order
from loopwright.protocol.tuner import Tuner, TunerError
from loopwright.protocol.tuner_session import TunerSession
from loopwright.service.loops.bus_connection import AGAIN_S, BusConnection
from loopwright.service.loops.bus_endings import cause_of, read_back, words_of
from loopwright.service.loops.loop import Restored
from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.reasons import Ended, Failed, Reason

T = TypeVar("T")

RESTORE_PATIENCE_S = 4.0
"""Wall time for which the restoration is retried, and for which a node may leave one of its requests unanswered, s."""
LOSSY_BUS_S = 15.0
"""Wall time that the restoration may take on a bus that loses frames but answers now and then, s."""


def restore(connection: BusConnection, home: LoopState, number: int) -> Restored:
    """Closes the session of that number, if it is still open, and reads the loop back.

    number: 0 where no session was opened.
    Raises Failed(RESTORE_UNCONFIRMED | NODE_NOT_OPERATIONAL).
    """

    def close_and_read(tuner: Tuner) -> Restored:
        how = close_session(tuner, number) if number else "no session was opened"
        return read_back(connection.reading(tuner), home, number, how)

    try:
        return _patiently(connection, close_and_read)
    except Ended as ended:
        if ended.reason is Reason.NODE_NOT_OPERATIONAL:
            raise
        raise Failed(Reason.RESTORE_UNCONFIRMED, ended.detail) from ended


def hold(connection: BusConnection, number: int) -> bool:
    """Orders the controller to go to manual at the MV before the test, and to stay there after the session of that
    number. Returns False where the session was over before the order came. Raises Ended."""

    def order(tuner: Tuner) -> bool:
        if tuner.session:
            tuner.set_renewed_session(number)  # without a question whether to stop: an abort does not come between
        if int(tuner.number("controller_session")) != number:
            return _was_held(tuner, number)
        session = TunerSession(tuner)
        session.take_up(number)
        try:
            session.give(Order.HOLD)
        except TunerError:
            if session.is_open:
                raise
            return _was_held(tuner, number)
        return True

    return _patiently(connection, order)


def _was_held(tuner: Tuner, number: int) -> bool:
    """Returns whether the session of that number, which is over, was held: the answer to the order may have been lost
    with it."""
    return int(tuner.number("controller_session_last")) == number and cause_of(tuner) is Cause.HELD


def end_acceptance(connection: BusConnection, number: int, why: Ended | None) -> LoopState:
    """Closes the session of an acceptance and reads the accepted gains.

    why: the error that has interrupted the acceptance, if any. Where the end of the session is not confirmed, it is
    raised with an addition that says so.
    """

    def close_and_read(tuner: Tuner) -> LoopState:
        close_session(tuner, number)
        return connection.reading(tuner).state()

    try:
        return _patiently(connection, close_and_read)
    except Ended as ended:
        why = why or ended
        text = "the end of the session is not confirmed, the controller ends it by itself within seconds"
        raise type(why)(why.reason, f"{why.detail}; {text}: read the loop before going on") from ended


def _patiently(connection: BusConnection, ask: Callable[[Tuner], T]) -> T:
    """Returns what the controller answers; asks it for RESTORE_PATIENCE_S. Raises the last Ended."""
    station = connection.station
    give_up = station.monotonic() + RESTORE_PATIENCE_S
    while True:
        try:
            with connection.tuner() as tuner, tuner.retrying(RESTORE_PATIENCE_S, LOSSY_BUS_S):
                return ask(tuner)
        except Ended:
            if station.monotonic() > give_up:
                raise
            station.sleep(AGAIN_S)


def close_session(tuner: Tuner, number: int) -> str:
    """Closes the session of that number where it is still open, and returns in words how it has ended."""
    tuner.set_renewed_session(0)
    if int(tuner.number("controller_session")) == number:
        session = TunerSession(tuner)
        session.take_up(number)
        with suppress(TunerError):  # the session may just have ended; the next reading decides
            session.close()
        if int(tuner.number("controller_session")) == number:
            raise Failed(Reason.RESTORE_UNCONFIRMED, f"session {number:08X}h could not be closed")
        return "the session was closed"
    if int(tuner.number("controller_session_last")) == number:
        return f"the controller had ended the session ({words_of(cause_of(tuner))})"
    return "the controller knows nothing of the session: it has been restarted, or others have been on it since"
