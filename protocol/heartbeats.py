"""The two sides of a heartbeat: when ours is due (1017h), and whose we wait for (1016h)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from loopwright.protocol.profile import Abort
from loopwright.protocol.sdo import SdoAbort


class Producer:
    """Due times follow the period and not the moment of sending, so that the mean rate is right."""

    def __init__(self) -> None:
        self._next: float | None = None

    def restart(self) -> None:
        """The next beat is due at once."""
        self._next = None

    def is_due(self, now: float, period_s: float) -> bool:
        """Asked by whoever sends the beat then. A period of 0 is none; beats missed are not made up for."""
        if not period_s or (self._next is not None and now < self._next):
            return False
        following = (now if self._next is None else self._next) + period_s
        self._next = following if following > now else now + period_s
        return True


@dataclass(slots=True)
class HeartbeatWatch:
    node: int
    limit_s: float
    heard: float | None = None
    """Wall time of the last heartbeat; None before the first one (watching starts with it) and after the loss."""
    lost: bool = False


class Consumer:
    """The nodes we watch, by entry of 1016h."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._watches: dict[int, HeartbeatWatch] = {}

    def __iter__(self) -> Iterator[HeartbeatWatch]:
        return iter(self._watches.values())

    def clear(self) -> None:
        self._watches.clear()

    def watch(self, sub: int, value: int) -> None:
        """Node-ID in bits 16-22, milliseconds below; a new value waits for a first heartbeat again.

        A node is watched by one entry only: of two, one would never hear.
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
        """A heartbeat came; True when it had been missed."""
        watch.heard = self._clock()
        was_lost, watch.lost = watch.lost, False
        return was_lost

    def overdue(self, now: float) -> list[HeartbeatWatch]:
        """Those that have fallen silent since the last call. They are watched again from their next beat on."""
        silent = [each for each in self if each.heard is not None and now - each.heard > each.limit_s]
        for watch in silent:
            watch.heard = None
        return silent
