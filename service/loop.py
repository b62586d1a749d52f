"""A loop as a plan sees it. Two fillings: `BusLoop` (live, over CANopen) and `RehearsedLoop` (in memory)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Command, Mode, Sample
from loopwright.tuning.reasons import Reason

OPERATIONAL = "operational"


@dataclass(frozen=True, slots=True)
class LoopState:
    """What a loop is and must come back to. MV and PV in the loop's units, limits as the controller holds them.

    gains: of a live loop the accepted ones, those that a trial ends with.
    node_state: operational, or the state in which a node of the loop controls nothing.
    when_silent: what the plant's I/O does when the controller falls silent ("holds MV where it is"); empty: not known.
    """

    mode: Mode
    sp: float
    pv: float
    mv: float
    gains: Gains
    on_trial: bool
    mv_low: float
    mv_high: float
    sample_time_s: float
    reverse_acting: bool
    manual_output: float = 0.0
    node_state: str = OPERATIONAL
    when_silent: str = ""


@dataclass(frozen=True, slots=True)
class Restored:
    """A loop after a test, as read back. how: what has ended the test, in words.

    changed: in what it is not as it was found, because of another's hand: each by its name, in words.
    """

    state: LoopState
    how: str
    changed: Mapping[str, str] = field(default_factory=dict)


def differences(state: LoopState, home: LoopState) -> dict[str, str]:
    """In what the loop is not as it was, each in words."""
    pairs = (
        ("mode", state.mode.name.lower(), home.mode.name.lower(), state.mode is home.mode),
        ("set-point", f"{state.sp:.6g}", f"{home.sp:.6g}", same(state.sp, home.sp)),
        ("gains", state.gains, home.gains, same_gains(state.gains, home.gains)),
        ("trial", state.on_trial, home.on_trial, state.on_trial == home.on_trial),
    )
    found = {name: f"{name} is {is_}, was {was}" for name, is_, was, equal in pairs if not equal}
    if home.mode is Mode.MANUAL and not same(state.manual_output, home.manual_output):
        found["output"] = f"manual output is {state.manual_output:.6g}, was {home.manual_output:.6g}"
    return found


def same(a: float, b: float) -> bool:
    """Equal as far as the bus can tell: values travel as REAL32 (24 bits, 6e-8)."""
    return math.isclose(a, b, rel_tol=1e-6, abs_tol=1e-9)


def same_gains(one: Gains, other: Gains) -> bool:
    return all(same(getattr(one, name), getattr(other, name)) for name in Gains.__dataclass_fields__)


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
