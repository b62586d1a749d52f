"""A loop is watched after gains were accepted: what operation shows of the model, and when the previous gains come
back."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.exc import OperationalError

from loopwright.plantsim.catalogue import LaterPath
from loopwright.service.alarms.watch import AlarmWatch
from loopwright.service.inputs.request import FastRetune
from loopwright.service.listening.listening import Listening
from loopwright.service.states.acceptance_watch import TroubleKind, WatchEnd
from loopwright.service.states.job_state import JobState
from loopwright.service.store import audit, job_knowledge
from loopwright.service.store.jobs import Job
from loopwright.tuning.gains import Gains
from loopwright.tuning.operation.model_conclusion import ModelState
from loopwright.tuning.plan import Mode
from loopwright.tuning.reasons import Reason
from tests.unit.service.fakes import NEW, OLD, TAG, Service
from tests.unit.service.jobs.test_lost_answers import LosesAnswers
from tests.unit.service.jobs.watched import PU, TS, WatchedLoop

CHANGES = (1.0, -1.0, 1.5)
LATER = LaterPath(0.43, 4.0 * PU)


def unstable_from(periods: float) -> Callable[[int], float]:
    """The plant's gain grows beyond what the accepted gains bear, so many ultimate periods after the acceptance."""
    return lambda n: 1.0 if n < periods * PU / 0.1 else 3.5


def three_changes(here: WatchedLoop) -> None:
    for size in CHANGES:
        here.goes_on(13.0, size)


def alarms(client: TestClient, *kinds: str) -> list[dict[str, Any]]:
    """The alarms, when they are of these kinds; a look at what is abnormal serves all who ask for a quarter second."""
    found: list[dict[str, Any]] = []
    for _ in range(600):
        found = client.get("/alarms").json()
        if [each["kind"] for each in found] == list(kinds):
            break
        time.sleep(0.05)
    assert [each["kind"] for each in found] == list(kinds)
    return found


def test_a_model_is_confirmed_by_three_changes(service: Service, client: TestClient) -> None:
    here = WatchedLoop(service)
    here.accept()
    here.goes_on(2.0)
    assert here.watch.end is None and "Nothing has moved the loop yet" in here.watch.message
    three_changes(here)
    watch = here.watch
    assert (watch.conclusion().state, watch.conclusion().confirmed) == (ModelState.CONFIRMED, 3)
    assert watch.message == "The model is confirmed by 3 changes of normal operation."
    assert watch.end is WatchEnd.COMPLETE and service.controller.state.gains == NEW
    shown = client.get(f"/jobs/{here.job_id}").json()["monitoring"]
    assert (shown["verdict"], shown["confirmed"], shown["action"]) == ("confirmed", 3, None)
    assert client.get(f"/loops/{TAG}").json()["monitoring"] == shown
    alarms(client)


def test_a_second_path_that_the_record_could_not_show_is_found_and_rolled_back(
    service: Service, client: TestClient
) -> None:
    here = WatchedLoop(service, second_path=LATER)
    here.accept()
    three_changes(here)
    found = here.watch.conclusion()
    assert found.state is ModelState.MISMATCH and found.instead is not None
    assert abs(found.instead.size - 0.43) < 0.05 and abs(found.instead.delay_s - 4.0 * PU) < 0.3 * PU
    shown = client.get(f"/jobs/{here.job_id}").json()["monitoring"]
    assert (shown["verdict"], shown["instead"]["kind"], shown["action"]) == ("mismatch", "second_path", "rollback")
    assert "a second path acts" in shown["message"]
    (alarm,) = alarms(client, "model_mismatch")
    assert alarm["job"] == f"/jobs/{here.job_id}"
    assert "a second path acts" in alarm["text"] and "Roll the new gains back" in alarm["advice"]
    answer = client.post(f"/jobs/{here.job_id}/rollback", json={"by": "operator B"}).json()
    assert (answer["monitoring"]["end"], answer["monitoring"]["action"]) == ("rolled_back", None)
    assert service.controller.state.gains == OLD
    alarms(client)


def test_a_loop_that_becomes_unstable_gets_its_old_gains_back(service: Service, client: TestClient) -> None:
    here = WatchedLoop(service, factor=unstable_from(10.0))
    here.accept()
    here.goes_on(20.0, 1.0)
    trouble = here.watch.trouble
    assert trouble is not None and trouble.rolled_back is True
    assert trouble.kind is TroubleKind.GROWING_OSCILLATION and "PV oscillates under the new gains" in trouble.text
    assert service.controller.state.gains == OLD and here.watch.end is WatchEnd.ROLLED_BACK
    last = audit.trail(service.store.engine, 1)[0]
    assert (last.what, last.by, last.key) == ("rollback", "monitoring after acceptance", "service")
    (alarm,) = alarms(client, "rolled_back")
    assert alarm["unacknowledged"] and "put back automatically" in alarm["text"]
    client.post(f"/alarms/{alarm['id']}/acknowledge", json={"by": "operator B"})
    alarms(client)
    here.goes_on(3.0)
    assert service.store.get(here.job_id).state is JobState.ROLLED_BACK


@pytest.mark.parametrize("by_s", [-3600.0, -5.0, 3600.0, 40 * 86_400.0])
@pytest.mark.parametrize("restarted", [False, True])
def test_the_old_gains_come_back_whatever_the_clock_is_set_to(by_s: float, restarted: bool, service: Service) -> None:
    here = WatchedLoop(service, factor=unstable_from(10.0))
    job_knowledge.keep(service.store, here.job_id, TAG, b"")
    job_knowledge.outdated(service.store, here.job_id, datetime.now(UTC))  # its trial has shown another plant
    here.accept()
    here.goes_on(2.0)
    if restarted:
        here.watching = here.another()
    here.clock_is_set(by_s)
    here.goes_on(20.0, 1.0)
    trouble = here.watch.trouble
    assert trouble is not None and (trouble.kind, trouble.rolled_back) == (TroubleKind.GROWING_OSCILLATION, True)
    assert service.controller.state.gains == OLD and here.watch.end is WatchEnd.ROLLED_BACK


def test_a_clock_that_jumps_does_not_shorten_the_time_for_which_pv_is_outside(service: Service) -> None:
    here = _limited(service)
    here.plant.disturbance = 2.0
    while here.pv <= 50.5:
        here.steps(1)
    here.watching.look()
    here.clock_is_set(3600.0)
    here.steps(1)
    here.watching.look()
    assert here.watch.trouble is None
    here.clock_is_set(-3600.0)
    here.steps(30)
    here.watching.look()
    assert here.watch.trouble is not None and here.watch.trouble.rolled_back


def test_gains_that_were_read_before_the_acceptance_by_a_clock_that_was_ahead_are_not_of_others(
    service: Service,
) -> None:
    here = WatchedLoop(service)
    here.clock_is_set(600.0)
    here.steps(3)
    here.clock_is_set(-600.0)
    here.ears.gains_are_read = False
    here.accept()
    here.goes_on(2.0)
    assert here.watch.end is None


@pytest.mark.parametrize("set_after", [0.5, 0.0], ids=["before the step", "after it"])
def test_a_loop_that_leaves_automatic_as_the_clock_is_set_back_has_left_it(set_after: float, service: Service) -> None:
    here = WatchedLoop(service)
    here.accept()
    here.goes_on(2.5)
    service.controller.by_hand(mode=Mode.MANUAL)
    here.goes_on(set_after)  # half a period: the history is not looked at in it
    here.clock_is_set(-3600.0)
    here.goes_on(0.5 - set_after)
    service.controller.by_hand(mode=Mode.AUTOMATIC)
    here.goes_on(5.0)
    assert "the mode was changed at" in str(here.watch.auto_rollback_off) and not here.watch.armed


def test_changes_are_compared_once_whatever_the_clock_is_set_to(service: Service) -> None:
    here = WatchedLoop(service)
    here.accept()
    for count, size in enumerate(CHANGES, 1):
        here.goes_on(2.0)
        here.goes_on(13.0, size)
        here.steps(round(PU / TS))
        here.watching.look()
        here.clock_is_set(-60.0)
        here.watching.look()
        here.watching.compare()  # what was heard before the clock was set
        assert len(here.watch.changes) == here.watch.conclusion().confirmed == count
    here.goes_on(1.0)
    assert here.watch.end is WatchEnd.COMPLETE


def test_a_watch_ends_after_a_month_that_has_passed(service: Service) -> None:
    here = WatchedLoop(service)
    here.accept()
    here.goes_on(1.0)
    here.clock_is_set(40 * 86_400.0)
    for days in (0.0, 29.0):
        here.now_s, here.passed_s = here.now_s + 86_400.0 * days, here.passed_s + 86_400.0 * days
        here.goes_on(1.0)
        assert here.watch.end is None
    here.now_s, here.passed_s = here.now_s + 2 * 86_400.0, here.passed_s + 2 * 86_400.0
    here.goes_on(1.0)
    assert here.watch.end is WatchEnd.TOO_LONG


@pytest.mark.parametrize("by_s", [0.0, -3600.0])
def test_a_test_between_the_proposal_and_its_acceptance_is_no_next_retune(by_s: float, service: Service) -> None:
    here = WatchedLoop(service)
    service.wait(service.jobs.start(TAG, FastRetune()).id)
    here.accept()
    here.goes_on(1.0)
    here.clock_is_set(by_s)
    here.goes_on(2.0)
    assert here.watch.end is None
    service.wait(service.jobs.start(TAG, FastRetune()).id)
    here.goes_on(1.0)
    assert here.watch.end is WatchEnd.RETUNED


def test_pv_that_leaves_its_limits_is_a_reason_too(service: Service) -> None:
    limits = service.loops[TAG].pv_limits.model_copy(update={"high": 50.5})
    service.loops[TAG] = service.loops[TAG].model_copy(update={"pv_limits": limits})
    here = WatchedLoop(service)
    here.accept()
    here.goes_on(2.0)
    here.goes_on(3.0, 1.0)
    assert here.watch.trouble is None, "an operator has put the set-point there"
    here.goes_on(4.0, -0.7)
    here.plant.disturbance = 2.0
    here.goes_on(3.0)
    trouble = here.watch.trouble
    assert trouble is not None and trouble.kind is TroubleKind.PV_OUTSIDE_LIMITS
    assert trouble.text == "PV went above its limit of 50.5 degC under the new gains"
    assert trouble.rolled_back and service.controller.state.gains == OLD


def _limited(service: Service) -> WatchedLoop:
    """A loop with little room above its set-point, watched, with PV within its limits."""
    limits = service.loops[TAG].pv_limits.model_copy(update={"high": 50.5})
    service.loops[TAG] = service.loops[TAG].model_copy(update={"pv_limits": limits})
    here = WatchedLoop(service)
    here.accept()
    here.goes_on(2.0)
    return here


def test_a_service_that_is_started_while_pv_is_outside_knows_that_it_was_inside(service: Service) -> None:
    here = _limited(service)
    here.plant.disturbance = 2.0
    here.watching = here.another()
    here.goes_on(3.0)
    assert here.watch.trouble is not None and here.watch.trouble.rolled_back
    assert service.controller.state.gains == OLD


def test_pv_that_was_never_inside_does_not_leave_its_limits(service: Service) -> None:
    limits = service.loops[TAG].pv_limits.model_copy(update={"high": 49.5})
    service.loops[TAG] = service.loops[TAG].model_copy(update={"pv_limits": limits})
    here = WatchedLoop(service)
    here.accept()
    here.goes_on(3.0)
    assert here.watch.trouble is None and not here.watch.inside


@pytest.mark.parametrize("shown", ["last", 50.2, 25.0, 0.0, 100.0])
@pytest.mark.parametrize("roll_back", [True, False])
def test_a_false_pv_is_an_alarm_and_nothing_is_written(service: Service, shown: float | str, roll_back: bool) -> None:
    """Also one that is outside of the limits, where the previous gains would come back."""
    limits = service.loops[TAG].pv_limits.model_copy(update={"low": 40.0, "high": 60.0})
    service.loops[TAG] = service.loops[TAG].model_copy(update={"pv_limits": limits})
    here = WatchedLoop(service)
    here.accept(roll_back)
    here.goes_on(6.0)
    before, last = service.controller.state, here.pv
    here.shown = lambda pv: last if isinstance(shown, str) else shown
    here.goes_on(6.0)
    trouble = here.watch.trouble
    assert trouble is not None and (trouble.kind, trouble.rolled_back) == (TroubleKind.FALSE_PV, False)
    assert service.controller.state == before and service.controller.session == 0
    assert service.store.get(here.job_id).state is JobState.ACCEPTED
    assert "no reason to change gains" in here.watch.message
    (alarm,) = AlarmWatch(service.jobs, Listening(service.jobs.directory.loops, service.store, on=False)).look()
    assert (alarm.priority, alarm.kind) == (1, "false_pv") and alarm.text.startswith("PV is false. PV ")
    assert "it is in automatic on this PV unless you put it in manual" in alarm.advice


@pytest.mark.parametrize("count", [1, 2, 3])
def test_single_wrong_samples_are_no_false_pv(service: Service, count: int) -> None:
    here = WatchedLoop(service)
    here.accept()
    here.goes_on(6.0)
    wrong = iter([0.0] * count)
    here.shown = lambda pv: next(wrong, pv)
    here.goes_on(6.0)
    assert here.watch.trouble is None


@pytest.mark.parametrize("quantum", [0.03, 0.3, 1.0])
def test_a_pv_that_is_rounded_or_that_a_load_moves_is_true(service: Service, quantum: float) -> None:
    here = WatchedLoop(service)
    here.shown = lambda pv: round(pv / quantum) * quantum
    here.accept()
    here.goes_on(8.0)
    here.plant.disturbance = 3.0
    here.goes_on(8.0, 1.0)
    assert here.watch.trouble is None


@pytest.mark.parametrize("mode", [Mode.AUTOMATIC, Mode.MANUAL])
def test_where_frames_are_lost_the_mode_heard_last_counts_and_the_controller_is_read(
    mode: Mode, service: Service
) -> None:
    here = _limited(service)
    here.frames_lost = True
    here.plant.disturbance = 2.0
    here.goes_on(0.5)
    service.controller.by_hand(mode=mode)  # which nobody hears
    here.goes_on(3.0)
    trouble = here.watch.trouble
    assert trouble is not None and trouble.kind is TroubleKind.PV_OUTSIDE_LIMITS
    assert trouble.rolled_back == (mode is Mode.AUTOMATIC)
    assert service.controller.state.gains == (OLD if trouble.rolled_back else NEW)
    assert trouble.rolled_back or "the mode was changed" in str(trouble.reason) or "is in manual" in str(trouble.reason)


def _not_asked_for(here: WatchedLoop) -> None:
    pass


def _gains_by_hand(here: WatchedLoop) -> None:
    here.service.controller.by_hand(gains=Gains(0.74, 3.0))
    here.ears.gains_are_read = False  # the listener has not read the loop since


def _in_manual_meanwhile(here: WatchedLoop) -> None:
    here.service.controller.by_hand(mode=Mode.MANUAL)
    here.goes_on(1.0)
    here.service.controller.by_hand(mode=Mode.AUTOMATIC)


def _not_reached(here: WatchedLoop) -> None:
    here.service.controller.absent = Reason.NODE_LOST


def _locked(here: WatchedLoop) -> None:
    here.service.jobs.locking.lock(TAG, "valve is being overhauled", "night shift")


@pytest.mark.parametrize(
    ("meanwhile", "why"),
    [
        (_not_asked_for, "that was not asked for"),
        (_gains_by_hand, "set by others"),
        (_in_manual_meanwhile, "the mode was changed at"),
        (_not_reached, "node 32 does not answer"),
        (_locked, "night shift"),
    ],
)
def test_the_old_gains_are_not_put_back_where_that_is_in_doubt(
    service: Service, client: TestClient, meanwhile: Callable[[WatchedLoop], None], why: str
) -> None:
    here = WatchedLoop(service, factor=unstable_from(10.0))
    here.accept(auto_rollback=meanwhile is not _not_asked_for)
    here.goes_on(2.0)
    meanwhile(here)
    held = service.controller.state.gains
    here.goes_on(20.0, 1.0)
    trouble = here.watch.trouble
    assert trouble is not None and trouble.rolled_back is False
    assert trouble.reason is not None and why in trouble.reason
    assert service.controller.state.gains == held and service.store.get(here.job_id).state is JobState.ACCEPTED
    service.controller.absent = None
    alarm = client.get("/alarms").json()[0]
    assert (alarm["priority"], alarm["kind"]) == (1, "suspect_gains") and why in alarm["advice"]
    here.goes_on(5.0)
    assert here.watch.trouble == trouble, "it is tried once"


def test_the_watch_goes_on_when_the_service_is_started_again(service: Service) -> None:
    here = WatchedLoop(service, second_path=LATER)
    here.accept()
    here.goes_on(2.0)
    here.goes_on(13.0, 1.0)
    assert len(here.watch.changes) == 1
    here.watching = here.another()
    here.goes_on(13.0, -1.0)
    assert here.watch.conclusion().state is ModelState.MISMATCH, "the first change is still known"


def test_what_a_service_has_left_half_done_is_not_tried_again(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = WatchedLoop(service, factor=unstable_from(5.0))
    here.accept()

    def killed(job_id: str, by: str) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(service.jobs.decisions, "roll_back_accepted", killed)
    with pytest.raises(KeyboardInterrupt):
        here.goes_on(20.0, 1.0)
    monkeypatch.undo()
    here.watching = here.another()
    here.goes_on(1.0)
    trouble = here.watch.trouble
    assert trouble is not None and trouble.rolled_back is False
    assert "the service ended, or could not write it down" in str(trouble.reason)
    assert service.controller.state.gains == NEW


@pytest.mark.parametrize("kept", [True, False])
def test_what_is_known_of_a_rollback_whose_answer_is_lost(
    service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch, kept: bool
) -> None:
    """The previous gains are in effect; whether that was stored is told by the job."""
    here = WatchedLoop(service, factor=unstable_from(5.0))
    here.accept()
    answers, move = LosesAnswers(service.store, monkeypatch), service.store.move

    def moves(*asked: Any, **columns: Any) -> Job:
        answers.lose_next(kept)
        return move(*asked, **columns)

    monkeypatch.setattr(service.store, "move", moves)
    with pytest.raises(OperationalError):
        here.goes_on(20.0, 1.0)
    monkeypatch.undo()
    here.goes_on(1.0)
    trouble = here.watch.trouble
    assert service.controller.state.gains == OLD and answers.lost and trouble is not None
    assert (service.store.get(here.job_id).state, trouble.rolled_back) == ("rolled_back" if kept else "accepted", kept)
    alarms(client, "rolled_back" if kept else "suspect_gains")


def test_gains_that_somebody_else_has_set_end_the_watch(service: Service) -> None:
    here = WatchedLoop(service)
    here.accept()
    here.goes_on(2.0)
    service.controller.by_hand(gains=Gains(0.6, 3.0))
    here.goes_on(2.0)
    assert here.watch.end is WatchEnd.GAINS_CHANGED and service.controller.state.gains == Gains(0.6, 3.0)


def test_the_next_retune_ends_the_watch(service: Service) -> None:
    here = WatchedLoop(service)
    here.accept()
    here.goes_on(2.0)
    service.wait(service.jobs.start(TAG, FastRetune()).id)
    here.goes_on(1.0)
    assert here.watch.end is WatchEnd.RETUNED


def test_a_loop_that_is_not_heard_is_not_said_to_be_confirmed(service: Service, client: TestClient) -> None:
    here = WatchedLoop(service)
    here.accept()
    here.goes_on(2.0)
    here.heard_at_all = False
    three_changes(here)
    watch = here.watch
    assert (watch.conclusion().state, watch.end, watch.changes) == (ModelState.OPEN, None, ())
    assert "No data of the loop: no data of the loop" in watch.message
    assert client.get(f"/jobs/{here.job_id}").json()["monitoring"]["no_data"] == "no data of the loop"
    here.heard_at_all = True
    here.goes_on(2.0)
    assert here.watch.no_data is None
    here.goes_on(13.0, 1.0)
    assert here.watch.conclusion().confirmed == 1, "a change of the time in which nothing was heard does not count"


def test_accepting_asks(service: Service, client: TestClient) -> None:
    here = WatchedLoop(service)
    answer = client.post(f"/jobs/{here.job_id}/accept", json={"by": "A", "auto_rollback": False}).json()
    assert (answer["monitoring"]["auto_rollback"], answer["monitoring"]["active"]) == (False, True)
    client.post(f"/jobs/{here.job_id}/rollback", json={"by": "A"})
    again = WatchedLoop(service)
    assert client.post(f"/jobs/{again.job_id}/accept").json()["monitoring"]["auto_rollback"] is True, "the default"
