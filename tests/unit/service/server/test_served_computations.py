"""Computations of a service as it is started: what its processes hold, when they end, and what they cannot hold up."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml

from loopwright.protocol.hub import Hub
from tests.unit.service.fakes import TAG, loop_entry
from tests.unit.service.processes import descendants, gone, until

pytestmark = pytest.mark.timeout(300)  # processes that start slowly on a busy machine
ENDLESS = {"model": {"K": 2, "T_s": 10, "L_s": 3e3}, "method": "me-pso", "options": {"horizon_s": 1e8}}
"""More than 60 s of processor time; and some 500 MB, so that the limit of memory would be met first."""

MUCH_MEMORY = "--computation-memory-mb=4096"

SHORT = {"model": {"K": 2, "T_s": 10, "L_s": 2}, "method": "simc"}
LONG = {"dry_run": True, "plant": {"num": [2.0], "den": [3.0, 1.0], "dead_time_s": 1.0, "sample_time_s": 0.005}}
"""Of seconds."""


class Served:
    """`loopwright serve` on a port and a folder that stay the same from start to start."""

    def __init__(self, stack: ExitStack, folder: Path, *more: str) -> None:
        self._stack, self._more, self.data, self._log = stack, more, folder / "data", folder / "log"
        hub = Hub(0)
        thread = threading.Thread(target=hub.serve)
        thread.start()
        stack.callback(thread.join)
        stack.callback(hub.stop)
        self._loops = folder / "loops.yaml"
        self._loops.write_text(yaml.safe_dump({"loops": [loop_entry(bus=hub.url)]}))
        self.port = 0
        self.threads = stack.enter_context(ThreadPoolExecutor())
        self.start()

    def start(self) -> None:
        where = ["--loops", str(self._loops), "--data", str(self.data), "--port", str(self.port)]
        command = [sys.executable, "-m", "loopwright.service", "serve", *where, *self._more]
        with self._log.open("a") as log:
            self.process = subprocess.Popen(
                command, stdout=subprocess.PIPE, stderr=log, text=True, start_new_session=True
            )
        self._stack.callback(self._end, self.process)
        assert self.process.stdout is not None
        ready = self.process.stdout.readline()
        assert ready.startswith("ready"), self._log.read_text()
        self.url = ready.split()[1]
        self.port = int(self.url.rpartition(":")[2])
        # The service begins with a computation of its own, so that the fork server is there: then it is over.
        assert self.asked(SHORT).result(200).status_code == 200

    @staticmethod
    def _end(process: subprocess.Popen[str]) -> None:
        process.kill()
        process.communicate()

    @property
    def log(self) -> str:
        return self._log.read_text()

    def asked(self, body: dict[str, Any]) -> Future[httpx.Response]:
        """The answer to a tuning, which has a place as soon as the service has seen that the one before is gone."""

        def answer() -> httpx.Response:
            while True:
                got = httpx.post(f"{self.url}/tunings", json=body, timeout=200.0, trust_env=False)
                if got.status_code != 429:
                    return got

        return self.threads.submit(answer)

    def asked_and_left(self, body: dict[str, Any]) -> socket.socket:
        """The connection of a client that has asked and does not read the answer."""
        text = json.dumps(body).encode()
        client = self._stack.enter_context(socket.create_connection(("127.0.0.1", self.port)))
        head = f"POST /tunings HTTP/1.1\r\nHost: localhost:{self.port}\r\nContent-Type: application/json\r\n"
        client.sendall(f"{head}Content-Length: {len(text)}\r\n\r\n".encode() + text)
        return client

    def computing(self) -> list[int]:
        """The processes that the fork server has made."""
        ours = [int(each) for each in children(self.process.pid)]
        return [int(child) for parent in ours for child in children(parent)]

    def wait_for(self, signal_number: int, of_all: bool = False) -> int:
        (os.killpg if of_all else os.kill)(self.process.pid, signal_number)
        return self.process.wait(100)


def children(pid: int) -> list[str]:
    with suppress(FileNotFoundError, ProcessLookupError):
        return Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return []


def files_of(pid: int) -> set[str]:
    found = set()
    for entry in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(FileNotFoundError):
            found.add(os.readlink(entry))
    return found


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def test_what_they_hold_and_when_they_end(tmp_path: Path, stack: ExitStack) -> None:
    served = Served(stack, tmp_path, MUCH_MEMORY)
    assert httpx.get(f"{served.url}/readyz", trust_env=False, timeout=60).status_code in (200, 503)

    # what they hold
    client = served.asked_and_left(ENDLESS)
    until(served.computing)
    found = descendants(served.process.pid)
    assert len(found) >= 3  # the fork server, the tracker of multiprocessing, the computation

    def shared() -> set[str]:
        ours = {name for name in files_of(served.process.pid) if name.startswith("socket:") or str(served.data) in name}
        assert len(ours) >= 4
        return ours & set().union(*map(files_of, found))

    until(lambda: not shared())  # it gives its own end away, and lets go of it a little after the process is there

    # the client goes away
    (computing,) = served.computing()
    client.close()
    until(lambda: gone(computing))

    # kill -9: the next one has port and folder at once
    answer = served.asked(ENDLESS)
    until(served.computing)
    left = descendants(served.process.pid)
    assert served.wait_for(signal.SIGKILL) == -signal.SIGKILL
    served.start()
    with suppress(httpx.HTTPError):
        answer.result(60)
    until(lambda: all(gone(pid) for pid in left))

    # Ctrl-C, which all processes of the terminal get
    answer = served.asked(ENDLESS)
    until(served.computing)
    left = descendants(served.process.pid)
    status = served.wait_for(signal.SIGINT, of_all=True)
    told = answer.result(60)
    assert (told.status_code, told.json()["reason"]) == (503, "service_stopped")
    until(lambda: all(gone(pid) for pid in left))
    assert status in (0, -signal.SIGINT) and "Traceback" not in served.log


def test_what_costs_too_much_is_refused_by_name(tmp_path: Path, stack: ExitStack) -> None:
    served = Served(stack, tmp_path, "--tuning-cpu-s=1", MUCH_MEMORY)
    problem = served.asked(ENDLESS).result(200)
    assert (problem.status_code, problem.json()["reason"]) == (422, "computation_limit"), problem.text
    assert "1 s of processor time" in problem.json()["detail"] and "--tuning-cpu-s" in problem.json()["detail"]
    for model, method in (
        ({"K": 1e-308, "T_s": 10, "L_s": 2}, "all"),
        ({"K": 2, "T_s": 10, "L_s": 1e-9}, "me-pso"),
        ({"num": [1], "den": [1e-12, 1, 1e12, 1]}, "all"),
    ):
        answer = served.asked({"model": model, "method": method}).result(200)
        assert answer.status_code == 200 or answer.json()["reason"] in ("computation_limit", "bad_input")

    # a dry run is computed apart, too, and ends with its job
    answer = httpx.post(f"{served.url}/loops/{TAG}/retune", json=LONG, trust_env=False, timeout=60)
    until(served.computing)
    (computing,) = served.computing()
    job = f"{served.url}{answer.headers['location']}"
    assert httpx.post(f"{job}/abort", trust_env=False, timeout=60).status_code == 202
    until(lambda: gone(computing))
    until(lambda: httpx.get(job, trust_env=False, timeout=60).json()["state"] == "aborted")
    assert served.wait_for(signal.SIGTERM) in (0, -signal.SIGTERM)
    assert "Traceback" not in served.log


FAILING = """
import multiprocessing, socket, sys
from pathlib import Path
from loopwright.service.server.serving import Setup, serve
from loopwright.service.store.lock import FolderInUse
from loopwright.service.store.store import Store
loops, data = Path(sys.argv[1]), Path(sys.argv[2])
taken = socket.create_server(("127.0.0.1", 0))
port = taken.getsockname()[1]
store = Store(data)
for _ in range(20):
    for free in (port, 0):
        try:
            serve(Setup(loops, data, "127.0.0.1", free))
        except FolderInUse:
            print("folder")
        except OSError as error:
            print("port")
print(multiprocessing.active_children())
"""


def test_a_start_that_fails_leaves_nothing_and_says_nothing(tmp_path: Path) -> None:
    """Twenty times: the port is taken, and then the folder, when the pool is there already."""
    (tmp_path / "loops.yaml").write_text(yaml.safe_dump({"loops": [loop_entry()]}))
    command = [sys.executable, "-c", FAILING, str(tmp_path / "loops.yaml"), str(tmp_path / "data")]
    ended = subprocess.run(command, text=True, capture_output=True, timeout=250)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout.split() == [*["port", "folder"] * 20, "[]"]


def test_a_port_that_is_taken_is_all_that_is_said(tmp_path: Path) -> None:
    (tmp_path / "loops.yaml").write_text(yaml.safe_dump({"loops": [loop_entry()]}))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        where = ["--loops", str(tmp_path / "loops.yaml"), "--data", str(tmp_path / "data"), "--port", str(port)]
        ended = subprocess.run(
            [sys.executable, "-m", "loopwright.service", "serve", *where], text=True, capture_output=True, timeout=250
        )
    assert (ended.returncode, ended.stdout) == (2, "")
    assert len(ended.stderr.splitlines()) == 1 and f"127.0.0.1:{port}" in ended.stderr
