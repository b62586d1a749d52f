"""How many rehearsed loops gateways on one PostgreSQL retune per minute.

    python -m benchmarks.gateways

1, 2 and 4 gateway processes share 1,000 configured loops; a sample of them is retuned, by the whole procedure on a
plant in memory, and the jobs are counted per minute of wall time: once with plants that take their time, as real ones
do, which shows what gateways add, and once without, which shows what the processors have room for.
"""

from __future__ import annotations

import os
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
from sqlalchemy import Engine, create_engine, text

from benchmarks.answers import processor_s
from benchmarks.command import Missing, command
from loopwright.service.cli.child_process import ChildProcess
from loopwright.service.states.job_state import ACTIVE
from tests.unit.service.postgres import Server, binaries

LOOPS = 1000
GATEWAYS = (1, 2, 4)
PACE, AT_ONCE, PACED_JOBS = 60.0, 4, 16
"""A job of 4.5 s, so many of a gateway at once, so many of each gateway."""
UNPACED_AT_ONCE, UNPACED_JOBS = 8, 48


def of_server(server: Server) -> float:
    """Processor time of all processes of the database, s."""
    chief = int((server.folder / "data" / "postmaster.pid").read_text().split()[0])
    children = Path(f"/proc/{chief}/task/{chief}/children").read_text().split()
    return processor_s(chief) + sum(processor_s(int(child)) for child in children)


def fleet(folder: Path, gateways: int, server: Server, pace: float, at_once: int, jobs_each: int) -> dict[str, float]:
    """Jobs per minute with so many gateways, and the processor time of one. pace: of the plants; 0: no limit."""
    database, name = server.database(), f"{gateways}-{pace:g}"
    with ExitStack() as stack:
        processes = []
        for n in range(gateways):
            home = folder / f"{name}-gw{n}"
            home.mkdir()
            settings = (str(LOOPS // gateways), str(at_once), str(pace), database)
            processes.append(ChildProcess(name, ("benchmarks.rehearsed", str(home), f"gw{n}", *settings), home / "log"))
            stack.callback(processes[-1].stop)
        urls = [process.wait_ready(120).split()[1] for process in processes]
        clients = [stack.enter_context(httpx.Client(base_url=url, timeout=60, trust_env=False)) for url in urls]
        # Counted by SQL: who asks the gateways is a load on them.
        engine = create_engine(database.replace("postgresql:", "postgresql+psycopg:"))
        stack.callback(engine.dispose)

        def retune(n: int) -> None:
            # Each asked at another gateway than the one that runs it, where there is another.
            at, loop = clients[(n + 1) % gateways], f"gw{n % gateways}-{n // gateways}"
            asked = {"method": "five-stage", "baseline": False, "requested_by": "benchmark"}
            at.post(f"/loops/{loop}/retune", json=asked).raise_for_status()

        def used() -> float:
            return of_server(server) + sum(processor_s(process.pid) for process in processes)

        count = jobs_each * gateways
        for n in range(gateways):  # what is imported by the first job is no part of the others
            retune(n)
        states = _states(engine, gateways)
        began, before = time.perf_counter(), used()
        with ThreadPoolExecutor(4) as pool:
            list(pool.map(retune, range(gateways, gateways + count)))
        states = _states(engine, gateways + count)
        wall, after = time.perf_counter() - began, used()
        if set(states) != {"proposed"}:
            raise RuntimeError(f"the jobs ended as {states}")
        return {"per_min": 60 * count / wall, "processor_s": (after - before) / count, "busy": (after - before) / wall}


def _states(engine: Engine, jobs: int) -> dict[str, int]:
    """How many jobs there are in which state, once as many as that have ended."""
    while True:
        with engine.connect() as connection:
            found = {
                row[0]: int(row[1]) for row in connection.execute(text("SELECT state, count(*) FROM jobs GROUP BY 1"))
            }
        if not found.keys() & {str(state.value) for state in ACTIVE} and sum(found.values()) == jobs:
            return found
        time.sleep(0.1)


def run() -> dict[str, Any]:
    """Rates per minute. Raises Missing."""
    where = binaries()
    if where is None:
        raise Missing("the benchmark of gateways needs a PostgreSQL server: apt-get install postgresql")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        server = Server(where)
        try:
            paced = {str(n): fleet(folder, n, server, PACE, AT_ONCE, PACED_JOBS) for n in GATEWAYS}
            unpaced = {str(n): fleet(folder, n, server, 0.0, UNPACED_AT_ONCE, UNPACED_JOBS // n) for n in GATEWAYS}
        finally:
            server.close()
    return {
        "loops": LOOPS,
        "pace": PACE,
        "at_once": AT_ONCE,
        "unpaced_at_once": UNPACED_AT_ONCE,
        "processors": os.cpu_count(),
        "paced": paced,
        "unpaced": unpaced,
    }


if __name__ == "__main__":
    command(__doc__, run)
