"""The bus of a device: the hub, or any server of the socketcand protocol, is joined again when it has been away.

A socket of SocketCAN outlives an interface that goes down; a connection does not outlive its server.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection
from queue import Empty, SimpleQueue
from typing import NoReturn

from loopwright.protocol.bus import Bus, BusError, Frame, open_bus
from loopwright.protocol.bus_state import BusState

_AGAIN_S = 0.2
"""Wall time between two tries to join a server that is away, s."""


def open_device_bus(url: str) -> Bus:
    """Opens a bus that is found again when it goes down and comes back. Raises BusError."""
    return RejoinedBus(url) if url.startswith("socketcand:") else open_bus(url)


class RejoinedBus:
    """A bus on a server. While that is away, `send` and `recv` raise BusError at once: a server that hangs keeps
    whoever joins it waiting for seconds, so a thread joins it, and the device follows its own rules meanwhile."""

    def __init__(self, url: str, open_bus: Callable[[str], Bus] = open_bus) -> None:
        """Joins the server. Raises BusError."""
        self._url, self._open = url, open_bus
        self._bus: Bus | None = open_bus(url)
        self._wanted: Collection[int] | None = None
        self._why = ""
        self._found: SimpleQueue[Bus] = SimpleQueue()
        self._closed = threading.Event()

    @property
    def state(self) -> BusState:
        return BusState.ACTIVE if self._bus is None else self._bus.state

    def send(self, can_id: int, data: bytes) -> None:
        bus = self._bus or self._join()
        try:
            bus.send(can_id, data)
        except BusError as error:
            self._lose(bus, error)

    def recv(self, timeout: float | None) -> Frame | None:
        bus = self._bus or self._join()
        try:
            return bus.recv(timeout)
        except BusError as error:
            self._lose(bus, error)

    def set_filters(self, ids: Collection[int]) -> None:
        self._wanted = frozenset(ids)
        if self._bus is not None:
            self._bus.set_filters(ids)

    def fileno(self) -> int:
        return -1 if self._bus is None else self._bus.fileno()

    def close(self) -> None:
        self._closed.set()
        if self._bus is not None:
            self._bus.close()
        self._close_found()

    def _join(self) -> Bus:
        """Returns the bus that the thread has found. Raises BusError when there is none yet."""
        try:
            bus = self._found.get_nowait()
        except Empty:
            raise BusError(self._why) from None
        if self._wanted is not None:
            bus.set_filters(self._wanted)
        self._bus = bus
        return bus

    def _lose(self, bus: Bus, error: BusError) -> NoReturn:
        self._bus, self._why = None, str(error)
        bus.close()
        threading.Thread(target=self._find, daemon=True).start()
        raise error

    def _find(self) -> None:
        """Tries to join the server until it is there, or until this bus is closed."""
        while not self._closed.wait(_AGAIN_S):
            try:
                self._found.put(self._open(self._url))
            except BusError as error:
                self._why = str(error)
                continue
            if self._closed.is_set():  # meanwhile; `close` may not have seen it
                self._close_found()
            return

    def _close_found(self) -> None:
        while True:
            try:
                self._found.get_nowait().close()
            except Empty:
                return
