"""Ports for the servers that tests start, and that nobody else gets meanwhile."""

from __future__ import annotations

import socket


def free_port() -> int:
    """A port of 127.0.0.1 at which nobody listens. It is bound until this process ends, or the kernel could give it to
    another test before the server has it; a server with SO_REUSEADDR, as asyncio, Go and Python's own have it, still
    listens there."""
    with socket.socket() as held:
        held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        held.bind(("127.0.0.1", 0))
        port = int(held.getsockname()[1])
        held.detach()  # open as long as the process lives
    return port
