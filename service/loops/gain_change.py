"""The accepted gains of a controller exchanged for others, if they still are those the decision is about."""

from __future__ import annotations

from collections.abc import Callable

from loopwright.service.errors import Conflict
from loopwright.service.loop_state import LoopState, same_gains
from loopwright.service.loops.loop import Loop
from loopwright.tuning.gains import Gains
from loopwright.tuning.reasons import Failed, Reason


class ForeignGains(Conflict):
    """The controller holds gains that the decision knows nothing of. found: the loop as read, and left."""

    def __init__(self, found: LoopState, before: Gains) -> None:
        super().__init__(
            f"the controller holds {found.gains}, not the {before} this decision is about: "
            "somebody changed the gains in between; retune instead"
        )
        self.found = found


def replace_accepted(loop: Loop, before: Gains, after: Gains, begun: bool, begin: Callable[[], None]) -> LoopState:
    """The loop's state, read back with the new gains. Raises ForeignGains, and Failed or Refused as the loop does.

    begun: a decision on the same gains was cut off. A controller that holds the new ones then has them from it, and
    keeps them; with others on trial they are given again.
    begin: called once, before anything is written; what it raises leaves the loop untouched.
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
