"""The two sides of a heartbeat: when this node's is due (1017h), and which nodes' heartbeats are expected (1016h)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from loopwright.protocol.profile import Abort
from loopwright.protocol.sdo import SdoAbort


class Producer:
    """Decides when a heartbeat is due. Due times follow the period, not the moment of sending, so the mean rate is
    right."""

    def __init__(self) -> None:
        self._next: float | None = None

    def restart(self) -> None:
        """Makes the next heartbeat due at once."""
        self._next = None

    def is_due(self, now: float, period_s: float) -> bool:
        """Returns whether a heartbeat is due; the caller then sends it. A period of 0 s means none; missed ones are not
        sent later."""
        if not period_s or (self._next is not None and now < self._next):
            return False
        following = (now if self._next is None else self._next) + period_s
        self._next = following if following > now else now + period_s
        return True


@dataclass(slots=True)
class HeartbeatWatch:
    """The supervision of one node's heartbeat: its node-ID, and the longest permitted silence in s."""

    node: int
    limit_s: float
    heard: float | None = None
    """Wall time of the last heartbeat, s; None before the first one (supervision starts with it) and after a loss."""
    lost: bool = False


class Consumer:
    """The supervised nodes, by entry of 1016h."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._watches: dict[int, HeartbeatWatch] = {}

    def __iter__(self) -> Iterator[HeartbeatWatch]:
        return iter(self._watches.values())

    def clear(self) -> None:
        self._watches.clear()

    def watch(self, sub: int, value: int) -> None:
        """Sets an entry: node-ID in bits 16-22, milliseconds below. A new value waits for a first heartbeat again.

        A node is supervised by one entry only: a second entry would never get its heartbeats.
        """
        node, limit_ms = value >> 16 & 0xFF, value & 0xFFFF
        if value >> 24 or node > 127:
            raise SdoAbort(Abort.INVALID_VALUE)
        if not (node and limit_ms):
            self._watches.pop(sub, None)
            return
        if any(other != sub and watch.node == node for other, watch in self._watches.items()):
            raise SdoAbort(Abort.INCOMPATIBLE)
        self._watches[sub] = HeartbeatWatch(node, limit_ms / 1000.0)

    def heard(self, watch: HeartbeatWatch) -> bool:
        """Notes a heartbeat; returns True when the node had been lost."""
        watch.heard = self._clock()
        was_lost, watch.lost = watch.lost, False
        return was_lost

    def overdue(self, now: float) -> list[HeartbeatWatch]:
        """Returns the nodes that have fallen silent since the last call. Their next heartbeat starts the supervision
        again."""
        silent = [each for each in self if each.heard is not None and now - each.heard > each.limit_s]
        for watch in silent:
            watch.heard = None
        return silent
