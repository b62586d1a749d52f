"""The server's side of the socketcand protocol, for servers that go wrong afterwards."""

from __future__ import annotations

import socket
import struct

_AT_CLOSE = struct.pack("ii", 1, 0)


def greet(connection: socket.socket) -> None:
    """Brings a client to where it receives frames."""
    for answer in (b"< hi >", b"< ok >"):
        connection.sendall(answer)
        connection.recv(64)
    connection.sendall(b"< ok >")


def reset_at_close(connection: socket.socket) -> None:
    """Lets the connection end as one that was lost does."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _AT_CLOSE)
