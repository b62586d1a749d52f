"""Services and devices forked from one process that has everything loaded: a start costs a tenth of the processor time.

    python -m tests.forked FD

Each is a process of its own with its own log, and is killed like any other; those left over end with the process that
has started them. What a start of the service itself does until it is ready is the subject of test_start.py and
test_stop.py, which start it anew, as the demo and the transcripts do with all of the processes.
"""

from __future__ import annotations

import atexit
import gc
import json
import os
import runpy
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from importlib import import_module

from loopwright.service.cli.child_process import ChildProcess

_LOADED = (
    "loopwright.protocol.hub",
    "loopwright.controller.__main__",
    "loopwright.plantsim.__main__",
    "loopwright.service.cli.main",
    "loopwright.service.server.serving",
)
"""What is imported before a process is forked."""
_MESSAGE = 65_536
_KILLED = -signal.SIGKILL


class _Forked:
    """What `ChildProcess` needs of a Popen. status: where the parent writes its pid, then its exit status."""

    def __init__(self, status: socket.socket, output: int) -> None:
        self._status = status
        self.stdout = os.fdopen(output, encoding="utf-8")
        self.returncode: int | None = None
        self.pid = int(status.recv(_MESSAGE))

    def poll(self) -> int | None:
        try:
            return self.wait(0.0)
        except subprocess.TimeoutExpired:
            return None

    def wait(self, timeout: float | None = None) -> int:
        if self.returncode is None:
            self._status.settimeout(timeout)
            try:
                self.returncode = int(self._status.recv(_MESSAGE) or _KILLED)
            except (BlockingIOError, TimeoutError):
                raise subprocess.TimeoutExpired(__name__, timeout or 0.0) from None
            self._status.close()
        return self.returncode

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


class ForkedProcess(ChildProcess):
    """python -m MODULE ARGS as a ChildProcess, which does not import again what is loaded."""

    def _start(self, arguments: Sequence[str], own_group: bool) -> subprocess.Popen[str]:
        assert not own_group
        sys.audit(__name__, *arguments)  # tests.starting hears it
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        read, write = os.pipe()
        with theirs:
            asked = json.dumps([os.getcwd(), dict(os.environ), *arguments]).encode()
            socket.send_fds(_parent(), [asked], [write, self._errors.fileno(), theirs.fileno()])
        os.close(write)
        return _Forked(ours, read)  # type: ignore[return-value]  # it has what ChildProcess uses


@cache
def _parent() -> socket.socket:
    """The connection to the process that forks, which ends with this one."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        command = [sys.executable, "-u", "-m", __name__, str(theirs.fileno())]
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, pass_fds=[theirs.fileno()])

    def end() -> None:
        ours.close()
        process.wait()

    atexit.register(end)
    return ours


def _say(end: socket.socket, number: int) -> None:
    """The test may have let go of its process, as one does that has killed it by its pid."""
    with suppress(ConnectionError):
        end.send(str(number).encode())


def arguments_of_a_fork(asked: socket.socket) -> list[str]:
    """Forks as often as it is asked to, and returns in each child. In the parent it ends with the connection."""
    woken, wakes = socket.socketpair()
    for each in (woken, wakes):
        each.setblocking(False)
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number in handlers:  # a test that signals to all its children does not mean this one
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(wakes.fileno())
    statuses: dict[int, socket.socket] = {}
    while True:
        ready, _, _ = select.select([asked, woken], [], [])
        if woken in ready:
            woken.recv(_MESSAGE)
            while statuses and (ended := os.waitpid(-1, os.WNOHANG))[0]:
                with statuses.pop(ended[0]) as end:
                    _say(end, os.waitstatus_to_exitcode(ended[1]))
        if asked not in ready:
            continue
        message, fds, _, _ = socket.recv_fds(asked, _MESSAGE, 3)
        if not message:
            for pid in statuses:  # those that a test which was cut off has left
                os.kill(pid, signal.SIGKILL)
            sys.exit()
        output, errors, end_fd = fds
        end = socket.socket(fileno=end_fd)
        assert threading.active_count() == 1
        if (pid := os.fork()) == 0:
            signal.set_wakeup_fd(-1)
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            for number, handler in handlers.items():
                signal.signal(number, handler)
            os.dup2(output, 1)
            os.dup2(errors, 2)
            for opened in (asked, woken, wakes, end, *statuses.values()):
                opened.close()
            for fd in (output, errors):
                os.close(fd)
            folder, environment, *arguments = json.loads(message)
            os.chdir(folder)
            os.environ.clear()
            os.environ.update(environment)
            return list(map(str, arguments))
        for fd in (output, errors):
            os.close(fd)
        statuses[pid] = end
        _say(end, pid)


def main() -> None:
    from loopwright.service.server.loading import loading

    with loading():
        for name in _LOADED:
            import_module(name)
        from loopwright.service.server import serving

        serving.load()
    gc.collect()
    asked = socket.socket(fileno=int(sys.argv[1]))
    sys.argv = arguments_of_a_fork(asked)
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
