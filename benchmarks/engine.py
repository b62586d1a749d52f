"""What durable jobs cost on a file: per job and per stage. The mathematics of a job is left out.

python -m benchmarks.engine
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from benchmarks.command import command
from benchmarks.rehearsed import entry, open_loop
from loopwright.service.execution.procedures import Hooks, Outcome, rehearse
from loopwright.service.inputs.config import LoopConfig, parse_site
from loopwright.service.inputs.request import FastRetune, RetuneRequest
from loopwright.service.jobs.active_job import Running
from loopwright.service.jobs.dbos_engine import DurableEngine
from loopwright.service.loops.loop import Loop
from loopwright.service.results import empty_result
from loopwright.service.server.assembly import make_jobs
from loopwright.service.states.loop_state import LoopState
from loopwright.service.store.store import Store
from loopwright.tuning.plan import StageDone, StageStarted

STAGES = 500
NO_WORK = 60
SHORTEST_STAGE_S = 5.0
"""Preflight of a quick loop: half of a T95 of 10 s, in real time."""


def empty(config: LoopConfig, request: RetuneRequest, loop: Loop, state: LoopState, hooks: Hooks) -> Outcome:
    """A retune that does nothing: what is left is the engine and the store."""
    return Outcome(empty_result("fast"), None, state, {})


def cost(folder: Path) -> dict[str, float]:
    """Wall time on SQLite. Per job: from asking to the written end, many at once. Per stage: its two events."""
    loops = parse_site({"loops": [entry(f"T-{n}", channel=n + 1) for n in range(NO_WORK)]}, "benchmark").loops
    store = Store(folder)
    jobs = make_jobs(loops, store, open_loop, empty, rehearse, engine=DurableEngine(folder, None, "local", 0.1))
    jobs.boot()
    try:
        time.sleep(1.5)  # the engine has found its queues
        began = time.perf_counter()
        for tag in loops:
            jobs.start(tag, FastRetune())
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


def run() -> dict[str, float]:
    """Costs in ms."""
    with tempfile.TemporaryDirectory() as temporary:
        return cost(Path(temporary))


if __name__ == "__main__":
    command(__doc__, run)
