"""`loopwright demo` as a process: on a terminal it goes on until a signal comes, without one it ends by itself."""

from __future__ import annotations

import os
import pty
import shlex
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest
import yaml

from loopwright.protocol.tuner import Tuner
from loopwright.service.loops.bus_loop import BusLoop
from loopwright.tuning.plan import Mode

PATIENCE_S = 240.0
FAST = ("--method", "fast", "--hub")
INTERRUPT = b"\x03"


class Demo:
    """The demo, alone in a session: everything that it starts is in there.

    terminal: whether it is on a terminal of its own.
    """

    def __init__(self, folder: Path, *options: str, terminal: bool = True) -> None:
        self.temporary = folder
        self._screen = b""
        command = [str(Path(sys.executable).with_name("loopwright")), "demo", *options]
        self._master, slave = pty.openpty() if terminal else os.pipe()
        # setsid gives it the terminal on standard input as the one whose keys are signals; nohup has SIGHUP ignored.
        self.process = subprocess.Popen(
            ["env", "--default-signal=HUP", "setsid", "--ctty", *command] if terminal else command,
            stdin=slave if terminal else subprocess.DEVNULL,
            stdout=slave,
            stderr=slave,
            env=os.environ | {"TMPDIR": str(folder)},
            start_new_session=not terminal,
        )
        os.close(slave)
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        while True:
            try:
                data = os.read(self._master, 65536)
            except OSError:  # the other end is closed: a terminal says so by an error
                return
            if not data:
                return
            self._screen += data

    @property
    def screen(self) -> str:
        return self._screen.decode(errors="replace").replace("\r\n", "\n")

    def line(self, begin: str) -> str:
        """Waits for a line; returns what follows its beginning."""
        give_up = time.monotonic() + PATIENCE_S
        while time.monotonic() < give_up and self.process.poll() is None:
            for line in self.screen.splitlines(keepends=True):
                if line.startswith(begin) and line.endswith("\n"):
                    return line.removeprefix(begin).strip()
            time.sleep(0.05)
        raise AssertionError(f"no line {begin!r} from the demo:\n{self.screen}")

    def press(self, keys: bytes) -> None:
        os.write(self._master, keys)

    def close_terminal(self) -> None:
        os.close(self._master)

    def processes(self) -> list[str]:
        """The processes of the session that have not ended."""
        found = []
        for stat in Path("/proc").glob("[0-9]*/stat"):
            try:
                name, _, rest = stat.read_text().partition("(")[2].rpartition(")")
            except OSError:  # it has ended meanwhile
                continue
            state, _, _, session = rest.split()[:4]
            if int(session) == self.process.pid and state != "Z":
                found.append(f"{stat.parent.name} {name}")
        return found

    def ended(self) -> int:
        """Waits until the demo has ended; returns its exit status."""
        try:
            return self.process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"the demo goes on:\n{self.screen}") from None

    def kill(self) -> None:
        for process in self.processes():
            os.kill(int(process.split()[0]), signal.SIGKILL)
        self.process.wait()


@pytest.fixture
def demos(tmp_path: Path) -> Iterator[list[Demo]]:
    """The demos of a test, which leave nothing behind whatever becomes of the test."""
    started: list[Demo] = []
    yield started
    for each in started:
        each.kill()


def nothing_listens(url: str) -> bool:
    address = httpx.URL(url)
    with socket.socket() as probe:
        return probe.connect_ex((address.host, address.port or 80)) != 0


def test_in_a_terminal_the_loop_goes_on_until_ctrl_c(tmp_path: Path, demos: list[Demo]) -> None:
    demos.append(demo := Demo(tmp_path, *FAST, "--port", "0"))
    page, _, where = demo.line("page ").partition(" ")
    url = page.removesuffix("/ui/loops/TIC-101")
    assert "on this machine" in where and page != url
    accept = shlex.split(demo.line("accept ").partition(" (")[0])
    end = demo.line("end ")
    assert "Ctrl-C" in end and str(tmp_path) in end
    (folder,) = tmp_path.glob("loopwright-demo-*")
    bus = yaml.safe_load((folder / "loops.yaml").read_text())["loops"][0]["bus"]

    with httpx.Client(base_url=url, timeout=30.0, trust_env=False) as http:
        assert http.get("/healthz").status_code == 200
        assert "<!doctype html>" in http.get("/ui/").text.lower() == http.get("/ui/loops/TIC-101").text.lower()
        # by the devices' own word, not the service's
        assert Tuner(bus, 0x20, 0x10).number("plant_pace") == 1.0
        before = BusLoop(bus, 0x20, 0x10).read()
        assert (before.mode, before.gains.Kp, before.gains.Ti) == (Mode.AUTOMATIC, 80.0, 1.2)
        until(lambda: BusLoop(bus, 0x20, 0x10).read().pv != before.pv)

        assert subprocess.run(accept, capture_output=True, text=True, timeout=PATIENCE_S).returncode == 0
        accepted = BusLoop(bus, 0x20, 0x10).read().gains
        assert accepted.Kp == pytest.approx(58.5, rel=0.05) and accepted.Ti == pytest.approx(2.1, rel=0.1)

        job = http.post("/loops/TIC-101/retune", json={"by": "me", "method": "setpoint"})
        assert job.status_code == 202
        until(lambda: http.get(job.headers["location"]).json()["stage"] == "pulses")
    demo.press(INTERRUPT * 2)
    assert demo.ended() == 0, demo.screen
    assert "ending" in demo.screen and "Traceback" not in demo.screen
    assert demo.processes() == [] == list(tmp_path.iterdir())
    assert nothing_listens(url)


def test_without_a_terminal_it_ends_by_itself_and_its_files_stay(tmp_path: Path, demos: list[Demo]) -> None:
    demos.append(demo := Demo(tmp_path, *FAST, terminal=False))
    pictures = Path(demo.line("pictures "))
    assert demo.ended() == 0, demo.screen
    assert demo.processes() == [] and pictures.stat().st_size > 10_000
    assert list(tmp_path.iterdir()) == [pictures.parent]
    assert not any(line.startswith(("page ", "accept ", "end ")) for line in demo.screen.splitlines())


@pytest.mark.parametrize(
    ("end", "status"),
    [
        (lambda demo: demo.press(INTERRUPT * 2), 130),
        (lambda demo: demo.process.terminate(), 143),
        (Demo.close_terminal, 129),
    ],
    ids=["ctrl-c twice", "SIGTERM", "terminal closed"],
)
def test_a_signal_while_it_starts_leaves_nothing(
    end: Callable[[Demo], None], status: int, tmp_path: Path, demos: list[Demo]
) -> None:
    demos.append(demo := Demo(tmp_path, *FAST))
    demo.line("hub ")
    assert len(demo.processes()) > 1
    end(demo)
    assert demo.ended() == status
    assert demo.processes() == [] == list(tmp_path.iterdir())


def test_a_port_that_is_taken_is_said_before_anything_starts(tmp_path: Path, demos: list[Demo]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        demos.append(demo := Demo(tmp_path, "--port", str(port)))
        assert demo.ended() == 1
    assert f"port {port} of 127.0.0.1 cannot be used" in demo.screen and "--port" in demo.screen
    assert list(tmp_path.iterdir()) == []


def until(wanted: Callable[[], bool]) -> None:
    give_up = time.monotonic() + PATIENCE_S
    while not wanted():
        assert time.monotonic() < give_up
        time.sleep(0.05)
