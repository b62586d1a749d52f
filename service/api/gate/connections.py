"""Limits of the number of open connections and of the time that a client may keep one waiting. uvicorn has neither.

When all places are taken, a new connection that has sent nothing yet is closed at once; a client with a request has
sent it by the time the connection is accepted. A new connection that has sent something takes the place of the one that
has waited longest for a request or for the rest of one; a connection on which a request is answered stays. A client
that opens many connections therefore shuts nobody out, and costs little.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import resource
import socket
import time
from collections import Counter, OrderedDict
from collections.abc import Callable
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

from loopwright.service.api.gate.limits import RequestLimits

log = logging.getLogger(__name__)

WARN_EVERY_S = 60.0
ACCEPTED_AT_ONCE = 8
"""Connections accepted in one pass; then the event loop serves everything else."""
_OUT_OF_DESCRIPTORS = (errno.EMFILE, errno.ENFILE)
_NO_ROOM = (
    b"HTTP/1.1 503 Service Unavailable\r\nRetry-After: 1\r\nConnection: close\r\n"
    b"Content-Type: application/problem+json\r\nContent-Length: %d\r\n\r\n%s"
)
_NO_ROOM_BODY = (
    b'{"type":"about:blank","title":"Service Unavailable","status":503,'
    b'"detail":"as many connections as are permitted are being answered"}'
)


def raise_descriptor_limit() -> int:
    """Raises the soft limit of file descriptors to the hard one, and returns it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != hard:
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    return hard if hard != resource.RLIM_INFINITY else 1 << 20


class WarningOnceAMinute:
    """Logs an event that may happen often at most once a minute, with the number of times since."""

    def __init__(self, wall: Callable[[], float] = time.monotonic) -> None:
        self._wall = wall
        self._at = -WARN_EVERY_S
        self._since = 0

    def happened(self, text: str) -> None:
        self._since += 1
        if self._wall() - self._at >= WARN_EVERY_S:
            log.warning("%s (%d since the last such line, of which there is one a minute)", text, self._since)
            self._at, self._since = self._wall(), 0


class OnceAMinute(logging.Filter):
    """Passes each text of a logger's warnings once a minute: uvicorn warns for every bad request."""

    def __init__(self, wall: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._wall = wall
        self._at: dict[str, float] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        if record.levelno > logging.WARNING:
            return True
        now = self._wall()
        if now - self._at.get(record.msg, -WARN_EVERY_S) < WARN_EVERY_S:
            return False
        self._at[record.msg] = now
        return True


class Connections:
    """The open connections. An object belongs to one event loop.

    exempt: whether an address is a proxy's, which may have as many connections as there are.
    """

    def __init__(
        self, limits: RequestLimits, descriptors: int, exempt: Callable[[str], bool] = lambda address: False
    ) -> None:
        self.limits = limits
        # The other half of the descriptors is for buses, database and files.
        self._max = min(limits.connections, descriptors // 2)
        self._max_of_address = min(limits.connections_of_address, self._max)
        self._exempt = exempt
        self._open: Counter[str] = Counter()
        self._idle: dict[str, OrderedDict[Connection, None]] = {}
        self._warning = WarningOnceAMinute()

    def wanted(self, new: socket.socket, address: str) -> bool:
        """Whether an accepted connection is handed to the event loop; else the caller closes it."""
        if not self._address_is_full(address) and self._open.total() < self._max:
            return True
        try:
            if new.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT):
                return True
        except OSError:  # nothing has arrived yet, or the client has gone
            pass
        self.refused(address)
        return False

    def _address_is_full(self, address: str) -> bool:
        return self._open[address] >= self._max_of_address and not self._exempt(address)

    def admit(self, new: Connection) -> bool:
        """Adds the connection; closes a waiting one if there is no room. False: no connection could give way."""
        if self._address_is_full(new.address):
            found = self._give_way(new.address)
        else:
            found = self._open.total() < self._max or any(map(self._give_way, self._by_number()))
        if found:
            self._open[new.address] += 1
            self.idle(new)
        return found

    def idle(self, connection: Connection) -> None:
        """The connection waits for a request from now on."""
        self._idle.setdefault(connection.address, OrderedDict())[connection] = None

    def busy(self, connection: Connection) -> None:
        """A request has arrived on the connection."""
        waiting = self._idle.get(connection.address, OrderedDict())
        waiting.pop(connection, None)
        if not waiting:
            self._idle.pop(connection.address, None)

    def gone(self, connection: Connection) -> None:
        self.busy(connection)
        self._open[connection.address] -= 1
        if self._open[connection.address] <= 0:
            del self._open[connection.address]

    def refused(self, address: str) -> None:
        self._warn(f"a connection from {address} was refused")

    def _by_number(self) -> list[str]:
        return [address for address, _ in self._open.most_common()]

    def _give_way(self, address: str) -> bool:
        waiting = self._idle.get(address)
        if not waiting:
            return False
        oldest = next(iter(waiting))
        self._warn(f"a waiting connection from {address} gave way to a new one")
        oldest.give_way()
        return True

    def _warn(self, what: str) -> None:
        self._warning.happened(
            f"{what}: {self._open.total()} are open, {self._max} may be, {self._max_of_address} of one address"
        )


class Connection(H11Protocol):
    """uvicorn's connection with a time limit for the head of a request and for the client taking the answer.

    The gate limits the time for the body.
    """

    def __init__(self, among: Connections, **more: Any) -> None:
        super().__init__(**more)
        self._among = among
        self._admitted = False
        self._busy = False
        self._head_due: asyncio.TimerHandle | None = None
        self._write_due: asyncio.TimerHandle | None = None
        self._unsent = 0

    @property
    def address(self) -> str:
        return self.client[0] if self.client else "unknown"

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._admitted = self._among.admit(self)
        if self._admitted:
            self._wait_for_head()
        else:
            self._among.refused(self.address)
            transport.write(_NO_ROOM % (len(_NO_ROOM_BODY), _NO_ROOM_BODY))
            transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        self._cancel("_head_due")
        self._cancel("_write_due")
        self._leave()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        if self._admitted:
            super().data_received(data)
            self._on_data()

    def on_response_complete(self) -> None:
        super().on_response_complete()  # this begins the next request if it has arrived already
        if self._busy:
            self._busy = False
            self._among.idle(self)
        self._wait_for_head()
        self._on_data()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._unsent = self.transport.get_write_buffer_size()
        self._write_due = self.loop.call_later(self._among.limits.write_s, self._end_unless_taking, "_write_due")

    def resume_writing(self) -> None:
        self._cancel("_write_due")
        super().resume_writing()

    def give_way(self) -> None:
        """Closes the connection at once: its descriptor is needed."""
        self._leave()
        self.transport.abort()

    def _on_data(self) -> None:
        """Ends the wait for the head once it has arrived; a whole request makes the connection busy."""
        cycle = self.cycle
        if self.transport.is_closing() or cycle is None or cycle.response_complete:
            return
        self._cancel("_head_due")
        if not cycle.more_body and not self._busy:
            self._busy = True
            self._among.busy(self)

    def _wait_for_head(self) -> None:
        self._cancel("_head_due")
        self._unsent = self.transport.get_write_buffer_size()
        self._head_due = self.loop.call_later(self._among.limits.headers_s, self._end_unless_taking, "_head_due")

    def _end_unless_taking(self, due: str) -> None:
        """Ends the connection, unless the client has taken a part of the answer since the timer was set."""
        unsent, before = self.transport.get_write_buffer_size(), self._unsent
        if not 0 < unsent < before:
            self.transport.abort()
            return
        self._unsent = unsent
        setattr(self, due, self.loop.call_later(self._among.limits.headers_s, self._end_unless_taking, due))

    def _leave(self) -> None:
        if self._admitted:
            self._admitted = False
            self._among.gone(self)

    def _cancel(self, name: str) -> None:
        due = getattr(self, name)
        if due is not None:
            due.cancel()
            setattr(self, name, None)


class Listener(socket.socket):
    """The listening socket. Without file descriptors asyncio would log a traceback for each connection that it cannot
    accept, in a loop; this socket keeps a spare descriptor, with which it accepts and closes such connections."""

    def __init__(self, fileno: int) -> None:
        super().__init__(fileno=fileno)
        self.wanted: Callable[[socket.socket, str], bool] = lambda new, address: True
        self._left = ACCEPTED_AT_ONCE
        self._spare = os.open(os.devnull, os.O_RDONLY)
        self._warning = WarningOnceAMinute()

    def accept(self) -> tuple[socket.socket, object]:
        while self._left:
            self._left -= 1
            try:
                new, address = super().accept()
            except BlockingIOError:
                break
            except OSError as error:
                if error.errno not in _OUT_OF_DESCRIPTORS or not self._turn_away():
                    self._left = 0
                    raise
                self._warning.happened("a connection was turned away, all file descriptors are taken")
                continue
            if self.wanted(new, address[0]):
                return new, address
            new.close()
        self._left = ACCEPTED_AT_ONCE
        raise BlockingIOError  # the event loop serves the rest first, then calls again

    def close(self) -> None:
        super().close()
        if self._spare >= 0:
            os.close(self._spare)
            self._spare = -1

    def _turn_away(self) -> bool:
        if self._spare < 0:
            return False
        os.close(self._spare)
        self._spare = -1
        try:
            super().accept()[0].close()
        except OSError:
            pass
        finally:
            try:
                self._spare = os.open(os.devnull, os.O_RDONLY)
            except OSError:
                return False
        return True
