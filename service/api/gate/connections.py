"""Connections: how many there may be, and how long one may keep us waiting. uvicorn bounds neither.

When there is no room a new connection that says nothing is closed at once: who wants something has said it by the time
it is accepted. One that says something takes the place of the one that has waited longest for a request, or for the
rest of one; a connection on which a request is answered stays. So those who open many keep nobody out, and cost little.
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

TOLD_EVERY_S = 60.0
ACCEPTED_AT_ONCE = 8
"""Between two looks of the event loop at everything else."""
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
    """As many file descriptors as the system lets us have. How many that is."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != hard:
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    return hard if hard != resource.RLIM_INFINITY else 1 << 20


class Told:
    """Something that may happen often, in one line of the log a minute."""

    def __init__(self, wall: Callable[[], float] = time.monotonic) -> None:
        self._wall = wall
        self._at = -TOLD_EVERY_S
        self._since = 0

    def happened(self, text: str) -> None:
        self._since += 1
        if self._wall() - self._at >= TOLD_EVERY_S:
            log.warning("%s (%d since the last such line, of which there is one a minute)", text, self._since)
            self._at, self._since = self._wall(), 0


class OnceAMinute(logging.Filter):
    """Of a logger's warnings each text once a minute: some are for every bad request."""

    def __init__(self, wall: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._wall = wall
        self._at: dict[str, float] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        if record.levelno > logging.WARNING:
            return True
        now = self._wall()
        if now - self._at.get(record.msg, -TOLD_EVERY_S) < TOLD_EVERY_S:
            return False
        self._at[record.msg] = now
        return True


class Connections:
    """The open ones. exempt: whether an address is not a client's own (a proxy's), and may have as many as there are.

    For one event loop.
    """

    def __init__(
        self, limits: RequestLimits, descriptors: int, exempt: Callable[[str], bool] = lambda address: False
    ) -> None:
        self.limits = limits
        # The other half is for buses, database and files.
        self._max = min(limits.connections, descriptors // 2)
        self._max_of_address = min(limits.connections_of_address, self._max)
        self._exempt = exempt
        self._open: Counter[str] = Counter()
        self._idle: dict[str, OrderedDict[Connection, None]] = {}
        self._told = Told()

    def wanted(self, new: socket.socket, address: str) -> bool:
        """Whether it may go before the event loop at all."""
        if not self._address_is_full(address) and self._open.total() < self._max:
            return True
        try:
            if new.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT):
                return True
        except OSError:  # nothing is there yet, or it has gone already
            pass
        self.refused(address)
        return False

    def _address_is_full(self, address: str) -> bool:
        return self._open[address] >= self._max_of_address and not self._exempt(address)

    def admit(self, new: Connection) -> bool:
        """Makes room if there is none. False: there is no connection that could give way."""
        if self._address_is_full(new.address):
            found = self._give_way(new.address)
        else:
            found = self._open.total() < self._max or any(map(self._give_way, self._by_number()))
        if found:
            self._open[new.address] += 1
            self.idle(new)
        return found

    def idle(self, connection: Connection) -> None:
        """It waits for a request, from now on."""
        self._idle.setdefault(connection.address, OrderedDict())[connection] = None

    def busy(self, connection: Connection) -> None:
        """A request has arrived on it."""
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
        self._tell(f"a connection from {address} was refused")

    def _by_number(self) -> list[str]:
        return [address for address, _ in self._open.most_common()]

    def _give_way(self, address: str) -> bool:
        waiting = self._idle.get(address)
        if not waiting:
            return False
        oldest = next(iter(waiting))
        self._tell(f"a connection from {address} that was waited for gave way to a new one")
        oldest.give_way()
        return True

    def _tell(self, what: str) -> None:
        self._told.happened(
            f"{what}: {self._open.total()} are open, {self._max} may be, {self._max_of_address} of one address"
        )


class Connection(H11Protocol):
    """uvicorn's, with an end to every wait for the client: for the head of its request, and until it takes an answer.
    The wait for the body is the gate's."""

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
            self._look()

    def on_response_complete(self) -> None:
        super().on_response_complete()  # which may begin the next request, where that is here already
        if self._busy:
            self._busy = False
            self._among.idle(self)
        self._wait_for_head()
        self._look()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._unsent = self.transport.get_write_buffer_size()
        self._write_due = self.loop.call_later(self._among.limits.write_s, self._end_unless_it_takes, "_write_due")

    def resume_writing(self) -> None:
        self._cancel("_write_due")
        super().resume_writing()

    def give_way(self) -> None:
        """At once: the descriptor is wanted."""
        self._leave()
        self.transport.abort()

    def _look(self) -> None:
        """Whether a request has arrived, whole or its head."""
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
        self._head_due = self.loop.call_later(self._among.limits.headers_s, self._end_unless_it_takes, "_head_due")

    def _end_unless_it_takes(self, due: str) -> None:
        """A long answer may take long, as long as the client goes on taking it."""
        unsent, before = self.transport.get_write_buffer_size(), self._unsent
        if not 0 < unsent < before:
            self.transport.abort()
            return
        self._unsent = unsent
        setattr(self, due, self.loop.call_later(self._among.limits.headers_s, self._end_unless_it_takes, due))

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
    """The listening socket. What asyncio would do at the end of the descriptors is to write a traceback for each
    connection it cannot accept, in a loop: here a descriptor is kept to turn them away with."""

    def __init__(self, fileno: int) -> None:
        super().__init__(fileno=fileno)
        self.wanted: Callable[[socket.socket, str], bool] = lambda new, address: True
        self._left = ACCEPTED_AT_ONCE
        self._spare = os.open(os.devnull, os.O_RDONLY)
        self._told = Told()

    def accept(self) -> tuple[socket.socket, Any]:
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
                self._told.happened("a connection was turned away, all file descriptors are taken")
                continue
            if self.wanted(new, address[0]):
                return new, address
            new.close()
        self._left = ACCEPTED_AT_ONCE
        raise BlockingIOError  # what else there is to do comes first; then we are asked again

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
