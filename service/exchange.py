"""The accepted gains of a controller exchanged for others, if they still are those the decision is about."""

from __future__ import annotations

from service.errors import Conflict
from service.loop import Loop, LoopState
from service.safe import same
from tuning.gains import Gains
from tuning.reasons import Failed, Reason


def exchange(loop: Loop, before: Gains, after: Gains) -> LoopState:
    """The loop's state, read back with the new gains. Raises Conflict, and Failed as the loop does."""
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
