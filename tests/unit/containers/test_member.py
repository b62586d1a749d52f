"""A command lives as long as its bus: the member as a process, the keeper of the bus played by the test."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from loopwright.containers import keeper
from loopwright.containers.member import BUS_GONE, NO_COMMAND
from tests.unit.protocol.socketcand_server import reset_at_close

URL = "socketcand:127.0.0.1:1"
RUN = """
import sys
from loopwright.containers import keeper, member
keeper.join.__defaults__ = (("127.0.0.1", int(sys.argv[1])),)
member._BUS_RESTARTS_S = 0.0
member._JOIN_S = 0.2
sys.exit(member.main(sys.argv[2:]))
"""
WAITS = """
import signal, sys
signal.signal(signal.SIGTERM, lambda *_: sys.exit("made safe"))
print("ready", sys.argv[1:], flush=True)
signal.pause()
"""


class Keeper:
    """Answers one after the other; `let_go` breaks the connections as an ended container does."""

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._connections: list[socket.socket] = []
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            connection.sendall(f"{URL}\n".encode())
            self._connections.append(connection)

    def let_go(self, broken: bool = False) -> None:
        for connection in self._connections:
            if broken:
                reset_at_close(connection)
            connection.close()

    def close(self) -> None:
        with suppress(OSError):  # closed before
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.let_go()


@pytest.fixture
def bus() -> Iterator[Keeper]:
    found = Keeper()
    yield found
    found.close()


def start(port: int, *arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", RUN, str(port), *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def waiting(port: int) -> subprocess.Popen[str]:
    process = start(port, "--", sys.executable, "-c", WAITS, "--bus={bus}")
    assert process.stdout is not None
    assert process.stdout.readline() == f"ready ['--bus={URL}']\n"
    return process


def test_the_bus_goes_and_the_command_with_it(bus: Keeper) -> None:
    process = waiting(bus.port)
    bus.let_go()
    _, errors = process.communicate(timeout=120)
    assert process.returncode == BUS_GONE
    assert "made safe" in errors and "the bus has ended" in errors


def test_a_signal_is_passed_on(bus: Keeper) -> None:
    process = waiting(bus.port)
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 1 and errors == "made safe\n"


@pytest.mark.parametrize(
    ("script", "status"), [("raise SystemExit(3)", 3), ("import os; os.kill(os.getpid(), 9)", 137)]
)
def test_the_status_is_the_commands(bus: Keeper, script: str, status: int) -> None:
    process = start(bus.port, "--", sys.executable, "-c", script)
    process.communicate(timeout=120)
    assert process.returncode == status


def test_a_file_is_written_with_the_bus_and_more_filled_in(bus: Keeper, tmp_path: Path) -> None:
    template, file = tmp_path / "template", tmp_path / "file"
    template.write_text("bus: '{bus}', tag: '{tag}', {other}\n")
    process = start(bus.port, "--set=tag=A=B", "--write", str(template), str(file), "--", "cat", str(file))
    output, _ = process.communicate(timeout=120)
    assert (process.returncode, output) == (0, f"bus: '{URL}', tag: 'A=B', {{other}}\n")


@pytest.mark.parametrize(("value", "status"), [(None, 1), ("", 1), ("postgresql://", 0)])
def test_a_variable_without_which_nothing_is_started(
    bus: Keeper, monkeypatch: pytest.MonkeyPatch, value: str | None, status: int
) -> None:
    monkeypatch.delenv("LOOPWRIGHT_NEEDED", raising=False)
    if value is not None:
        monkeypatch.setenv("LOOPWRIGHT_NEEDED", value)
    process = start(bus.port, "--need=LOOPWRIGHT_NEEDED", "--", "true")
    _, errors = process.communicate(timeout=120)
    assert process.returncode == status
    assert errors.startswith("member: LOOPWRIGHT_NEEDED is not set") == bool(status)


def test_no_bus(bus: Keeper) -> None:
    bus.close()
    process = start(bus.port, "--", "true")
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 1 and errors.startswith("member: no bus")
    with pytest.raises(keeper.NoBus):
        keeper.join(0.0, ("127.0.0.1", bus.port))


@pytest.mark.parametrize("word", ["TIC-101", "=TIC-101", ""])
def test_a_setting_without_name_or_value_is_a_sentence(bus: Keeper, word: str) -> None:
    process = start(bus.port, "--set", word, "--", "true")
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 2
    assert f"{word!r} is not NAME=VALUE" in errors and "Traceback" not in errors


def test_a_template_that_is_no_text_is_a_sentence(bus: Keeper, tmp_path: Path) -> None:
    template = tmp_path / "template"
    template.write_bytes(b"\xff")
    process = start(bus.port, "--write", str(template), str(tmp_path / "file"), "--", "true")
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 2
    assert errors.startswith(f"member: {template} is no text in UTF-8") and errors.count("\n") == 1


def test_a_command_that_is_not_there_is_a_sentence(bus: Keeper) -> None:
    process = start(bus.port, "--", "/no/such/command")
    _, errors = process.communicate(timeout=120)
    assert process.returncode == NO_COMMAND
    assert errors == "member: '/no/such/command' cannot be started: No such file or directory\n"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_it_ends_quietly_when_asked_while_it_waits_for_the_bus(number: signal.Signals) -> None:
    """It runs as the first process of its container, to which a signal without a handler is not delivered."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        process = start(silent.getsockname()[1], "--", "true")
        connection, _ = silent.accept()
        with connection:
            process.send_signal(number)
            output = process.communicate(timeout=120)
    assert (process.returncode, output) == (128 + number, ("", ""))


def test_a_bus_that_breaks_off_ends_the_command_too(bus: Keeper) -> None:
    process = start(bus.port, "--", sys.executable, "-c", WAITS)
    assert process.stdout is not None
    assert process.stdout.readline().startswith("ready")
    bus.let_go(broken=True)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == BUS_GONE
    assert errors.startswith("made safe\nmember: the bus has ended")
