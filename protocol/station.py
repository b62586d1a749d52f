"""This process as a node of the buses: its node-ID, clock and heartbeat, and the locks of the SDO servers.

State that the loops of a process share is held here and not in modules, so that several gateways can be simulated in
one process, with a simulated clock.
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
from loopwright.protocol.patience import WAIT_S
from loopwright.protocol.profile import HEARTBEAT_FRAME, TUNER_NODE, NmtState, heartbeat_id, node_name

HEARTBEAT_S = 0.1
"""Longest wall time between two heartbeats of this process, s."""
LISTEN_S = 2.0
"""Wall time for which a node listens for another one with its node-ID before its first heartbeat, s."""
_LISTEN_STEP_S = 0.05


class NodeTaken(Exception):
    """Raised when another node of the bus sends heartbeats with this process's node-ID."""


@dataclass
class Station:
    """The state that one process shares between its loops.

    node: node-ID of this process, on every bus.
    listen_s: how long to listen for another node with this node-ID, s; 0 where there cannot be one.
    monotonic, sleep, open_bus: clock and buses of the machine, or simulated ones.
    """

    node: int = TUNER_NODE
    listen_s: float = LISTEN_S
    monotonic: Callable[[], float] = time.monotonic
    sleep: Callable[[float], None] = time.sleep
    open_bus: Callable[[str], Bus] = open_bus
    sdo_retries: Counter[str] = field(default_factory=Counter)
    """Number of SDO requests that were repeated because no answer came, by bus."""
    _beats: dict[str, float] = field(default_factory=dict)
    """Time of this process's last heartbeat on each bus. One heartbeat serves all loops of the process: it says that
    the process lives. Whether a loop's own thread works is seen from its lease alone."""
    _sdo_locks: dict[tuple[str, int], FairLock] = field(default_factory=dict)
    _plant_locks: dict[tuple[str, int], threading.Lock] = field(default_factory=dict)
    _guard: threading.Lock = field(default_factory=threading.Lock)
    _listening: threading.Lock = field(default_factory=threading.Lock)

    def sdo_lock(self, url: str, node: int) -> FairLock:
        """Returns the lock of an SDO server: it answers one request at a time, so the loops of a process on one node
        take turns."""
        with self._guard:
            return self._sdo_locks.setdefault((url, node), FairLock())

    def plant_lock(self, url: str, node: int) -> threading.Lock:
        """Returns the lock of a plant that is run in blocks: it serves one job at a time, whatever its number of
        channels."""
        with self._guard:
            return self._plant_locks.setdefault((url, node), threading.Lock())

    # -- heartbeat

    def beat_if_due(self, url: str, bus: Bus) -> float:
        """Sends the heartbeat if it would be late after the next wait, unless another loop of this process has just
        sent it. Returns the time on the clock, whose reading is a system call in some virtual machines."""
        now = self.monotonic()
        if now - self._beats.get(url, -math.inf) >= HEARTBEAT_S - WAIT_S:
            self.beat(url, bus, now)
        return now

    def beat(self, url: str, bus: Bus, now: float) -> None:
        """Sends the heartbeat at this time on the clock, s."""
        self._beats[url] = now  # noted before it is sent: `_listen` must recognise it as this process's own
        bus.send(heartbeat_id(self.node), HEARTBEAT_FRAME.pack(NmtState.OPERATIONAL))

    def join(self, url: str) -> None:
        """Listens before a loop's first heartbeat, unless this process has just sent one: a gateway with the same
        node-ID would keep this process's sessions alive. Raises NodeTaken, BusError."""
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
                    return  # a delayed loop of this process sends heartbeats again
                if heard is not None and heard[0] == heartbeat_id(self.node):  # not a frame from before the filter
                    raise NodeTaken(
                        f"another gateway on {url!r} has node-ID {node_name(self.node)}: give each one its own (--node)"
                    )
        finally:
            bus.close()
