"""What operation has shown of a loop as a job begins: asked for once, kept with the job, dropped where a trial has
shown another plant."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from loopwright.service.inputs.request import retune_request
from loopwright.service.jobs.operation import OperationKnowledge, outdated_by
from loopwright.service.listening.rings import Rings
from loopwright.service.store import job_knowledge, knowledge
from loopwright.service.store.jobs import Job, JobEvent
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.fast.known_plant.plant import NothingKnown, ObservedPlant
from loopwright.tuning.reasons import Failed, Reason
from tests.unit.service.fakes import TAG, Service
from tests.unit.service.jobs.test_history_observer import MOVES, PoolInThisProcess
from tests.unit.service.observing.operated import HeardBefore, Operated

LOOP = Operated()
SPEC = DesignSpec(1.6)


def no_stop() -> bool:
    return False


class Heard:
    """A loop that was heard, and a finished job on it."""

    def __init__(self, service: Service, moves: dict[int, float] = MOVES) -> None:
        self.service, self.now_s, self.pool = service, time.time() + 10.0, PoolInThisProcess()
        service.controller.state = replace(service.controller.state, gains=LOOP.gains, sample_time_s=LOOP.Ts)
        jobs = service.jobs
        self.operation = OperationKnowledge(service.store, jobs.directory, jobs.knowledge, lambda: self.now_s)
        self.rings = LOOP.heard(moves, 3800, self.now_s)
        self.operation.connect(HeardBefore(self.rings), self.pool)  # type: ignore[arg-type]
        self.job = self.new_job()

    def new_job(self) -> Job:
        started = self.service.jobs.start(TAG, retune_request())
        self.service.wait(started.id)
        return self.service.store.get(started.id)

    def known(self, job: Job | None = None, unwanted: Callable[[], bool] = no_stop) -> ObservedPlant | NothingKnown:
        return self.operation.known(job or self.job, self.service.loops[TAG], SPEC, unwanted)


def trial(outdated: str | None) -> JobEvent:
    data: dict[str, Any] = {"stage": "trial", "result": {"outdated": outdated}, "stage_time_s": 5.0}
    return JobEvent(job_id="1", seq=1, at="2026-01-31T12:00:00.000Z", plant_time_s=5.0, kind="stage_done", data=data)


def test_it_is_asked_for_once_and_a_resumed_job_begins_with_the_same(service: Service) -> None:
    here = Heard(service)
    first = here.known()
    assert isinstance(first, ObservedPlant), first
    assert first.gains == LOOP.gains and first.together == 1 and len(first.record.lengths) == 4
    assert first.age_s == pytest.approx(100.0, abs=1.0)
    assert first.source.startswith("3 set-point changes of normal operation")
    assert first.pv[0] < 50.2 and first.pv[1] > 51.0
    assert [each.finding.changes for each in knowledge.read(service.store, TAG)] == [3]
    here.operation.connect(HeardBefore(Rings()), here.pool)  # type: ignore[arg-type]
    again = here.known()
    assert isinstance(again, ObservedPlant) and again.source == first.source
    assert again.record.y.tolist() == first.record.y.tolist() and len(here.pool.kinds) == 1
    assert isinstance(here.known(here.new_job()), NothingKnown), "another job asks anew"


def test_what_a_job_did_not_know_it_does_not_know_when_it_is_resumed(service: Service) -> None:
    here = Heard(service, {})
    first = here.known()
    assert isinstance(first, NothingKnown) and "no set-point change has been heard" in first.why
    here.operation.connect(HeardBefore(LOOP.heard(MOVES, 3800, here.now_s)), here.pool)  # type: ignore[arg-type]
    assert here.known() == first


def test_a_look_that_fails_leaves_the_job_to_the_other_excitations(service: Service) -> None:
    here = Heard(service)

    def fails() -> None:
        raise Failed(Reason.COMPUTATION_LIMIT, "the tuning was ended after 60 s of processor time")

    here.pool.meanwhile = fails
    found = here.known()
    assert isinstance(found, NothingKnown) and "60 s of processor time" in found.why


def test_a_job_that_is_stopped_meanwhile_waits_for_nothing(service: Service) -> None:
    here = Heard(service)
    assert here.known(unwanted=lambda: True) == NothingKnown("the job was stopped")


def test_a_service_that_does_not_listen_knows_nothing(service: Service) -> None:
    job = Heard(service).job
    found = service.jobs.operation.known(job, service.loops[TAG], SPEC, no_stop)
    assert found == NothingKnown("the service does not listen to its loops")


def test_what_a_trial_has_disproved_is_dropped_and_its_history_not_used_again(service: Service) -> None:
    here = Heard(service)
    assert isinstance(here.known(), ObservedPlant)
    why = "the step shows another plant than operation did: the gain would be 2 +- 0.1 times that of operation"
    here.operation.outdated(here.job, [trial(why)])
    found = knowledge.read(service.store, TAG)
    assert [each.superseded for each in found] == [f"job {here.job.id} has tried gains from operation, and {why}"]
    assert job_knowledge.outdated_until_s(service.store, TAG) == pytest.approx(here.now_s, abs=0.01)
    assert job_knowledge.outdated_until_s(service.store, "FIC-2") is None
    assert isinstance(here.known(here.new_job()), NothingKnown)
    # what is heard of the plant from then on counts again
    here.now_s += 400.0
    here.operation.connect(HeardBefore(LOOP.heard(MOVES, 3800, here.now_s)), here.pool)  # type: ignore[arg-type]
    assert isinstance(here.known(here.new_job()), ObservedPlant)


def test_a_trial_that_confirms_drops_nothing(service: Service) -> None:
    here = Heard(service)
    here.known()
    for events in ([], [trial(None)], [trial("another plant"), trial(None)]):
        assert outdated_by(events) is None
        here.operation.outdated(here.job, events)
    assert [each.superseded for each in knowledge.read(service.store, TAG)] == [None]
    assert job_knowledge.outdated_until_s(service.store, TAG) is None
