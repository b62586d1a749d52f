"""How much one caller, and all of them together, may ask for."""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class RequestLimits:
    """body_bytes: of one request.  rate_per_s, burst: of one caller (key, or address without one).
    at_once, streams_at_once, computations_at_once: of all callers; a request counts in one of the three.
    bad_keys_per_s, bad_keys_burst: wrong keys from one address."""

    body_bytes: int = 1 << 20
    rate_per_s: float = 500.0
    burst: int = 1000
    at_once: int = 64
    streams_at_once: int = 200
    computations_at_once: int = 2
    bad_keys_per_s: float = 0.5
    bad_keys_burst: int = 10


class Buckets:
    """A token bucket for each caller. Not for use by two threads."""

    def __init__(
        self, rate_per_s: float, burst: int, wall: Callable[[], float] = time.monotonic, most: int = 10_000
    ) -> None:
        self._rate, self._burst, self._wall, self._most = rate_per_s, burst, wall, most
        self._levels: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def wait_s(self, caller: str) -> float:
        """Seconds until this caller's next token; 0: there is one."""
        return max(0.0, (1.0 - self._level(caller)) / self._rate)

    def take(self, caller: str) -> float:
        """Takes a token and returns 0, or returns the seconds to wait for one."""
        wait = self.wait_s(caller)
        if wait == 0.0:
            self._levels[caller] = (self._level(caller) - 1.0, self._wall())
            self._levels.move_to_end(caller)
            if len(self._levels) > self._most:  # who was not seen for longest has a full bucket, most likely
                self._levels.popitem(last=False)
        return wait

    def _level(self, caller: str) -> float:
        level, at = self._levels.get(caller, (float(self._burst), self._wall()))
        return min(float(self._burst), level + (self._wall() - at) * self._rate)


def retry_after(wait_s: float) -> str:
    """Whole seconds, at least one, as the header wants it."""
    return str(max(1, math.ceil(wait_s)))
