"""Dry runs in processes of their own: what they report, how they are stopped, and what they may take."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from loopwright.service.execution.computing.limits import ComputingLimits
from loopwright.service.execution.computing.pool import Pool
from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.procedures import Hooks, Outcome, rehearse
from loopwright.service.execution.rehearsals import rehearsed_in_pool
from loopwright.service.execution.runner import run
from loopwright.service.inputs.config import LoopConfig, parse_site
from loopwright.service.inputs.request import RetuneRequest, retune_request
from loopwright.service.states.job_state import JobState
from loopwright.tuning.plan import Event, Mode, Plan, Sample, StageStarted
from loopwright.tuning.reasons import Aborted, Failed, Reason
from tests.unit.service.fakes import TAG, FakeController, FakeLoop, Service, loop_entry
from tests.unit.service.processes import until

CONFIG = parse_site({"loops": [loop_entry()]}, "test").loops[TAG]
ASKED = retune_request(dry_run=True)


@pytest.fixture(scope="module")
def pool() -> Iterator[Pool]:
    with closing(Pool(ComputingLimits(dry_run_cpu_s=60, memory_mb=64), max_workers=1)) as pool:
        yield pool


def hungry(config: LoopConfig, request: RetuneRequest, hooks: Hooks) -> Outcome:
    """Takes more and more memory in the middle of its procedure."""
    kept = []

    def plan() -> Plan[None]:
        while True:
            kept.append(bytearray(1 << 20))
            yield ()

    ran = run(plan(), FakeLoop(FakeController()), limits=RunLimits())
    return Outcome(None, ran.ended, None, {})


def endless(config: LoopConfig, request: RetuneRequest, hooks: Hooks) -> Outcome:
    n = 0
    hooks.on_event(StageStarted("relay", 1.0, 1.0))
    while True:
        n += 1
        hooks.on_samples([Sample(float(n), 50.0, 50.0, 40.0, int(Mode.EXPERIMENT))])


class Told:
    """What a rehearsal has reported, in order."""

    def __init__(self) -> None:
        self.all: list[Event | Sample] = []
        self.reason: Reason | None = None
        self.hooks = Hooks(self.all.append, self.all.extend, lambda: self.reason)


def test_it_reports_and_ends_as_beside(pool: Pool) -> None:
    here, there = Told(), Told()
    assert rehearsed_in_pool(rehearse, pool)(CONFIG, ASKED, there.hooks) == rehearse(CONFIG, ASKED, here.hooks)
    assert there.all == here.all and len(there.all) > 1000


def test_it_is_stopped_in_the_middle(pool: Pool) -> None:
    told = Told()

    def hear(samples: list[Sample]) -> None:
        told.reason = Reason.OPERATOR

    outcome = rehearsed_in_pool(endless, pool)(CONFIG, ASKED, replace(told.hooks, on_samples=hear))
    assert isinstance(outcome.ended, Aborted) and outcome.ended.reason is Reason.OPERATOR
    assert told.all == [StageStarted("relay", 1.0, 1.0)]


def test_what_it_may_take_of_memory_is_named(pool: Pool) -> None:
    with pytest.raises(Failed, match="the dry run asked for more than 64 MB") as over:
        rehearsed_in_pool(hungry, pool)(CONFIG, ASKED, Told().hooks)
    assert over.value.reason is Reason.COMPUTATION_LIMIT


def test_a_job_is_aborted_while_it_computes_and_shows_how_far_it_is(tmp_path: Path, pool: Pool) -> None:
    service = Service(tmp_path)
    jobs = service.more_jobs(lambda config: FakeLoop(service.controller), rehearsed_in_pool(endless, pool))
    try:
        row = jobs.start(TAG, ASKED)
        until(lambda: service.store.samples(row.id))
        running = jobs.running(row.id)
        assert running is not None and running.progress.stage == "relay"
        jobs.abort(row.id, "me")
        until(lambda: JobState(service.store.get(row.id).state) is JobState.ABORTED)
    finally:
        jobs.stop()
        service.close()


def test_a_job_that_asks_for_too_much_fails_by_name(tmp_path: Path, pool: Pool) -> None:
    service = Service(tmp_path)
    jobs = service.more_jobs(lambda config: FakeLoop(service.controller), rehearsed_in_pool(hungry, pool))
    try:
        row = jobs.start(TAG, ASKED)
        until(lambda: JobState(service.store.get(row.id).state) is JobState.FAILED)
        assert service.store.get(row.id).reason == "computation_limit"
    finally:
        jobs.stop()
        service.close()


def test_the_end_of_the_pool_ends_it(tmp_path: Path) -> None:
    pool, told, found = Pool(max_workers=1), Told(), []
    thread = threading.Thread(target=lambda: found.append(rehearsed_in_pool(endless, pool)(CONFIG, ASKED, told.hooks)))
    thread.start()
    until(lambda: told.all)
    pool.close()
    thread.join()
    assert found[0].ended.reason is Reason.SERVICE_STOPPED
