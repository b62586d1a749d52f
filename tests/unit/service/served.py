"""An application behind the real HTTP server, in a thread of the test: what the server does with connections shows."""

from __future__ import annotations

import http.client
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import uvicorn
from fastapi import FastAPI

from loopwright.service.server.serving import Setup, listen, server_config
from tests.unit.service.processes import until

SETUP = Setup(Path(), Path(), "127.0.0.1", 0)
PATIENCE_S = 60.0


@dataclass
class Served:
    port: int

    def ask(self, method: str, path: str, body: str | None = None, **headers: str) -> tuple[int, dict[str, str], bytes]:
        """(status, headers with small letters, body), on a connection of its own."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        try:
            names = {name.replace("_", "-"): value for name, value in headers.items()}
            connection.request(method, path, body, {"Content-Type": "application/json", **names})
            answer = connection.getresponse()
            return answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
        finally:
            connection.close()

    def begun(self, text: str = "") -> socket.socket:
        """A connection on which that has been sent."""
        connection = socket.create_connection(("127.0.0.1", self.port), timeout=PATIENCE_S)
        connection.sendall(text.replace("\n", "\r\n").encode())
        return connection


@contextmanager
def served(app: FastAPI, descriptors: int = 4096, **changes: Any) -> Iterator[Served]:
    """descriptors: those that the process is taken to have.  changes: of the setup."""
    setup = replace(SETUP, **changes)
    listener = listen(setup.bind, setup.port)
    server = uvicorn.Server(server_config(app, setup, listener, descriptors))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        until(lambda: server.started)
        yield Served(listener.getsockname()[1])
    finally:
        server.should_exit = True
        thread.join()
        listener.close()


def rest(connection: socket.socket) -> bytes:
    """All that comes until the other side closes; it may do so in anger."""
    found = b""
    try:
        while part := connection.recv(65536):
            found += part
    except ConnectionResetError:
        pass
    return found
