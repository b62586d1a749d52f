"""A loop as a plan sees it. Two fillings: `BusLoop` (live, over CANopen) and `RehearsedLoop` (in memory)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from tuning.gains import Gains
from tuning.plan import Command, Mode, Sample
from tuning.reasons import Reason


@dataclass(frozen=True, slots=True)
class LoopState:
    """What a loop is and must come back to. MV and PV in the loop's units, limits as the controller holds them.

    gains: of a live loop the accepted ones, those that a trial ends with.
    command_lag_samples: how many samples a command may take to show before another's hand is suspected.
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
    command_lag_samples: int = 50


class Loop(Protocol):
    """Pumped by one thread: the heartbeat and the lease go out from `step`, so a hung service loses the loop."""

    @property
    def waits(self) -> bool:
        """The plant stands still between two steps, as a simulated one at full speed does."""
        ...

    def read(self) -> LoopState:
        """The present state, read from the controller. Raises Failed(NODE_LOST | BUS_LOST)."""
        ...

    def begin(self, stop: Callable[[], Reason | None] = lambda: None) -> LoopState:
        """Takes the lease: from here on the controller comes back by itself when we fall silent.

        stop: asked while another test holds the plant; what it returns ends the wait as Aborted.
        """
        ...

    def step(self, commands: Sequence[Command]) -> Sample:
        """Carries out the commands, then returns the next sample. Raises Failed when node, bus or samples are lost."""
        ...

    def restore(self, state: LoopState) -> LoopState:
        """Ends the trial, brings back mode, set-point and gains of `state`, ends the lease, reads back."""
        ...

    def accept(self, gains: Gains) -> LoopState:
        """Makes these gains the accepted set, bumplessly, and reads them back."""
        ...

    def close(self) -> None: ...
