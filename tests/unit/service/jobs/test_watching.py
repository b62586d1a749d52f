"""A loop is watched after gains were accepted: what operation shows of the model, and when the old gains come back."""

from __future__ import annotations

from loopwright.plantsim.catalogue import SecondPath
from loopwright.service.states.acceptance_watch import WatchEnd
from loopwright.service.store import audit
from loopwright.tuning.operation.accepted_verdict import ModelVerdict
from tests.unit.service.fakes import NEW, OLD, Service
from tests.unit.service.jobs.watched import PU, WatchedLoop

CHANGES = (1.0, -1.0, 1.5)


def test_a_model_is_confirmed_by_three_changes(service: Service) -> None:
    here = WatchedLoop(service)
    here.accept()
    here.goes_on(2.0)
    assert here.watch.end is None and "Nothing has moved the loop yet" in here.watch.words
    for size in CHANGES:
        here.goes_on(13.0, size)
    watch = here.watch
    assert (watch.judgement().verdict, watch.judgement().confirmed) == (ModelVerdict.CONFIRMED, 3)
    assert watch.words == "The model is confirmed by 3 changes of normal operation."
    assert watch.end is WatchEnd.COMPLETE and service.controller.state.gains == NEW


def test_a_second_path_that_the_record_could_not_show_is_found_and_rolled_back(service: Service) -> None:
    here = WatchedLoop(service, second_path=SecondPath(0.43, 4.0 * PU))
    here.accept()
    for size in CHANGES:
        here.goes_on(13.0, size)
    found = here.watch.judgement()
    assert found.verdict is ModelVerdict.MISMATCH and found.instead is not None
    assert abs(found.instead.size - 0.43) < 0.05 and abs(found.instead.delay_s - 4.0 * PU) < 0.3 * PU
    assert "a second path acts" in here.watch.words
    service.jobs.decisions.rollback(here.job_id, "operator A")
    assert here.watch.end is WatchEnd.ROLLED_BACK and service.controller.state.gains == OLD


def test_a_loop_that_becomes_unstable_gets_its_old_gains_back(service: Service) -> None:
    here = WatchedLoop(service, factor=lambda n: 1.0 if n < 300 else 3.3)
    here.accept()
    here.goes_on(20.0, 1.0)
    here.goes_on(20.0, -1.0)
    trouble = here.watch.trouble
    assert trouble is not None and trouble.put_back is True, here.watch
    assert service.controller.state.gains == OLD
    assert here.watch.end is WatchEnd.ROLLED_BACK
    last = audit.trail(service.store.engine, 1)[0]
    assert (last.what, last.said_by) == ("rollback", "watch after acceptance")
