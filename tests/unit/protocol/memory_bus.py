"""A bus in memory: every opening hears the frames of the others at once, in order. Time is a number the test moves."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection

from loopwright.protocol.bus import Frame


class Clock:
    """Wall time that passes only when told to."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class Wire:
    def __init__(self) -> None:
        self.clock = Clock()
        self.frames: list[Frame] = []
        self.buses: list[MemoryBus] = []

    def open(self) -> MemoryBus:
        bus = MemoryBus(self)
        self.join(bus)
        return bus

    def join(self, bus: MemoryBus) -> None:
        self.buses.append(bus)

    def carry(self, sender: MemoryBus, frame: Frame) -> None:
        self.frames.append(frame)
        for bus in self.buses:
            if bus is not sender:
                bus.take(frame)

    def sent(self, can_id: int) -> list[bytes]:
        return [data for frame_id, data in self.frames if frame_id == can_id]


class MemoryBus:
    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        self.queue: deque[Frame] = deque()
        self._wanted: frozenset[int] | None = None

    def take(self, frame: Frame) -> None:
        if self._wanted is None or frame[0] in self._wanted:
            self.queue.append(frame)

    def send(self, can_id: int, data: bytes) -> None:
        self._wire.carry(self, (can_id, bytes(data)))

    def recv(self, timeout: float | None) -> Frame | None:
        """Waiting costs no wall time here, but moves the clock by the time-out."""
        if self.queue:
            return self.queue.popleft()
        self._wire.clock.now += timeout or 0.0
        return None

    def set_filters(self, ids: Collection[int]) -> None:
        self._wanted = frozenset(ids)

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        self.queue.clear()
