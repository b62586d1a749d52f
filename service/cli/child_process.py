"""Child processes that say when they are ready and are stopped for certain."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

_STOP_S = 90.0
"""Wall time that a process has for its end, as the unit's TimeoutStopSec: a service restores its loops first."""


class NotReady(Exception):
    """A process ended or said nothing in time; the text has its last words."""


class ChildProcess:
    """python -m MODULE ARGS with its output in a log file; `ready` is its line that starts with "ready"."""

    def __init__(self, name: str, arguments: Sequence[str], log: Path) -> None:
        self.name = name
        self._log = log
        self._ready = threading.Event()
        self.ready = ""
        command = [sys.executable, "-u", "-m", *arguments]
        self._errors = log.open("ab")
        self._process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=self._errors, text=True
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

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
        """The ready line. Raises NotReady."""
        if not self._ready.wait(timeout_s) or not self.ready:
            last = self._log.read_text(errors="replace").strip().splitlines()[-5:]
            raise NotReady(f"the {self.name} did not start: " + (" / ".join(last) or "no output"))
        return self.ready

    @property
    def pid(self) -> int:
        return self._process.pid

    def poll(self) -> int | None:
        return self._process.poll()

    def signal(self, number: int) -> None:
        self._process.send_signal(number)

    def kill(self) -> None:
        """SIGKILL: no chance to clean up."""
        self._process.kill()
        self._process.wait()

    def stop(self) -> int:
        """SIGTERM, and SIGKILL for who does not listen. Returns the exit status."""
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
