"""What is measured beside the attacks: how late supervision is, how fast aborts are, what memory it takes."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx

from loopwright.protocol.station import HEARTBEAT_S
from loopwright.service.states.job_state import ACTIVE
from tests.hostile.site import Site

MACHINE_LATE_S = 0.01
"""A process that only sleeps and is woken later than that was held up by the machine."""
EXPECTED_ENDS = ("proposed", "refused")
"""Of a test that nobody has aborted: what the procedure itself says."""


@dataclass
class Found:
    """abort_s: until it was answered.  effect_s: until the loop's status on the bus said that its session is over.
    home_s: until the job was over, its loop read back as home.
    late_s: by which the service's heartbeat came later than it is due.  machine_late_s: by which a process that only
    sleeps was woken later than it had asked.  late_alone_s: late_s while that one was not late.
    ends: of the tests, by state, those that are not expected with the whole cause."""

    abort_s: list[float] = field(default_factory=list)
    effect_s: list[float] = field(default_factory=list)
    home_s: list[float] = field(default_factory=list)
    healthz_s: list[float] = field(default_factory=list)
    late_s: list[float] = field(default_factory=list)
    late_alone_s: list[float] = field(default_factory=list)
    machine_late_s: list[float] = field(default_factory=list)
    memory_MB: list[float] = field(default_factory=list)
    ends: dict[str, int] = field(default_factory=dict)
    refused: int = 0
    """Requests of the operator that were told to come again."""


def session_over(sessions: list[tuple[float, float]], at: float) -> float:
    """Seconds from a time until no session was open on the loop; 0 where none was open then."""
    after = [when for when, open_ in sessions if when >= at and not open_]
    open_then = next((open_ for when, open_ in reversed(sessions) if when < at), 0.0)
    return (after[0] if after else float("inf")) - at if open_then else 0.0


def late_alone(heartbeat: list[tuple[float, float]], machine: list[tuple[float, float]]) -> list[float]:
    """The lateness of the heartbeats between which the machine kept no sleeping process waiting. Both in order."""
    held_up = [(at - late_s, at) for at, late_s in machine if late_s > MACHINE_LATE_S]
    found, next_ = [], 0
    for at, late_s in heartbeat:
        before = at - late_s - HEARTBEAT_S
        while next_ < len(held_up) and held_up[next_][1] < before:
            next_ += 1
        if next_ == len(held_up) or held_up[next_][0] > at:
            found.append(late_s)
    return found


class Measuring:
    """A process that listens to the heartbeat, and two threads: who keeps tests running, and who aborts one again and
    again."""

    def __init__(self, site: Site, tests: int) -> None:
        self.found = Found()
        self._site, self._tests = site, site.tags[:tests]
        self._victim = site.tags[tests]
        self._over = threading.Event()
        self._counting = threading.Event()
        self._threads = [threading.Thread(target=run) for run in (self._keep_testing, self._abort)]
        self._jobs: dict[str, str] = {}
        self._listener = site.listener(self._victim)
        self._aborted_at: list[float] = []
        self._counts_from = float("inf")

    def __enter__(self) -> Measuring:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join()
        self._listener.stop()
        heard = self._site.heard()
        heartbeat, machine = (
            [(at, late_s) for at, late_s in heard[of] if at >= self._counts_from] for of in ("heartbeat", "machine")
        )
        self.found.effect_s = [session_over(heard["sessions"], at) for at in self._aborted_at]
        self.found.late_s, self.found.machine_late_s = ([late_s for _, late_s in of] for of in (heartbeat, machine))
        self.found.late_alone_s = late_alone(heartbeat, machine)

    def count(self) -> None:
        """What is found counts from now on: all tests are running."""
        give_up = time.monotonic() + 60.0
        while len(self._jobs) < len(self._tests) and time.monotonic() < give_up:
            time.sleep(0.1)
        self._counts_from = time.monotonic()
        self._counting.set()

    def note_memory(self) -> None:
        status = Path(f"/proc/{self._site.service.pid}/status").read_text().splitlines()
        self.found.memory_MB.append(next(int(line.split()[1]) for line in status if line.startswith("VmRSS:")) / 1024)

    def end_tests(self) -> None:
        for url in self._jobs.values():
            self._asked("POST", f"{url}/abort")
        give_up = time.monotonic() + 60.0
        while any(self._state(url)["state"] in tuple(ACTIVE) for url in self._jobs.values()):
            assert time.monotonic() < give_up
            time.sleep(0.2)

    def _asked(self, method: str, path: str, **more: Any) -> httpx.Response | None:
        """None: it is to be asked again."""
        try:
            answer = self._site.ask(method, path, **more)
        except httpx.TransportError:
            self.found.refused += 1
            return None
        if answer.status_code in (429, 503):
            self.found.refused += 1
            return None
        return answer

    def _state(self, url: str) -> dict[str, Any]:
        while (answer := self._asked("GET", url)) is None:
            time.sleep(0.2)
        found: dict[str, Any] = answer.json()
        return found

    def _note_end(self, job: dict[str, Any]) -> None:
        expected = job["state"] in EXPECTED_ENDS
        end = job["state"] if expected else f"{job['state']} {job['reason']} in {job['stage']}: {job['detail']}"
        self.found.ends[end] = self.found.ends.get(end, 0) + 1

    def _keep_testing(self) -> None:
        while not self._over.is_set():
            for tag in self._tests:
                url = self._jobs.get(tag)
                if url is not None:
                    job = self._state(url)
                    if job["state"] in tuple(ACTIVE):
                        continue
                    self._note_end(job)
                    if job["state"] == "proposed":
                        self._asked("POST", f"{url}/rollback")
                asked = {"by": "me", "method": "five-stage"}
                answer = self._asked("POST", f"/loops/{tag}/retune", json=asked)
                if answer is not None and answer.status_code == 202:
                    self._jobs[tag] = answer.headers["location"]
            self._over.wait(1.0)

    def _abort(self) -> None:
        while not self._over.is_set():
            answer = self._asked("POST", f"/loops/{self._victim}/retune", json={"by": "me"})
            if answer is None or answer.status_code != 202:
                self._over.wait(0.2)
                continue
            url = answer.headers["location"]
            while (job := self._state(url))["stage"] is None and job["state"] in tuple(ACTIVE):
                if self._over.is_set():
                    break
                time.sleep(0.1)
            if job["state"] not in tuple(ACTIVE):  # it came to its end before it had a stage
                self._note_end(job)
                continue
            began = time.monotonic()
            answer = self._asked("POST", f"{url}/abort")
            answered = time.monotonic() - began
            while self._state(url)["state"] in tuple(ACTIVE):
                time.sleep(0.02)
            if self._counting.is_set() and answer is not None and answer.status_code == 202:
                self.found.abort_s.append(answered)
                self.found.home_s.append(time.monotonic() - began)
                self._aborted_at.append(began)
            began = time.monotonic()
            if self._asked("GET", "/healthz") is not None and self._counting.is_set():
                self.found.healthz_s.append(time.monotonic() - began)
