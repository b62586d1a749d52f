"""A loop as a plan sees it. Two fillings: `BusLoop` (live, over CANopen) and `RehearsedLoop` (in memory)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from loopwright.service.loop_state import LoopState
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Command, Sample
from loopwright.tuning.reasons import Reason


@dataclass(frozen=True, slots=True)
class Restored:
    """A loop after a test, as read back. how: what has ended the test, in words.

    changed: in what it is not as it was found, because of another's hand: each by its name, in words.
    """

    state: LoopState
    how: str
    changed: Mapping[str, str] = field(default_factory=dict)


class Loop(Protocol):
    """Pumped by one thread: heartbeat and lease go out while it waits in here, so a hung service loses the loop."""

    @property
    def waits(self) -> bool:
        """The plant stands still between two steps, as a simulated one at full speed does."""
        ...

    def read(self, beside_tests: bool = False) -> LoopState:
        """The present state, read from the controller. Raises Failed(NODE_LOST | BUS_LOST | NODE_NOT_OPERATIONAL).

        beside_tests: while another tuner's session is open, what that comes back to: its test is nobody's choice.
        """
        ...

    def begin(
        self,
        stop: Callable[[], Reason | None] = lambda: None,
        remember: Callable[[int], None] = lambda session: None,
    ) -> LoopState:
        """Opens a session: from here on the controller brings the loop home by itself when we fall silent.

        stop: asked while we wait, here and in `step`; what it returns ends the wait as Aborted.
        remember: writes the number of the session down before it is opened; 0 where it was refused.
        Returns home, as the controller has noted it.
        """
        ...

    def step(self, commands: Sequence[Command]) -> Sample:
        """Carries out the commands, then returns the next sample. Raises Failed when node, bus or samples are lost, and
        Aborted when another's hand is on the loop."""
        ...

    def restore(self, home: LoopState, session: int | None = None) -> Restored:
        """Closes the session (ours, or the one that a process before us has opened) and reads the loop back.

        Raises Failed(RESTORE_UNCONFIRMED | NODE_NOT_OPERATIONAL) where it is not home, and nobody else's hand is why.
        """
        ...

    def accept(self, gains: Gains, instead_of: Gains) -> LoopState:
        """Makes these gains the accepted set, bumplessly, and reads them back.

        Raises Refused(GAINS_CHANGED) where neither these nor `instead_of` are the accepted ones.
        """
        ...

    def close(self) -> None: ...
