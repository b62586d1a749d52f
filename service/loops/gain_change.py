"""Replacing the accepted gains of a controller, provided that they are still those the decision is about."""

from __future__ import annotations

from collections.abc import Callable

from loopwright.service.errors import Conflict
from loopwright.service.loop_state import LoopState, same_gains
from loopwright.service.loops.loop import Loop
from loopwright.tuning.gains import Gains
from loopwright.tuning.reasons import Failed, Reason


class ForeignGains(Conflict):
    """Raised when the controller holds gains other than the decision's.

    found: the state of the loop as read; it was not changed.
    """

    def __init__(self, found: LoopState, before: Gains) -> None:
        super().__init__(
            f"the controller holds {found.gains}, not the {before} this decision is about: "
            "somebody changed the gains in between; retune instead"
        )
        self.found = found


def replace_accepted(loop: Loop, before: Gains, after: Gains, begun: bool, begin: Callable[[], None]) -> LoopState:
    """Replaces the accepted gains and returns the state of the loop, read back with the new ones.

    begun: an earlier attempt may already have written the gains. A controller that holds the new gains then keeps them;
    where they are on trial only, they are written again.
    begin: called once, before anything is written; when it raises, the loop is not changed.
    Raises ForeignGains, and Failed or Refused as the loop does.
    """
    found = loop.read()
    there = begun and same_gains(found.gains, after)
    if there and not found.on_trial:
        return found
    if not there and not same_gains(found.gains, before):
        raise ForeignGains(found, before)
    begin()
    state = loop.accept(after, before)
    if not same_gains(state.gains, after):
        raise Failed(Reason.RESTORE_UNCONFIRMED, f"wrote {after}, read back {state.gains}")
    return state
