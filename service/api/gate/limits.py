"""Limits of the requests of one client and of all clients, and the token buckets that enforce rates."""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class RequestLimits:
    """A client is a key, or an address without a key.

    rate_per_s, burst: requests of one client; decisions (abort, accept, roll back, acknowledge) are counted apart.
    at_once, streams_at_once, computations_at_once: requests of that kind, waiting or being answered, of all clients;
    one client may have half of them (`service.api.gate.concurrency` has the kinds without an option).
    body_bytes: length of one body.  bodies_bytes: all bodies that have begun to arrive; one client may have half.
    body_s: time for a body to arrive.  wait_s: time that a request waits for its turn before it is refused.
    bad_keys_per_s, bad_keys_burst: unknown keys from one address, and guesses at one key.
    connections, connections_of_address: open connections; one that waits for a request gives way to a new one.
    headers_s: time for the head of a request to arrive, since the connection opened or the last answer ended.
    write_s: time that a client may take nothing of an answer.
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
    """A token bucket for each caller. The class is not thread-safe."""

    def __init__(
        self, rate_per_s: float, burst: int, wall: Callable[[], float] = time.monotonic, maximum: int = 10_000
    ) -> None:
        self._rate, self._burst, self._wall, self._max = rate_per_s, burst, wall, maximum
        self._levels: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def wait_s(self, caller: str) -> float:
        """Seconds until the caller's next token; 0 if there is one."""
        return max(0.0, (1.0 - self._level(caller)) / self._rate)

    def take(self, caller: str) -> float:
        """Takes a token and returns 0, or returns the seconds to wait for one."""
        wait = self.wait_s(caller)
        if wait == 0.0:
            self._put(caller, self._level(caller) - 1.0)
        return wait

    def give_back(self, caller: str) -> None:
        """Returns a token that was taken without a reason, as for a key that turned out valid."""
        self._put(caller, self._level(caller) + 1.0)

    def full(self, caller: str) -> bool:
        """Whether all tokens of the caller are there."""
        return self._level(caller) >= self._burst

    def _put(self, caller: str, level: float) -> None:
        self._levels[caller] = (level, self._wall())
        self._levels.move_to_end(caller)
        if len(self._levels) > self._max:  # the caller not seen for longest most likely has a full bucket
            self._levels.popitem(last=False)

    def _level(self, caller: str) -> float:
        level, at = self._levels.get(caller, (float(self._burst), self._wall()))
        return min(float(self._burst), level + (self._wall() - at) * self._rate)


def retry_after(wait_s: float) -> str:
    """The value of the header Retry-After: whole seconds, at least one."""
    return str(max(1, math.ceil(wait_s)))
