"""What durable jobs cost: per job and per stage on a file, and how many rehearsed loops a fleet on one PostgreSQL does.

    python -m benchmarks.engine

The fleet: 1, 2 and 4 gateway processes share 1,000 configured loops; a sample of them is retuned, by the whole
procedure on a plant in memory, and the jobs are counted per minute of wall time.
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx

from benchmarks.rehearsed import entry, open_loop
from service.config import LoopConfig, parse_site
from service.engine.durable import DurableEngine
from service.jobs import Jobs
from service.loop import Loop, LoopState
from service.processes import Process
from service.request import RetuneRequest
from service.running import Running
from service.states import ACTIVE
from service.store.store import Store
from service.work import Hooks, Outcome, rehearse
from tests.unit.service.postgres import Server, binaries
from tuning.plan import StageDone, StageStarted

LOOPS = 1000
GATEWAYS = (1, 2, 4)
SAMPLE = 48
STAGES = 500
NO_WORK = 60
SHORTEST_STAGE_S = 5.0
"""Preflight of a quick loop: half of a T95 of 10 s, in real time."""


def empty(config: LoopConfig, request: RetuneRequest, loop: Loop, state: LoopState, hooks: Hooks) -> Outcome:
    """A retune that does nothing: what is left is the engine and the store."""
    return Outcome({}, None, state, {})


def cost(folder: Path) -> dict[str, float]:
    """Wall time on SQLite. Per job: from asking to the written end, many at once. Per stage: its two events."""
    loops = parse_site({"loops": [entry(f"T-{n}", channel=n + 1) for n in range(NO_WORK)]}, "benchmark").loops
    store = Store(folder)
    jobs = Jobs(loops, store, open_loop, empty, rehearse, engine=DurableEngine(folder, None, "local", 0.1))
    jobs.boot()
    try:
        time.sleep(1.5)  # the engine has found its queues
        began = time.perf_counter()
        for tag in loops:
            jobs.start(tag, RetuneRequest())
        asked = time.perf_counter() - began
        while store.unfinished():
            time.sleep(0.01)
        done = time.perf_counter() - began
        running = Running(store.recent()[0].id, "T-0", jobs.journal)
        began = time.perf_counter()
        for _ in range(STAGES):
            running.on_event(StageStarted("relay", 1.0, 1.0))
            running.on_event(StageDone("relay", {"Ku": 1.0, "Pu_s": 1.0}))
        told = time.perf_counter() - began
        jobs.journal.flush()
        written = time.perf_counter() - began
    finally:
        jobs.stop()
        store.close()
    return {
        "job_ask_ms": 1e3 * asked / NO_WORK,
        "job_ms": 1e3 * done / NO_WORK,
        "stage_told_ms": 1e3 * told / STAGES,
        "stage_written_ms": 1e3 * written / STAGES,
        "stage_of_shortest_pct": 100 * written / STAGES / SHORTEST_STAGE_S,
    }


def fleet(folder: Path, gateways: int, database: str) -> float:
    """Jobs per minute with so many gateways."""
    with ExitStack() as stack:
        processes = []
        for n in range(gateways):
            name = f"gw{n}"
            home = folder / f"{gateways}-{name}"
            home.mkdir()
            arguments = ("benchmarks.rehearsed", str(home), name, str(LOOPS // gateways), "2", database)
            processes.append(Process(name, arguments, home / "log"))
            stack.callback(processes[-1].stop)
        urls = [process.wait_ready(120).split()[1] for process in processes]
        clients = [stack.enter_context(httpx.Client(base_url=url, timeout=60, trust_env=False)) for url in urls]
        tags = [f"gw{n % gateways}-{n // gateways}" for n in range(SAMPLE)]

        def retune(n: int) -> str:
            # Each asked at another gateway than the one that runs it, where there is another.
            answer = clients[(n + 1) % gateways].post(f"/loops/{tags[n]}/retune", json={"baseline": False})
            answer.raise_for_status()
            return str(answer.json()["url"])

        began = time.perf_counter()
        with ThreadPoolExecutor(4) as pool:
            waiting = list(pool.map(retune, range(SAMPLE)))
        while waiting:
            jobs = [clients[0].get(url).json() for url in waiting[:4]]
            over = [job for job in jobs if job["state"] not in tuple(ACTIVE)]
            if wrong := [job for job in over if job["state"] != "proposed"]:
                raise RuntimeError(f"{wrong[0]['state']}: {wrong[0]['detail']}")
            gone = {job["url"] for job in over}
            waiting = [url for url in waiting if url not in gone]
            if not over:
                time.sleep(0.1)
        return 60 * SAMPLE / (time.perf_counter() - began)


def run() -> dict[str, Any]:
    """Costs in ms, rates per minute."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        found: dict[str, Any] = {
            **cost(folder / "cost"),
            "loops": LOOPS,
            "sample": SAMPLE,
            "processors": os.cpu_count(),
        }
        where = binaries()
        if where is None:
            raise RuntimeError("the benchmark of a fleet needs the package postgresql")
        server = Server(where)
        try:
            found["jobs_per_min"] = {str(n): fleet(folder, n, server.database()) for n in GATEWAYS}
        finally:
            server.close()
    return found


if __name__ == "__main__":
    print(json.dumps(run(), indent=1))
