"""Viewers of the overview, as connections that take the live stream and throw it away.

python -m benchmarks.viewers URL NUMBER
"""

from __future__ import annotations

import selectors
import signal
import socket
import sys
import threading
from urllib.parse import urlsplit

from benchmarks.command import parser_of


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("url")
    parser.add_argument("number", type=int)
    given = parser.parse_args()
    place = urlsplit(given.url)
    over = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: over.set())
    silent = set[socket.socket]()
    with selectors.DefaultSelector() as selector:
        for _ in range(given.number):
            viewer = socket.create_connection((place.hostname, place.port), timeout=30.0)
            viewer.sendall(f"GET /live HTTP/1.1\r\nHost: {place.netloc}\r\nAccept: text/event-stream\r\n\r\n".encode())
            selector.register(viewer, selectors.EVENT_READ)
            silent.add(viewer)
        while not over.is_set():
            for key, _ in selector.select(0.5):
                found = key.fileobj
                assert isinstance(found, socket.socket)
                if not found.recv(1 << 20):
                    sys.exit("a stream ended")
                if found in silent:
                    silent.remove(found)
                    if not silent:
                        print("ready", flush=True)


if __name__ == "__main__":
    main()
