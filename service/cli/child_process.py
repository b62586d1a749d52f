"""Child processes that report when they are ready and are stopped for certain."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

_STOP_S = 90.0
"""Wall time until a process is killed, s, as TimeoutStopSec of the systemd unit: a service restores its loops first."""


class NotReady(Exception):
    """A process ended or was not ready in time; the text has the last lines of its log."""


class ChildProcess:
    """Runs python -m MODULE ARGS with its output in a log file; `ready` is the line that starts with "ready".

    own_group: whether it is in a process group of its own, which Ctrl-C in the terminal does not reach.
    """

    def __init__(self, name: str, arguments: Sequence[str], log: Path, own_group: bool = False) -> None:
        self.name = name
        self._log = log
        self._ready = threading.Event()
        self.ready = ""
        self._errors = log.open("ab")
        self._process = self._start(arguments, own_group)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _start(self, arguments: Sequence[str], own_group: bool) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-u", "-m", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            process_group=0 if own_group else None,
        )

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as lines, self._log.open("a") as log:
            for line in lines:
                log.write(line)
                log.flush()
                if line.startswith("ready") and not self._ready.is_set():
                    self.ready = line.strip()
                    self._ready.set()
        self._ready.set()

    def wait_ready(self, timeout_s: float = 90.0) -> str:
        """Returns the ready line. Raises NotReady."""
        if not self._ready.wait(timeout_s) or not self.ready:
            raise NotReady(f"the {self.name} did not start: {self.last_lines()}")
        return self.ready

    def last_lines(self) -> str:
        """Returns the end of the log on one line."""
        return " / ".join(self._log.read_text(errors="replace").strip().splitlines()[-5:]) or "no output"

    @property
    def pid(self) -> int:
        return self._process.pid

    def poll(self) -> int | None:
        return self._process.poll()

    def signal(self, number: int) -> None:
        self._process.send_signal(number)

    def kill(self) -> None:
        """Ends the process by SIGKILL, which leaves it no time to clean up."""
        self._process.kill()
        self._process.wait()

    def stop(self) -> int:
        """Ends the process by SIGTERM, then by SIGKILL if it does not end. Returns the exit status."""
        if self._process.poll() is None:
            self._process.terminate()
        try:
            status = self._process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self.kill()
            status = self._process.wait()
        self._reader.join(1.0)
        self._errors.close()
        return status
