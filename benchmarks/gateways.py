"""How many rehearsed loops gateways on one PostgreSQL retune per minute.

    python -m benchmarks.gateways

1, 2 and 4 gateway processes share 1,000 configured loops; a sample of them is retuned, by the whole procedure on a
plant in memory, and the jobs are counted per minute of wall time: once with plants that take their time, as real ones
do, which shows what gateways add, and once without, which shows what the processors have room for.
"""

from __future__ import annotations

import os
import tempfile
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
from sqlalchemy import Engine, create_engine, text

from benchmarks.answers import family_s
from benchmarks.command import Missing, command
from loopwright.service.cli.child_process import ChildProcess
from loopwright.service.states.job_state import ACTIVE
from tests.unit.service.postgres import Server, binaries

LOOPS = 1000
GATEWAYS = (1, 2, 4)
PACE, AT_ONCE, PACED_JOBS = 60.0, 4, 16
"""A job of 4.5 s, so many of a gateway at once, so many of each gateway."""
QUIET_S, LOOK_S = 5.0, 0.05
"""How long the gateways are watched without jobs, and how often the sessions of the database are looked at."""
UNPACED_AT_ONCE, UNPACED_JOBS = 8, 48


class Watch:
    """Looks at the sessions of a database now and then: how many of them keep a transaction open and ask nothing."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._over = threading.Event()
        self.looks = 0
        self.idle: Counter[str] = Counter()
        """Sessions that were idle in a transaction, by the beginning of what they asked last."""
        self._thread = threading.Thread(target=self._look)
        self._thread.start()

    def _look(self) -> None:
        with self._engine.connect() as connection:
            while not self._over.wait(LOOK_S):
                self.looks += 1
                self.idle.update(row[0] for row in connection.execute(_IDLE))
                connection.rollback()

    def close(self) -> None:
        self._over.set()
        self._thread.join()


_IDLE = text(
    "SELECT /* of the benchmark */ left(query, 200) FROM pg_stat_activity WHERE datname = current_database()"
    " AND state LIKE 'idle in transaction%' AND now() - state_change > interval '10 ms'"
)
_STATEMENTS = text(
    "SELECT /* of the benchmark */ query, calls FROM pg_stat_statements JOIN pg_database ON pg_database.oid = dbid"
    " WHERE datname = current_database() AND query NOT LIKE '%of the benchmark%'"
)
_STATES = text("SELECT /* of the benchmark */ state, count(*) FROM jobs GROUP BY 1")
_FRAME = ("BEGIN", "COMMIT", "ROLLBACK")


def statements(engine: Engine) -> Counter[str]:
    """What the server has been asked so far, by statement; the beginnings and ends of transactions are none."""
    with engine.connect() as connection:
        rows = connection.execute(_STATEMENTS).all()
    return Counter({query: calls for query, calls in rows if not query.startswith(_FRAME)})


def fleet(folder: Path, gateways: int, server: Server, pace: float, at_once: int, jobs_each: int) -> dict[str, float]:
    """Jobs per minute with so many gateways, and the processor time of one. pace: of the plants; 0: no limit."""
    database, name = server.database(), f"{gateways}-{pace:g}"
    with ExitStack() as stack:
        processes = []
        for n in range(gateways):
            home = folder / f"{name}-gw{n}"
            home.mkdir()
            settings = (str(LOOPS // gateways), str(at_once), str(pace), database)
            module = ("benchmarks.rehearsed_gateway", str(home), f"gw{n}", *settings)
            processes.append(ChildProcess(name, module, home / "log"))
            stack.callback(processes[-1].stop)
        urls = [process.wait_ready(120).split()[1] for process in processes]
        clients = [stack.enter_context(httpx.Client(base_url=url, timeout=60, trust_env=False)) for url in urls]
        # Counted by SQL: who asks the gateways is a load on them.
        engine = create_engine(database.replace("postgresql:", "postgresql+psycopg:"))
        stack.callback(engine.dispose)
        with engine.begin() as connection:
            connection.execute(text("CREATE EXTENSION pg_stat_statements"))

        def retune(n: int) -> None:
            # Each asked at another gateway than the one that runs it, where there is another.
            at, loop = clients[(n + 1) % gateways], f"gw{n % gateways}-{n // gateways}"
            body = {"method": "five-stage", "baseline": False, "by": "benchmark"}
            at.post(f"/loops/{loop}/retune", json=body).raise_for_status()

        def used() -> float:
            chief = int((server.folder / "data" / "postmaster.pid").read_text().split()[0])
            return family_s(chief) + sum(family_s(process.pid) for process in processes)

        count = jobs_each * gateways
        for n in range(gateways):  # what is imported by the first job is no part of the others
            retune(n)
        _states(engine, gateways)
        time.sleep(QUIET_S / 2)
        alone = statements(engine)
        time.sleep(QUIET_S)
        began, before, asked_before = time.perf_counter(), used(), statements(engine)
        alone_per_s = (asked_before - alone).total() / QUIET_S
        watch = Watch(engine)
        stack.callback(watch.close)
        with ThreadPoolExecutor(4) as pool:
            list(pool.map(retune, range(gateways, gateways + count)))
        states = _states(engine, gateways + count)
        wall, after = time.perf_counter() - began, used()
        asked = statements(engine) - asked_before
        watch.close()
        if set(states) != {"proposed"}:
            raise RuntimeError(f"the jobs ended as {states}")
        return {
            "per_min": 60 * count / wall,
            "processor_s": (after - before) / count,
            "busy": (after - before) / wall,
            "statements": (asked.total() - alone_per_s * wall) / count,
            "statements_per_s_at_rest": alone_per_s,
            "idle_in_transaction": watch.idle.total() / max(watch.looks, 1),
        }


def _states(engine: Engine, jobs: int) -> dict[str, int]:
    """How many jobs there are in which state, once as many as that have ended."""
    while True:
        with engine.connect() as connection:
            found = {row[0]: int(row[1]) for row in connection.execute(_STATES)}
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
        server = Server(where, "shared_preload_libraries=pg_stat_statements")
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
