"""How fast the service answers while it retunes, and what memory a loop under test takes: on SQLite, without a bus.

    python -m benchmarks.answers

The service is a process with plants in memory that run in real time; whoever asks is another process.
"""

from __future__ import annotations

import http.client
import os
import sys
import tempfile
import threading
import time
from pathlib import Path
from statistics import median
from typing import Any
from urllib.parse import urlsplit

import httpx

from benchmarks.command import command
from loopwright.service.cli.child_process import ChildProcess

LOOPS = (1, 10, 50)
RATE_PER_S, ASK_S, CONNECTIONS = 100, 10.0, 16
ROUNDS = 3
SETTLE_S = 5.0


def memory_MB(pid: int) -> float:
    """What a process and its children have for themselves, and their share of what they have with others."""
    family = [pid, *(int(each.name) for each in Path("/proc").glob("[0-9]*") if _parent(each) == pid)]
    return sum(_own_MB(each) for each in family)


def _own_MB(pid: int) -> float:
    rollup = Path(f"/proc/{pid}/smaps_rollup").read_text()
    return next(int(line.split()[1]) for line in rollup.splitlines() if line.startswith("Pss:")) * 1024 / 1e6


def _parent(process: Path) -> int | None:
    try:
        return int((process / "stat").read_text().rpartition(")")[2].split()[1])
    except (FileNotFoundError, ProcessLookupError):
        return None


def processor_s(pid: int) -> float:
    """Of a process and of its children that have ended."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


def family_s(pid: int) -> float:
    """Of a process and of all below it, those that have ended included."""
    try:
        threads = [each.read_text() for each in Path(f"/proc/{pid}/task").glob("*/children")]
        return processor_s(pid) + sum(family_s(int(child)) for child in " ".join(threads).split())
    except (FileNotFoundError, ProcessLookupError):  # it has just ended, and its parent counts it
        return 0.0


def answered_ms(url: str, paths: list[str], rate_per_s: float = RATE_PER_S) -> list[float]:
    """Waiting times for GETs sent by the clock, ms, sorted: from when each was due, so that a slow answer is not
    excused by the requests it kept from being sent."""
    place = urlsplit(url)
    number = round(ASK_S * rate_per_s)
    began, found = time.perf_counter() + 0.2, list[float]()

    def ask(first: int) -> None:
        connection = http.client.HTTPConnection(str(place.hostname), place.port, timeout=30)
        for n in range(first, number, CONNECTIONS):
            due = began + n / rate_per_s
            time.sleep(max(0.0, due - time.perf_counter()))
            connection.request("GET", paths[n % len(paths)])
            answer = connection.getresponse()
            answer.read()
            if answer.status != 200:
                raise RuntimeError(f"{paths[n % len(paths)]}: {answer.status}")
            found.append(1e3 * (time.perf_counter() - due))
        connection.close()

    threads = [threading.Thread(target=ask, args=(first,)) for first in range(CONNECTIONS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if len(found) != number:
        raise RuntimeError("not every request was answered")
    return sorted(found)


class Gateway:
    def __init__(self, folder: Path) -> None:
        arguments = ("benchmarks.rehearsed_gateway", str(folder), "local", str(max(LOOPS)), str(max(LOOPS)), "1", "")
        self.process = ChildProcess("service", arguments, folder / "log")

    def __enter__(self) -> Gateway:
        self.url = self.process.wait_ready().split()[1]
        self.http = httpx.Client(base_url=self.url, timeout=60.0, trust_env=False)
        return self

    def __exit__(self, *_: object) -> None:
        self.http.close()
        self.process.stop()

    def retune(self, loops: range) -> list[str]:
        """Their URLs, once all are under test."""
        asked = {"method": "five-stage", "by": "benchmark"}  # the longer one
        posts = [self.http.post(f"/loops/local-{n}/retune", json=asked).raise_for_status() for n in loops]
        urls = [str(post.headers["location"]) for post in posts]
        self._until(urls, lambda job: job["stage"] is not None)
        time.sleep(SETTLE_S)
        return urls

    def abort(self, urls: list[str]) -> float:
        """How long it takes until the last of them is restored, s."""
        began = time.monotonic()
        for url in urls:
            self.http.post(f"{url}/abort", json={}).raise_for_status()
        self._until(urls, lambda job: job["state"] == "aborted")
        return time.monotonic() - began

    def _until(self, urls: list[str], wanted: Any) -> None:
        give_up = time.monotonic() + 60.0
        for url in urls:
            while not wanted(self.http.get(url).json()):
                if time.monotonic() > give_up:
                    raise RuntimeError(f"{url} takes too long")
                time.sleep(0.1)


def run() -> dict[str, Any]:
    """Rounds take turns, for the machine may be busy with something else in one of them."""
    with tempfile.TemporaryDirectory() as temporary, Gateway(Path(temporary)) as gateway:
        memory, urls, begun = {}, list[str](), 0
        for loops in LOOPS:
            urls += gateway.retune(range(begun, loops))
            begun = loops
            memory[str(loops)] = memory_MB(gateway.process.pid)
        aborts, idle, busy = [gateway.abort(urls)], list[list[float]](), list[list[float]]()
        for _ in range(ROUNDS):
            idle.append(answered_ms(gateway.url, urls))
            urls = gateway.retune(range(max(LOOPS)))
            busy.append(answered_ms(gateway.url, urls))
            running = [gateway.http.get(url).json()["state"] for url in urls]
            if running != ["running"] * max(LOOPS):
                raise RuntimeError(f"not all jobs ran to the end of the round: {sorted(set(running))}")
            aborts.append(gateway.abort(urls))
            print(f"  p95 {p95(idle[-1]):.1f} ms idle, {p95(busy[-1]):.1f} ms busy", file=sys.stderr, flush=True)
    ratios = [p95(after) / p95(before) for before, after in zip(idle, busy, strict=True)]
    return {
        "loops": max(LOOPS),
        "rate_per_s": RATE_PER_S,
        "rounds": ROUNDS,
        "idle_p95_ms": median(map(p95, idle)),
        "busy_p95_ms": median(map(p95, busy)),
        "idle_median_ms": median(map(median, idle)),
        "busy_median_ms": median(map(median, busy)),
        "ratio": median(ratios),
        "ratio_range": [min(ratios), max(ratios)],
        "abort_all_s": median(aborts),
        "memory_MB": memory,
        "MB_per_loop": (memory[str(LOOPS[-1])] - memory[str(LOOPS[0])]) / (LOOPS[-1] - LOOPS[0]),
    }


def p95(times: list[float]) -> float:
    return times[int(0.95 * len(times))]


if __name__ == "__main__":
    command(__doc__, run)
