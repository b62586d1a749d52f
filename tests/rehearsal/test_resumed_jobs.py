"""Jobs of the real procedure on a loop in memory, cut off in every stage by the end of their service, then resumed."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from benchmarks.rehearsed import entry, open_loop
from loopwright.service.execution.procedures import rehearse, tune
from loopwright.service.execution.rehearsal import RehearsedLoop
from loopwright.service.inputs.config import parse_site
from loopwright.service.inputs.request import retune_request
from loopwright.service.jobs.manager import Jobs
from loopwright.service.server.assembly import make_jobs
from loopwright.service.store.store import Store
from loopwright.tuning.experiments.preflight import SETTLE
from loopwright.tuning.fast.relay.procedure import FAST_STAGES
from loopwright.tuning.five_stage.procedure import STAGES
from loopwright.tuning.plan import Command, Sample
from tests.unit.service.fakes import ThreadEngine

TAG = "TIC-1"
LIVE = [stage for stage in STAGES if stage not in ("estimate", "optimise")]  # those that take samples
COMPUTED_WITHIN_S = 300.0
"""Wall time within which a job has computed what its next stage takes, s: seconds, and minutes beside other work."""


class Killed(BaseException):
    """The end of the process, as far as a job's thread can tell: nothing after it is run."""


class Mortal(RehearsedLoop):
    """A loop whose tuner dies at a sample of a stage; the controller goes back by itself, the plant settles."""

    def __init__(self, loop: RehearsedLoop, dies: Callable[[], bool]) -> None:
        self.__dict__ = loop.__dict__
        self._dies = dies

    def step(self, commands: Sequence[Command]) -> Sample:
        if self._dies():
            raise Killed
        return super().step(commands)


class MortalEngine(ThreadEngine):
    def launch(self, run: Callable[[str], None], queues: Any) -> None:
        def until_death(job_id: str) -> None:
            try:
                run(job_id)
            except Killed:
                self.dead.set()

        self.dead = threading.Event()
        super().launch(until_death, queues)


CUTS = [("five-stage", stage) for stage in LIVE] + [("fast", stage) for stage in ("preflight", "relay", "verify")]


@pytest.mark.parametrize(("method", "stage"), CUTS)
def test_a_job_cut_off_in_a_stage_ends_as_one_that_was_not(tmp_path: Path, method: str, stage: str) -> None:
    loops = parse_site({"loops": [entry(TAG)]}, "test").loops
    ran: list[str] = []

    def service(folder: Path, dies_in: str | None) -> tuple[Store, Jobs, MortalEngine]:
        store, engine = Store(folder), MortalEngine()
        samples = [0]

        def dies() -> bool:
            running = list(jobs.registry.running.values())
            samples[0] += bool(running and running[0].progress.stage == dies_in)
            return samples[0] > 20

        jobs = make_jobs(loops, store, lambda config: Mortal(open_loop(config), dies), tune, rehearse, engine=engine)
        jobs.boot()
        return store, jobs, engine

    def finish(store: Store, jobs: Jobs) -> Any:
        jobs.engine.join(COMPUTED_WITHIN_S)  # type: ignore[attr-defined]
        row = store.recent()[0]
        events = store.events(row.id)
        ran[:] = [event.data["stage"] for event in events if event.kind == "stage_started"]
        jobs.stop()
        store.close()
        return row

    store, jobs, _ = service(tmp_path / "whole", None)
    jobs.start(TAG, retune_request(method=method))
    whole = finish(store, jobs)
    assert whole.state == "proposed", whole.detail

    store, jobs, engine = service(tmp_path / "cut", stage)
    jobs.start(TAG, retune_request(method=method))
    assert engine.dead.wait(COMPUTED_WITHIN_S)
    assert jobs.journal.flush(10)
    jobs.stop_watching()
    store.close()
    store, jobs, _ = service(tmp_path / "cut", None)
    row = finish(store, jobs)
    assert (row.state, row.attempt) == ("proposed", 2), row.detail
    if method == "fast":  # its record is one: all of it begins anew
        stages, again = FAST_STAGES, FAST_STAGES[: FAST_STAGES.index(stage) + 1]
    else:  # preflight looks at the loop anew; of the others only the one cut off began twice
        stages, again = STAGES, ("preflight", stage)
    assert [ran.count(each) for each in stages] == [1 + (each in again) for each in stages]
    for gain in ("Kp", "Ti"):
        assert getattr(row.result.new_gains, gain) == pytest.approx(getattr(whole.result.new_gains, gain), rel=0.02)
    assert sorted(row.stage_times_s) == sorted([*whole.stage_times_s, SETTLE])
    assert row.restored["gains"]["Kp"] == pytest.approx(0.2) and row.restored["on_trial"] is False
