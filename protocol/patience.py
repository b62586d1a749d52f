"""How long a client waits for a frame, and for how long it then looks at what has come already."""

from __future__ import annotations

import math

WAIT_S = 0.05
"""Longest single wait of a loop on the bus, s. A heartbeat that becomes due within the next wait is sent before it."""


class Patience:
    """The waits for one frame, in wall time. Who has stood still itself still gets what has come meanwhile.

    give_up: time after which only what is here already is received.
    take_in_s: for how long it is, s: where a node sends without a pause, or the bus is overloaded, there is always
        another frame.
    """

    def __init__(self, give_up: float, take_in_s: float) -> None:
        self._give_up = give_up
        self._take_in_s = take_in_s
        self._last = math.inf

    def wait(self, now: float) -> float | None:
        """Returns how long to wait for the next frame, s; None when it is over."""
        if now < self._give_up:
            return WAIT_S
        self._last = min(self._last, now + self._take_in_s)
        return 0.0 if now < self._last else None
