"""How much one client, and all of them together, may ask for."""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class RequestLimits:
    """A client is a key, or an address without one.

    rate_per_s, burst: requests of one client; decisions (abort, accept, roll back, dismiss) are counted apart.
    at_once, streams_at_once, computations_at_once: requests of that kind that wait or are answered, of all clients; one
    client may have half of them (`service.api.gate.places` has the kinds without an option here).
    body_bytes: of one request.  bodies_bytes: of all that have begun to arrive; one client may have half.
    body_s: within which a body must be here.  wait_s: how long a request waits for its turn before it is refused.
    bad_keys_per_s, bad_keys_burst: unknown keys from one address, and guesses at one key.
    connections, connections_of_address: open at the same time; one that waits for a request gives way to a new one.
    headers_s: within which the head of a request must be here, from the opening or from the last answer on.
    write_s: how long a client may take nothing of an answer.
    """

    body_bytes: int = 1 << 20
    bodies_bytes: int = 32 << 20
    rate_per_s: float = 500.0
    burst: int = 1000
    at_once: int = 64
    streams_at_once: int = 200
    computations_at_once: int = 2
    wait_s: float = 5.0
    body_s: float = 10.0
    bad_keys_per_s: float = 0.5
    bad_keys_burst: int = 10
    connections: int = 512
    connections_of_address: int = 256
    headers_s: float = 10.0
    write_s: float = 30.0


class Buckets:
    """A token bucket for each caller. Not for use by two threads."""

    def __init__(
        self, rate_per_s: float, burst: int, wall: Callable[[], float] = time.monotonic, maximum: int = 10_000
    ) -> None:
        self._rate, self._burst, self._wall, self._max = rate_per_s, burst, wall, maximum
        self._levels: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def wait_s(self, caller: str) -> float:
        """Seconds until this caller's next token; 0: there is one."""
        return max(0.0, (1.0 - self._level(caller)) / self._rate)

    def take(self, caller: str) -> float:
        """Takes a token and returns 0, or returns the seconds to wait for one."""
        wait = self.wait_s(caller)
        if wait == 0.0:
            self._put(caller, self._level(caller) - 1.0)
        return wait

    def give_back(self, caller: str) -> None:
        """What the token was taken for was no reason to take one."""
        self._put(caller, self._level(caller) + 1.0)

    def full(self, caller: str) -> bool:
        """Whether this caller has taken nothing for a while."""
        return self._level(caller) >= self._burst

    def _put(self, caller: str, level: float) -> None:
        self._levels[caller] = (level, self._wall())
        self._levels.move_to_end(caller)
        if len(self._levels) > self._max:  # who was not seen for longest has a full bucket, most likely
            self._levels.popitem(last=False)

    def _level(self, caller: str) -> float:
        level, at = self._levels.get(caller, (float(self._burst), self._wall()))
        return min(float(self._burst), level + (self._wall() - at) * self._rate)


def retry_after(wait_s: float) -> str:
    """Whole seconds, at least one, as the header wants it."""
    return str(max(1, math.ceil(wait_s)))
