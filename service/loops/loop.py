"""The interface of a loop. It is implemented by `BusLoop` (live, over CANopen) and `RehearsedLoop` (in memory)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Command, Sample
from loopwright.tuning.reasons import Reason


@dataclass(frozen=True, slots=True)
class Restored:
    """A loop after a test, as read back.

    how: the end of the test, in words.
    changed: what an operator or another master has changed since the test began: by name, in words.
    held: whether the test had found PV to be false: a loop that was in automatic is in manual at the MV before the
    test, except for what is in `changed`.
    """

    state: LoopState
    how: str
    changed: Mapping[str, str] = field(default_factory=dict)
    held: bool = False


class Loop(Protocol):
    """A loop for one thread: its waits send heartbeat and lease renewals, so a service that hangs loses the loop."""

    @property
    def waits(self) -> bool:
        """Returns whether the plant stands still between two steps, as a simulated one at full speed does."""
        ...

    def read(self, beside_tests: bool = False) -> LoopState:
        """Returns the present state, read from the controller. Raises Failed(NODE_LOST | BUS_LOST |
        NODE_NOT_OPERATIONAL).

        beside_tests: while another tuner's session is open, return the state to which it returns, not that of its test.
        """
        ...

    def begin(
        self,
        stop: Callable[[], Reason | None] = lambda: None,
        note_session: Callable[[int], None] = lambda session: None,
    ) -> LoopState:
        """Opens a session: from now on the controller restores the loop by itself when this service falls silent.

        stop: asked during every wait, here and in `step`; a reason that it returns ends the wait as Aborted.
        note_session: stores the number of the session before it is opened; called with 0 where the opening was refused.
        Returns the state before the test, as the controller has noted it.
        """
        ...

    def step(self, commands: Sequence[Command]) -> Sample:
        """Carries out the commands, then returns the next sample. Raises Failed when node, bus or samples are lost, and
        Aborted when an operator or another master commands the loop."""
        ...

    def hold(self) -> None:
        """Moves the loop to the MV before the test at once, and a loop that was in automatic to manual, where it stays
        after the session, whatever ends it: PV is false. Takes no command afterwards; `restore` follows.

        Raises the reason where the controller does not answer, or the session is over: the loop then is as before the
        test, but for what an operator or another master has commanded.
        """
        ...

    def restore(self, home: LoopState, session: int | None = None) -> Restored:
        """Closes the session (of this process, or of an earlier one) and reads the loop back.

        Raises Failed(RESTORE_UNCONFIRMED | NODE_NOT_OPERATIONAL) where the loop differs from its state before the test,
        and no operator or other master has changed it.
        """
        ...

    def accept(self, gains: Gains, instead_of: Gains) -> LoopState:
        """Makes these gains the accepted set without a bump, and reads them back.

        Raises Refused(GAINS_CHANGED) where neither these gains nor `instead_of` are the accepted ones.
        """
        ...

    def close(self) -> None: ...
