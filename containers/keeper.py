"""How the other containers find the bus: a connection returns its address, and lasts as long as the bus.

A container that shares another's network namespace stays in the old one when that container is restarted. From the
broken connection it learns that it has to restart too.
"""

from __future__ import annotations

import socket
import time

ADDRESS = ("127.0.0.1", 29530)
_BETWEEN_S = 0.1


class NoBus(Exception):
    """Raised when no bus exists in this network namespace."""


def join(patience_s: float, address: tuple[str, int] = ADDRESS) -> tuple[str, socket.socket]:
    """Returns the address of the bus, and the connection that ends with the bus. Raises NoBus after `patience_s` of
    wall time."""
    give_up = time.monotonic() + patience_s
    while True:
        try:
            connection = socket.create_connection(address, timeout=2.0)
            url = _line(connection)
            connection.settimeout(None)
            return url, connection
        except OSError as error:
            if time.monotonic() > give_up:
                raise NoBus(f"no bus in this network namespace ({error.strerror or error})") from error
        time.sleep(_BETWEEN_S)


def _line(connection: socket.socket) -> str:
    with connection.makefile("r", encoding="ascii") as lines:
        url = lines.readline().strip()
    if not url:
        raise ConnectionResetError("the bus has ended")
    return url
