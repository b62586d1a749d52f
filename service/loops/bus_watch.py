"""The check that a bus works: it can be opened, and its CAN controller takes part in the traffic."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress

from loopwright.protocol.bus import Bus, BusError, open_bus
from loopwright.protocol.bus_state import BusState

_LISTENED_TO = "socketcan:"
"""Kind of bus whose error frames are received: they reach only sockets that are open when they are sent; a hub has
none."""
_MAX_FRAMES = 1000


class BusWatch:
    """Checks one bus; `check` may be called from any thread.

    open_bus: opens the bus; a test replaces it.
    """

    def __init__(self, url: str, open_bus: Callable[[str], Bus] = open_bus) -> None:
        self._url = url
        self._open = open_bus
        self._ear: Bus | None = None
        self._one_at_a_time = threading.Lock()

    def check(self) -> None:
        """Raises BusError unless the bus can be opened and is neither bus-off nor error-passive; sends nothing."""
        with self._one_at_a_time:
            try:
                self._open(self._url).close()
                if self._url.startswith(_LISTENED_TO):
                    self._listen()
            except OSError as error:
                self._forget()
                raise BusError(f"{self._url}: {error.strerror or error}") from error
            except BusError:
                if (
                    self._ear is not None and self._ear.state is not BusState.BUS_OFF
                ):  # only the open socket receives the restart
                    self._forget()
                raise
            if self._ear is not None and self._ear.state is BusState.PASSIVE:
                text = "many frames are damaged or not acknowledged: check termination, bit rate and wiring"
                raise BusError(f"{self._url} is error-passive: {text}")

    def _listen(self) -> None:
        if self._ear is None:
            self._ear = self._open(self._url)
            self._ear.set_filters(())
        for _ in range(_MAX_FRAMES):
            before = self._ear.state
            if self._ear.recv(0.0) is None and self._ear.state is before:
                return

    def _forget(self) -> None:
        if self._ear is not None:
            with suppress(OSError):
                self._ear.close()
            self._ear = None
