"""This process as a node of the buses: its node-ID, its clock, its heartbeat, and whose turn it is with an SDO server.

What a process shares between its loops lives here and not in modules, so that several gateways can be simulated in one
process, with a clock that the simulation moves.
"""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

from loopwright.protocol.bus import Bus, open_bus
from loopwright.protocol.fair_lock import FairLock
from loopwright.protocol.profile import HEARTBEAT_FRAME, TUNER_NODE, NmtState, heartbeat_id

HEARTBEAT_S = 0.1
LISTEN_S = 2.0
"""How long a node listens for another one with its ID before it beats."""
_LISTEN_STEP_S = 0.05


class NodeTaken(Exception):
    """Another node of the bus beats with our node-ID."""


@dataclass
class Station:
    """node: our node-ID, on every bus.  listen_s: LISTEN_S; 0 where no other node can be.

    monotonic, sleep, open_bus: the machine's, or a simulated one's.
    """

    node: int = TUNER_NODE
    listen_s: float = LISTEN_S
    monotonic: Callable[[], float] = time.monotonic
    sleep: Callable[[float], None] = time.sleep
    open_bus: Callable[[str], Bus] = open_bus
    sdo_retries: Counter[str] = field(default_factory=Counter)
    """By bus: SDO requests that were sent again because no answer came."""
    _beats: dict[str, float] = field(default_factory=dict)
    """For each bus when we have last sent our heartbeat. One beat speaks for all loops of the process: it says that the
    process lives. That a loop's own thread works, only its lease says."""
    _sdo_locks: dict[tuple[str, int], FairLock] = field(default_factory=dict)
    _plant_locks: dict[tuple[str, int], threading.Lock] = field(default_factory=dict)
    _guard: threading.Lock = field(default_factory=threading.Lock)
    _listening: threading.Lock = field(default_factory=threading.Lock)

    def sdo_lock(self, url: str, node: int) -> FairLock:
        """Returns the lock of an SDO server, which answers one request at a time, whoever asks: loops of one process on
        one node take turns."""
        with self._guard:
            return self._sdo_locks.setdefault((url, node), FairLock())

    def plant_lock(self, url: str, node: int) -> threading.Lock:
        """Returns the lock of a plant that is run in blocks: it belongs to one job at a time, whatever its number of
        channels."""
        with self._guard:
            return self._plant_locks.setdefault((url, node), threading.Lock())

    # -- heartbeat

    def beat_if_due(self, url: str, bus: Bus) -> float:
        """Sends our heartbeat unless a loop of this process has just done so. Returns the time on the clock, which it
        takes a system call to read in some virtual machines."""
        now = self.monotonic()
        if now - self._beats.get(url, -math.inf) >= HEARTBEAT_S:
            self.beat(url, bus, now)
        return now

    def beat(self, url: str, bus: Bus, now: float) -> None:
        self._beats[url] = now  # before it is heard: who listens must know it for ours
        bus.send(heartbeat_id(self.node), HEARTBEAT_FRAME.pack(NmtState.OPERATIONAL))

    def join(self, url: str) -> None:
        """Listens before a loop beats, where we have not beaten for a while: a gateway with our ID would keep our
        sessions alive. Raises NodeTaken, BusError."""
        with self._listening:
            beaten_at = self._beats.get(url)
            if beaten_at is None or self.monotonic() - beaten_at >= self.listen_s:
                self._listen(url)
                self._beats[url] = self.monotonic() - HEARTBEAT_S

    def _listen(self, url: str) -> None:
        if not self.listen_s:
            return
        bus = self.open_bus(url)
        try:
            bus.set_filters({heartbeat_id(self.node)})
            beaten_at = self._beats.get(url)
            give_up = self.monotonic() + self.listen_s
            while (left := give_up - self.monotonic()) > 0:
                heard = bus.recv(min(left, _LISTEN_STEP_S))
                if self._beats.get(url) != beaten_at:
                    return  # a loop of ours that had been held up beats again
                if heard is not None and heard[0] == heartbeat_id(self.node):  # not one from before the filter
                    raise NodeTaken(
                        f"another gateway on {url!r} has node-ID {self.node:02X}h: give each one its own (--node)"
                    )
        finally:
            bus.close()
