"""Health: a node is well as long as its heartbeat is on the bus, a service as long as it answers."""

from __future__ import annotations

import http.server
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from loopwright.containers import health
from loopwright.protocol.bus import open_bus
from loopwright.protocol.hub import Hub
from loopwright.protocol.profile import heartbeat_id
from tests.unit.protocol.socketcand_server import greet


@pytest.fixture
def hub() -> Iterator[Hub]:
    found = Hub(0)
    serving = threading.Thread(target=found.serve)
    serving.start()
    yield found
    found.stop()
    serving.join()


def test_a_heartbeat_among_other_frames_is_heard(hub: Hub) -> None:
    bus = open_bus(hub.url)
    over = threading.Event()

    def beat() -> None:
        while not over.wait(0.02):
            bus.send(0x1A0, bytes(8))
            bus.send(heartbeat_id(0x2A), b"\x05")

    beating = threading.Thread(target=beat)
    beating.start()
    try:
        health.hear(hub.url, heartbeat_id(0x2A))
        with pytest.raises(TimeoutError, match="0x710"):
            health.hear(hub.url, heartbeat_id(0x10))
    finally:
        over.set()
        beating.join()
        bus.close()


@contextmanager
def service(**answers: int) -> Iterator[str]:
    """Answers each path with its status, 404 for the others."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(answers.get(self.path.strip("/"), 404))
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    serving = threading.Thread(target=server.serve_forever, args=(0.02,))
    serving.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        serving.join()
        server.server_close()


@pytest.mark.parametrize(
    ("answers", "status"),
    [({"healthz": 200}, 0), ({"loops": 200}, 0), ({}, 1), ({"healthz": 503, "loops": 200}, 1)],
)
def test_a_service_that_answers(answers: dict[str, int], status: int, capsys: pytest.CaptureFixture[str]) -> None:
    with service(**answers) as url:
        assert health.main(["service", url]) == status
    assert capsys.readouterr().out.startswith("service: HTTP Error") == bool(status)


def test_no_service(capsys: pytest.CaptureFixture[str]) -> None:
    with service() as url:
        pass
    assert health.main(["service", url]) == 1
    assert "refused" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["node"], "node: '' is no node-ID: give one of 1 to 127"),
        (["node", "plant"], "'plant' is no node-ID"),
        (["node", "0"], "'0' is no node-ID"),
        (["node", "0x80"], "'0x80' is no node-ID"),
        (["service", "8080"], "unknown url type"),
        (["service", "http://[::1"], "Invalid IPv6 URL"),
        (["service", "http://127.0.0.1:80 80"], "nonnumeric port"),
    ],
)
def test_a_wrong_argument_is_said_in_a_sentence(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        health.main(words)
    assert caught.value.code == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("answer", [b"rubbish\r\n\r\n", b"HTTP/1.1 abc\r\n\r\n"])
def test_what_answers_and_is_no_service(answer: bytes, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            connection, _ = server.accept()
            with connection:
                connection.recv(4096)
                connection.sendall(answer)

        serving = threading.Thread(target=serve)
        serving.start()
        assert health.main(["service", f"http://127.0.0.1:{server.getsockname()[1]}"]) == 1
        serving.join()
    assert "not as a service does" in capsys.readouterr().out


def test_a_hub_that_ends_is_not_waited_for() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            connection, _ = server.accept()
            with connection:
                greet(connection)

        serving = threading.Thread(target=serve)
        serving.start()
        with pytest.raises(ConnectionError, match="has ended"):
            health.hear(f"socketcand:127.0.0.1:{server.getsockname()[1]}", 0x720)
        serving.join()
