from __future__ import annotations

from pathlib import Path

import pytest

from service.progress import Progress
from service.request import RetuneRequest
from service.states import JobState
from service.store.store import Store
from service.work import rehearsal_spec, rehearse
from tests.unit.service.fakes import OLD, TAG, FakeLoop, Service
from tuning.plan import StageStarted
from tuning.reasons import Reason


def test_stopping_ends_the_jobs_and_waits_for_their_loops(service: Service) -> None:
    service.tune.hold.clear()
    row = service.jobs.start(TAG, RetuneRequest())
    service.tune.inside.wait(5)
    service.jobs.stop()
    row = service.store.get(row.id)
    assert (row.state, row.reason) == ("aborted", Reason.SERVICE_STOPPED.value)
    assert service.controller.state.gains == OLD and service.controller.open == 0


def test_what_a_dead_service_left_is_marked_at_the_next_start(tmp_path: Path) -> None:
    store = Store(tmp_path)
    queued, running = store.create("A", {}, "me", False), store.create("B", {}, "me", False)
    store.move(running.id, JobState.RUNNING)
    store.close()
    service = Service(tmp_path)
    for job in (queued, running):
        row = service.store.get(job.id)
        assert (row.state, row.reason) == ("interrupted", "service_stopped") and row.ended_at
    service.close()


def test_a_job_that_cannot_open_its_loop_fails_and_frees_it(service: Service) -> None:
    def no_bus(config: object) -> FakeLoop:
        raise OSError("no such device")

    jobs = service.more_jobs(no_bus)
    row = jobs.start(TAG, RetuneRequest())
    service.wait(row.id)
    jobs.stop()
    row = service.store.get(row.id)
    assert (row.state, row.reason) == ("failed", "internal")
    assert service.store.active(TAG) is None


def test_progress_never_falls_and_ends_below_one() -> None:
    progress = Progress()
    seen, now = [], 100.0
    for stage, expected, remaining, seconds in (("a", 10.0, 90.0, 20), ("b", 40.0, 60.0, 30), ("c", 10.0, 0.0, 100)):
        progress.stage_started(StageStarted(stage, expected, remaining))
        for _ in range(seconds):
            now += 1.0
            progress.at(now)
            seen.append(progress.fraction)
    assert seen == sorted(seen) and 0.9 < seen[-1] < 1.0
    assert progress.remaining_s == pytest.approx(1.0)


def test_a_dry_run_guesses_a_plant_that_fits_the_loop(service: Service) -> None:
    config = service.loops[TAG]
    spec = rehearsal_spec(config, RetuneRequest(dry_run=True))
    time_constant, dead_time = spec["den"][0], spec["dead_time_s"]
    assert dead_time + 3 * time_constant == pytest.approx(config.t95_s)
    assert spec["num"][0] * 10.0 == pytest.approx(config.sp_deviation)
    assert spec["mv_limits"] == [-50.0, 50.0]


def test_a_real_rehearsal_through_a_job(service: Service) -> None:
    jobs = service.more_jobs(lambda config: FakeLoop(service.controller), rehearse)
    row = jobs.start(TAG, RetuneRequest(dry_run=True))
    service.wait(row.id)
    jobs.stop()
    row = service.store.get(row.id)
    assert (row.state, row.reason) == ("proposed", None), row.detail
    assert row.result is not None
    assert row.result["gains"]["Kp"] > 0 and row.result["model"]["T_s"] > 0 and row.result["predicted"]["Ms"] < 2.1
