"""A CAN bus without CAN: a hub on 127.0.0.1 for systems that have no SocketCAN.

It speaks the raw mode of the socketcand protocol, so python-can's own `socketcand` interface can connect to it
(`open_bus("socketcand:127.0.0.1:29536")`). All others receive what one member sends, in one order, and TCP loses no
frame.

    server: < hi >      client: < open vcan0 >  server: < ok >     client: < rawmode >   server: < ok >
    client: < send 190 8 0 0 48 42 1 0 0 0 >                       others get: < frame 190 12.345678 0000484201000000 >
"""

from __future__ import annotations

import argparse
import errno
import re
import selectors
import signal
import socket
import sys
import time
from collections.abc import Sequence
from contextlib import suppress

DEFAULT_PORT = 29536
"""The TCP port that socketcand uses by default."""

_LONGEST_QUEUE = 32 << 20  # bytes waiting for one member; a member that hangs must not use up the hub's memory
_LONGEST_MESSAGE = 200
# python-can's client expects "< ok >" alone in one read; frames within this time after it are delayed.
_JOINING_S = 0.05
_NO_ROOM = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)
_ROOM_AGAIN_S = 1.0
"""Time after which a hub that had no room for another connection looks again, s."""
_SENT = re.compile(rb"send ([0-7][0-9a-f]{2}|[01][0-9a-f]{7}) ([0-8])((?: [0-9a-f]{1,2})*)", re.IGNORECASE)


class _Member:
    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection
        self.received = b""
        self.queue = bytearray()
        self.raw_from: float | None = None  # monotonic time from which frames may be sent; None: not in raw mode


class Hub:
    """A hub that serves all members in one thread. `serve` returns after `stop`, which any thread or signal handler may
    call."""

    def __init__(self, port: int = DEFAULT_PORT) -> None:
        self._listener = socket.create_server(("127.0.0.1", port))
        self.address: str
        self.port: int  # the one that was free where 0 was asked for
        self.address, self.port = self._listener.getsockname()
        self._wake, self._woken = socket.socketpair()
        self._selector = selectors.DefaultSelector()
        self._members: set[_Member] = set()
        self._is_full = False
        """Whether there was no room for the last one that wanted to join, which has been said."""
        self._full_until: float | None = None
        """Monotonic time until which nobody is let in then; None for any other time."""

    @property
    def url(self) -> str:
        return f"socketcand:127.0.0.1:{self.port}"

    def stop(self) -> None:
        with suppress(OSError):
            self._wake.send(b"x")

    def serve(self) -> None:
        """Serves all members until `stop` is called."""
        for sock in (self._listener, self._woken):
            sock.setblocking(False)
            self._selector.register(sock, selectors.EVENT_READ)
        try:
            while True:
                for key, events in self._selector.select(self._longest_wait(time.monotonic())):
                    if key.fileobj is self._woken:
                        return
                    if key.fileobj is self._listener:
                        self._welcome()
                    elif key.data in self._members and events & selectors.EVENT_READ:
                        self._read(key.data)
                for member in list(self._members):
                    self._flush(member)
        finally:
            self._close()

    def _longest_wait(self, now: float) -> float | None:
        """Returns the time after which something is due that no connection announces, s; None for nothing."""
        waits = []
        if any(m.queue and m.raw_from is not None and m.raw_from > now for m in self._members):
            waits.append(_JOINING_S)
        if self._full_until is not None:
            if now >= self._full_until:
                self._full_until = None
                self._selector.register(self._listener, selectors.EVENT_READ)
            else:
                waits.append(self._full_until - now)
        return min(waits, default=None)

    def _welcome(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError as error:
            if error.errno in _NO_ROOM:
                self._let_wait(error)
            return
        self._is_full = False
        with suppress(OSError):
            connection.setblocking(False)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            member = _Member(connection)
            self._members.add(member)
            self._selector.register(connection, selectors.EVENT_READ, member)
            connection.send(b"< hi >")

    def _let_wait(self, error: OSError) -> None:
        """Leaves whoever wants to join waiting for a while: the listener would be ready all the time."""
        if not self._is_full:
            more = f"end some of its {len(self._members)} members, or let it open more files (ulimit -n)"
            print(f"hub: nobody else can join: {error.strerror}; {more}", file=sys.stderr, flush=True)
        self._is_full = True
        self._full_until = time.monotonic() + _ROOM_AGAIN_S
        self._selector.unregister(self._listener)

    def _read(self, member: _Member) -> None:
        try:
            data = member.connection.recv(65536)
            # Otherwise the member's second small frame waits for the hub's delayed acknowledgement.
            if hasattr(socket, "TCP_QUICKACK"):
                member.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._leave(member)
            return
        *messages, member.received = (member.received + data).split(b">")
        if len(member.received) > _LONGEST_MESSAGE:
            self._leave(member)
            return
        for message in messages:
            self._answer(member, message.split()[1:])

    def _answer(self, member: _Member, words: list[bytes]) -> None:
        """Answers one message.

        words: the message without its brackets.
        """
        if not words:
            return
        if words[0] == b"send" and member.raw_from is not None:
            frame = _frame(words)
            if frame is None:
                member.queue += b"< error malformed frame >"
                return
            self._pass_on(member, frame)
        elif words[0] in (b"open", b"rawmode"):
            with suppress(OSError):
                member.connection.send(b"< ok >")
            if words[0] == b"rawmode":
                member.raw_from = time.monotonic() + _JOINING_S
        elif words[0] == b"echo":
            member.queue += b"< echo >"

    def _pass_on(self, sender: _Member, frame: bytes) -> None:
        for other in self._members:
            if other is not sender and other.raw_from is not None:
                other.queue += frame

    def _flush(self, member: _Member) -> None:
        if not member.queue or member not in self._members:
            return
        if member.raw_from is not None and time.monotonic() < member.raw_from:
            return
        try:
            sent = member.connection.send(member.queue)
            del member.queue[:sent]
        except BlockingIOError:
            pass
        except OSError:
            self._leave(member)
            return
        if len(member.queue) > _LONGEST_QUEUE:
            self._leave(member)
            return
        # A full connection is selected again when it has room.
        events = selectors.EVENT_READ | (selectors.EVENT_WRITE if member.queue else 0)
        if self._selector.get_key(member.connection).events != events:
            self._selector.modify(member.connection, events, member)

    def _leave(self, member: _Member) -> None:
        self._members.discard(member)
        self._selector.unregister(member.connection)
        member.connection.close()

    def _close(self) -> None:
        for member in list(self._members):
            self._leave(member)
        self._selector.close()
        for sock in (self._listener, self._wake, self._woken):
            sock.close()


def _frame(words: list[bytes]) -> bytes | None:
    """Returns `send ID LENGTH BYTE...` as the other members receive it; None when it is not a CAN frame."""
    sent = _SENT.fullmatch(b" ".join(words))
    if sent is None:
        return None
    can_id, length, values = sent[1], int(sent[2]), bytes(int(word, 16) for word in sent[3].split())
    if length != len(values):
        return None
    return b"< frame %s %.6f %s >" % (can_id, time.time(), values.hex().encode())


def _port(text: str) -> int:
    port = int(text)
    if not 0 <= port <= 65535:
        raise argparse.ArgumentTypeError("a port is 0 to 65535")
    return port


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m loopwright.protocol.hub", description="A CAN bus on 127.0.0.1, without CAN."
    )
    parser.add_argument("--port", type=_port, default=DEFAULT_PORT, help="0 takes any free one (default: %(default)s)")
    try:
        hub = Hub(parser.parse_args(argv).port)
    except OSError as error:
        parser.exit(1, f"hub: {error.strerror}\n")
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: hub.stop())
    print(f"ready {hub.url}", flush=True)
    hub.serve()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
