"""Replacing the accepted gains of a controller, provided that they are still those the decision is about."""

from __future__ import annotations

from collections.abc import Callable

from loopwright.service.errors import Conflict
from loopwright.service.loops.loop import Loop
from loopwright.service.states.loop_state import LoopState, same_gains
from loopwright.tuning.gains import Gains
from loopwright.tuning.reasons import Failed, Reason


class ForeignGains(Conflict):
    """Raised when the controller holds gains other than the decision's.

    state: the state of the loop as read; it was not changed.
    """

    def __init__(self, state: LoopState, before: Gains) -> None:
        super().__init__(
            f"the controller holds {state.gains}, not the {before} this decision is about: "
            "the gains were changed in between; retune instead"
        )
        self.state = state


def replace_accepted(
    loop: Loop,
    before: Gains,
    after: Gains,
    begun: bool,
    begin: Callable[[], None],
    objection: Callable[[LoopState], str | None] = lambda state: None,
) -> LoopState:
    """Replaces the accepted gains and returns the state of the loop, read back with the new ones.

    begun: an earlier attempt may already have written the gains. A controller that holds the new gains then keeps them;
    where they are on trial only, they are written again.
    begin: called once, before anything is written; when it raises, the loop is not changed.
    objection: what speaks against it in the state as read, in words.
    Raises Conflict for an objection, ForeignGains, and Failed or Refused as the loop does.
    """
    state = loop.read()
    if (why := objection(state)) is not None:
        raise Conflict(why)
    there = begun and same_gains(state.gains, after)
    if there and not state.on_trial:
        return state
    if not there and not same_gains(state.gains, before):
        raise ForeignGains(state, before)
    begin()
    state = loop.accept(after, before)
    if not same_gains(state.gains, after):
        raise Failed(Reason.RESTORE_UNCONFIRMED, f"wrote {after}, read back {state.gains}")
    return state
