"""The accepted gains of a controller exchanged for others, if they still are those the decision is about."""

from __future__ import annotations

from collections.abc import Callable

from service.errors import Conflict
from service.loop import Loop, LoopState
from service.safe import same
from tuning.gains import Gains
from tuning.reasons import Failed, Reason


def exchange(loop: Loop, before: Gains, after: Gains, begun: bool, begin: Callable[[], None]) -> LoopState:
    """The loop's state, read back with the new gains. Raises Conflict, and Failed as the loop does.

    begun: a decision on the same gains was cut off. A controller that holds the new ones then has them from it, and
    keeps them; with the new ones still on trial it was cut off before the last step, and they are given again.
    begin: called once, before anything is written; what it raises leaves the loop untouched.
    """
    found = loop.read()
    there = begun and same(found.gains, after)
    if there and not found.on_trial:
        return found
    if not there and not same(found.gains, before):
        raise Conflict(
            f"the controller holds {found.gains}, not the {before} this decision is about: "
            "somebody changed the gains in between; retune instead"
        )
    begin()
    state = loop.accept(after)
    if not same(state.gains, after):
        raise Failed(Reason.RESTORE_UNCONFIRMED, f"wrote {after}, read back {state.gains}")
    return state
