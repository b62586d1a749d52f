"""From the heartbeats of one node to whether it is there, and in which state. Pure: times are handed in."""

from __future__ import annotations

import math
from dataclasses import dataclass

from loopwright.protocol.profile import HEARTBEAT_FRAME, NmtState

SILENCE_S = 2.0
"""Time without a heartbeat, and at least three of its periods, after which a node counts as lost, s."""
_SHORTEST_PERIOD_S, _LONGEST_PERIOD_S = 0.05, 66.0
"""A pause between two heartbeats that is shorter is a frame that came twice; 1017h holds milliseconds in 16 bits."""


@dataclass(frozen=True)
class HeardHeartbeat:
    """What was heard last of a node.

    at_s: time of its last heartbeat, s.
    silent: whether further ones are due and do not come.
    state: its NMT state; None where the heartbeat carries none that is known.
    """

    at_s: float
    silent: bool
    state: NmtState | None


class HeardNode:
    """Takes the heartbeats of one node."""

    def __init__(self) -> None:
        self._at_s: float | None = None
        self._period_s = 0.0
        self._state: NmtState | None = None

    def take(self, data: bytes, at_s: float) -> None:
        """Takes a heartbeat. Raises struct.error for a foreign frame."""
        (value,) = HEARTBEAT_FRAME.unpack(data)
        value &= 0x7F  # bit 7 toggles where the node is guarded instead
        state = NmtState(value) if value in set(NmtState) else None
        if self._at_s is not None and NmtState.BOOT_UP not in (state, self._state):
            self._learn(at_s - self._at_s)
        self._at_s, self._state = at_s, state

    def _learn(self, pause_s: float) -> None:
        """Takes a pause between two heartbeats: a single long one, in which the node was away, is no period."""
        if not _SHORTEST_PERIOD_S <= pause_s <= _LONGEST_PERIOD_S:
            return
        if not self._period_s:
            self._period_s = pause_s
        elif pause_s > self._period_s:
            self._period_s = min(pause_s, 2.0 * self._period_s)
        else:
            self._period_s = max(pause_s, 0.9 * self._period_s)

    def began_anew(self) -> None:
        """Forgets the time: the clock was put back."""
        self._at_s = None

    def latest(self, now_s: float) -> HeardHeartbeat | None:
        """Returns what was heard last; None before the first heartbeat."""
        if self._at_s is None:
            return None
        # After a single heartbeat the period is not known.
        due_s = max(SILENCE_S, 3.0 * self._period_s) if self._period_s else math.inf
        return HeardHeartbeat(self._at_s, now_s - self._at_s > due_s, self._state)
