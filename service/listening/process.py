"""The process that listens, as the service has it: started again when it dies, told what was read, asked for rows.

It is a program of its own and not forked: the service has threads, and the process needs little of what it has loaded.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Future
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection

from loopwright.protocol.profile import ChannelIds
from loopwright.service.listening.messages import Finish, HistoryAnswer, Learn, Listen, NewSamples, Query, Report, Watch
from loopwright.service.telemetry.metrics import LISTENER_RESTARTS

log = logging.getLogger(__name__)

FIRST_PAUSE_S, LONGEST_PAUSE_S = 1.0, 60.0
"""Wall time before the process is started again, s: doubled each time unless it lived for the longest."""
_LOOK_S = 0.5
_FINISH_S = 3.0
_SAY_AGAIN_S = 60.0
_WRITING_S = 1.0
_STARTS_S, _HANGS_S = 180.0, 30.0
"""Wall time without a report after which the process is ended, s: without the first one, before which it loads at its
low priority, and without another one, of which there is one a second."""
NICENESS = 10
"""Priority of the process: its imports and its work make way for the sessions of the service."""
ANSWER_S = 3.0
"""Wall time within which the process has to answer, s."""


class NotListening(Exception):
    """Raised when there is no process that could answer; the text says why."""


class _Hangs(Exception):
    """Raised when the process reports no more."""


class ListeningProcess:
    """Keeps the process going, in a thread.

    loops: what it listens to, by bus and tag.
    nodes: the nodes whose heartbeats it hears, by bus.
    on_report: receives its reports, in that thread.
    on_samples: receives the new samples of the loops that are watched, in that thread.
    """

    def __init__(
        self,
        loops: Mapping[str, Mapping[str, ChannelIds]],
        on_report: Callable[[Report], None],
        first_pause_s: float = FIRST_PAUSE_S,
        on_samples: Callable[[NewSamples], None] = lambda _: None,
        nodes: Mapping[str, Collection[int]] | None = None,
    ) -> None:
        self._loops, self._on_report, self._first_pause_s = loops, on_report, first_pause_s
        self._nodes = nodes or {}
        self._on_samples = on_samples
        self._watched: frozenset[str] = frozenset()
        self._over = threading.Event()
        self._guard = threading.Lock()
        self._writing = threading.Lock()
        self._connection: Connection[object, object] | None = None
        self._asked: dict[int, Future[HistoryAnswer]] = {}
        self._number = 0
        self._said_at: float | None = None
        self._thread = threading.Thread(target=self._run, name="listening", daemon=True)
        self.pid: int | None = None

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """Ends the process, when it has reported the rest."""
        self._over.set()
        self._finish()
        if self._thread.is_alive():
            self._thread.join(2.0 * _FINISH_S)

    def _finish(self) -> None:
        """Asks the process for the rest; it may be asked twice, by `close` and as it is started."""
        with suppress(NotListening):
            self._send(Finish())

    def learn(self, message: Learn) -> None:
        """Passes a reading on; it is dropped where there is no process."""
        with suppress(NotListening):
            self._send(message)

    def watch(self, tags: frozenset[str]) -> None:
        """Asks for the new samples of these loops, as they come; a process that is started later is asked too."""
        self._watched = tags
        with suppress(NotListening):
            self._send(Watch(tags))

    def ask(self, tag: str, from_s: float, to_s: float, points: int) -> HistoryAnswer:
        """Asks for rows of a loop. Raises NotListening."""
        answer: Future[HistoryAnswer] = Future()
        with self._guard:
            self._number += 1
            number = self._number
            self._asked[number] = answer
        try:
            self._send(Query(number, tag, from_s, to_s, points))
            return answer.result(ANSWER_S)
        except TimeoutError:
            raise NotListening(f"the listening process has not answered within {ANSWER_S:g} s") from None
        finally:
            with self._guard:
                self._asked.pop(number, None)

    def _send(self, message: object) -> None:
        if not self._writing.acquire(timeout=_WRITING_S):
            raise NotListening("the listening process takes no questions")
        try:
            if self._connection is None:
                raise NotListening("the listening process is being started")
            self._connection.send(message)
        except OSError:
            raise NotListening("the listening process has just died") from None
        finally:
            self._writing.release()

    def _run(self) -> None:
        pause_s = self._first_pause_s
        while not self._over.is_set():
            began = time.monotonic()
            try:
                why = self._live()
            except Exception as error:  # the service goes on without it
                why = f"{type(error).__name__}: {error}"
            if self._over.is_set():
                return
            pause_s = self._first_pause_s if time.monotonic() - began >= LONGEST_PAUSE_S else pause_s
            self._say(f"{why}; it is started again in {pause_s:g} s, the history has a gap")
            self._over.wait(pause_s)
            pause_s = min(2.0 * pause_s, LONGEST_PAUSE_S)
            if not self._over.is_set():
                LISTENER_RESTARTS.inc()

    def _say(self, text: str) -> None:
        now = time.monotonic()
        if self._said_at is None or now - self._said_at >= _SAY_AGAIN_S:
            self._said_at = now
            log.warning("%s", text)

    def _live(self) -> str:
        """Runs the process once. Returns how it ended."""
        ours, theirs = Pipe()
        command = [sys.executable, "-m", "loopwright.service.listening.child", str(theirs.fileno())]
        with ours:
            with theirs:
                # A group of its own: Ctrl-C in a terminal is for the service, and would meet the child as it imports.
                process = subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    pass_fds=[theirs.fileno()],
                    process_group=0,
                )
            self.pid = process.pid
            with suppress(ProcessLookupError):
                own = os.getpriority(os.PRIO_PROCESS, process.pid)
                os.setpriority(os.PRIO_PROCESS, process.pid, max(NICENESS, own))  # from its first import on
            try:
                ours.send(Listen(self._loops, self._nodes))
                self._connection = ours
                self.watch(self._watched)
                self._receive(ours)
            except (EOFError, OSError):
                pass
            except _Hangs:
                process.kill()
            finally:
                self._connection = None
                with self._guard:
                    for answer in self._asked.values():
                        answer.set_exception(NotListening("the listening process has just died"))
                    self._asked.clear()
                ours.close()
                try:
                    process.wait(_FINISH_S)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
                self._on_report(Report(dict.fromkeys(self._loops, "the listening process has died"), {}))
        return f"the listening process has ended (exit {process.returncode})"

    def _receive(self, connection: Connection[object, object]) -> None:
        """Receives messages until the process has reported the rest. Raises EOFError, OSError where it has died, and
        _Hangs."""
        give_up: float | None = None
        heard_at, patience_s = time.monotonic(), _STARTS_S
        while give_up is None or time.monotonic() < give_up:
            if give_up is None and self._over.is_set():
                give_up = time.monotonic() + _FINISH_S
                self._finish()
            if not connection.poll(_LOOK_S):
                if time.monotonic() - heard_at > patience_s:
                    raise _Hangs
                continue
            message, heard_at, patience_s = connection.recv(), time.monotonic(), _HANGS_S
            if isinstance(message, HistoryAnswer):
                with self._guard:
                    asked = self._asked.pop(message.number, None)
                if asked is not None:
                    asked.set_result(message)
            elif isinstance(message, NewSamples):
                self._on_samples(message)
            elif isinstance(message, Report):
                self._on_report(message)
                if message.finished:
                    return
