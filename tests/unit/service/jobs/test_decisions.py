"""Decisions that end in an error half way: what was written to the controller is neither forgotten nor denied."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.exc import OperationalError

from loopwright.service.errors import Conflict
from loopwright.service.inputs.request import FastRetune
from loopwright.service.states.job_state import IllegalMove, JobState
from loopwright.service.states.loop_state import LoopState
from loopwright.service.store import audit
from loopwright.service.store.backup import back_up, restore
from loopwright.service.store.database import FILE
from loopwright.tuning.gains import Gains
from loopwright.tuning.reasons import Failed, Reason
from tests.unit.service.fakes import NEW, OLD, TAG, FakeLoop, Service

Patch = pytest.MonkeyPatch
BY_HAND = Gains(0.9, 4.0)


def full(*_: Any, **__: Any) -> None:
    raise OperationalError("UPDATE", {}, Exception("database or disk is full"))


def proposed(service: Service) -> str:
    row = service.jobs.start(TAG, FastRetune())
    service.wait(row.id)
    assert service.store.get(row.id).state == "proposed"
    return row.id


def begun(service: Service, job_id: str) -> list[str]:
    return [event.data["decision"] for event in service.store.events(job_id) if event.kind == "decision_begun"]


def lost_in_the_read_back(service: Service, patch: Patch) -> type[Exception]:
    accept = FakeLoop.accept

    def lost(loop: FakeLoop, gains: Gains, instead_of: Gains) -> LoopState:
        accept(loop, gains, instead_of)
        raise Failed(Reason.NODE_LOST, "node 20h does not answer (controller_on_trial)")

    patch.setattr(FakeLoop, "accept", lost)
    return Failed


def disk_full_at_the_end(service: Service, patch: Patch) -> type[Exception]:
    patch.setattr(service.store, "move", full)
    return OperationalError


@pytest.fixture(params=[lost_in_the_read_back, disk_full_at_the_end])
def half_accepted(service: Service, request: pytest.FixtureRequest) -> str:
    """A proposal whose gains the controller has although its acceptance ended in an error."""
    half_way: Callable[[Service, Patch], type[Exception]] = request.param
    job_id = proposed(service)
    with pytest.MonkeyPatch.context() as patch:
        error = half_way(service, patch)
        with pytest.raises(error):
            service.jobs.decisions.accept(job_id, "me")
    assert (service.store.get(job_id).state, service.controller.state.gains) == ("proposed", NEW)
    return job_id


def holds(service: Service, gains: Gains) -> bool:
    state = service.controller.state
    return state.gains == gains and not state.on_trial


def test_a_second_click_finishes_the_first(service: Service, half_accepted: str) -> None:
    row = service.jobs.decisions.accept(half_accepted, "me")
    assert row.state == "accepted" and holds(service, NEW)
    assert row.restored is not None and row.restored["gains"]["Kp"] == NEW.Kp


def test_what_was_half_accepted_is_taken_back_on_the_controller(service: Service, half_accepted: str) -> None:
    row = service.jobs.decisions.rollback(half_accepted, "me")
    assert row.state == "rolled_back" and holds(service, OLD)
    last = audit.trail(service.store.engine, 1)[0]
    assert last.before is not None and last.after is not None
    assert (last.what, last.before["gains"]["Kp"], last.after["gains"]["Kp"]) == ("rollback", NEW.Kp, OLD.Kp)


def test_a_loop_that_is_not_reached_is_not_said_to_have_its_old_gains(service: Service, half_accepted: str) -> None:
    service.controller.absent = Reason.NODE_LOST
    with pytest.raises(Failed):
        service.jobs.decisions.rollback(half_accepted, "me")
    assert service.store.get(half_accepted).state == "proposed"


def test_gains_put_in_by_hand_after_a_half_acceptance_stay_and_the_job_can_be_declined(
    service: Service, half_accepted: str
) -> None:
    service.controller.by_hand(gains=BY_HAND)
    with pytest.raises(Conflict, match="the gains were changed"):
        service.jobs.decisions.accept(half_accepted, "me")
    assert service.store.get(half_accepted).state == "proposed"
    row = service.jobs.decisions.rollback(half_accepted, "me")
    assert row.state == "rolled_back" and holds(service, BY_HAND)
    assert row.restored is not None and row.restored["gains"]["Kp"] == BY_HAND.Kp
    assert row.detail is not None and "set by others, left as they are" in row.detail
    last = audit.trail(service.store.engine, 1)[0]
    assert last.before is not None and last.after is not None
    assert (last.what, last.before["gains"]["Kp"], last.after["gains"]["Kp"]) == ("rollback", BY_HAND.Kp, BY_HAND.Kp)


def test_gains_put_in_by_hand_after_an_acceptance_stay_and_it_is_not_taken_back(service: Service) -> None:
    job_id = proposed(service)
    service.jobs.decisions.accept(job_id, "me")
    service.controller.by_hand(gains=BY_HAND)
    with pytest.raises(Conflict, match="the gains were changed in between; retune instead"):
        service.jobs.decisions.rollback(job_id, "me")
    assert holds(service, BY_HAND) and service.store.get(job_id).state == "accepted"


def test_gains_that_come_in_while_an_acceptance_is_written_are_a_conflict(
    service: Service, client: TestClient, monkeypatch: Patch
) -> None:
    """Between our reading and the opening of the session: the loop itself refuses, and nothing is written."""
    job_id = proposed(service)
    accept = FakeLoop.accept

    def late(loop: FakeLoop, gains: Gains, instead_of: Gains) -> LoopState:
        service.controller.by_hand(gains=BY_HAND)
        return accept(loop, gains, instead_of)

    with monkeypatch.context() as patch:
        patch.setattr(FakeLoop, "accept", late)
        answer = client.post(f"/jobs/{job_id}/accept")
    assert answer.status_code == 409 and "the gains were changed meanwhile" in answer.json()["detail"]
    assert holds(service, BY_HAND) and service.store.get(job_id).state == "proposed"
    assert audit.trail(service.store.engine, 1)[0].what == "accept_failed"
    assert client.post(f"/jobs/{job_id}/accept").status_code == 409
    answer = client.post(f"/jobs/{job_id}/rollback")
    assert (answer.status_code, answer.json()["state"]) == (200, "rolled_back") and holds(service, BY_HAND)


def test_an_acceptance_that_wrote_nothing_is_rolled_back_without_writing(service: Service, monkeypatch: Patch) -> None:
    job_id = proposed(service)

    def lost(loop: FakeLoop, gains: Gains, instead_of: Gains) -> LoopState:
        raise Failed(Reason.NODE_LOST, "node 20h does not answer (controller_order_kp)")

    monkeypatch.setattr(FakeLoop, "accept", lost)
    with pytest.raises(Failed):
        service.jobs.decisions.accept(job_id, "me")
    assert service.jobs.decisions.rollback(job_id, "me").state == "rolled_back" and holds(service, OLD)
    assert begun(service, job_id) == ["accept"]


def test_a_half_rollback_is_finished_by_the_next(service: Service) -> None:
    job_id = proposed(service)
    service.jobs.decisions.accept(job_id, "me")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(service.store, "move", full)
        with pytest.raises(OperationalError):
            service.jobs.decisions.rollback(job_id, "me")
    assert holds(service, OLD) and service.store.get(job_id).state == "accepted"
    assert service.jobs.decisions.rollback(job_id, "me").state == "rolled_back"
    assert begun(service, job_id) == ["accept", "rollback"]


def test_a_decision_that_cannot_be_written_down_does_not_touch_the_loop(service: Service, monkeypatch: Patch) -> None:
    job_id = proposed(service)
    with monkeypatch.context() as patch:
        patch.setattr(service.store, "begin_decision", full)
        with pytest.raises(OperationalError):
            service.jobs.decisions.accept(job_id, "me")
    assert holds(service, OLD) and service.controller.open == 0
    service.controller.absent = Reason.NODE_LOST
    assert service.jobs.decisions.rollback(job_id, "me").state == "rolled_back"  # nothing was begun: no need of the bus


def test_a_conflict_begins_nothing(service: Service) -> None:
    job_id = proposed(service)
    service.controller.state = replace(service.controller.state, gains=BY_HAND)
    with pytest.raises(Conflict):
        service.jobs.decisions.accept(job_id, "me")
    assert begun(service, job_id) == []
    assert service.jobs.decisions.rollback(job_id, "me").state == "rolled_back" and holds(service, BY_HAND)


@pytest.fixture(params=["back-up restored", "started with --no-resume"])
def gone_back(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[tuple[Service, str]]:
    """A proposal that was accepted after the back-up was made from which the database comes: the controller has the
    proposed gains. The second way is that after pg_restore, or after a snapshot of the machine."""
    first = Service(tmp_path / "data")
    job_id = proposed(first)
    back_up(tmp_path / "data", tmp_path / "b.sqlite")
    first.jobs.decisions.accept(job_id, "me")
    first.close()
    if request.param == "back-up restored":
        restore(tmp_path / "b.sqlite", tmp_path / "data", replace=True)
        again = Service(tmp_path / "data")
    else:
        (tmp_path / "snapshot").mkdir()
        (tmp_path / "b.sqlite").rename(tmp_path / "snapshot" / FILE)
        again = Service(tmp_path / "snapshot", resume=False)
    again.controller.state = first.controller.state
    assert (again.store.get(job_id).state, again.controller.state.gains) == ("proposed", NEW)
    yield again, job_id
    again.close()


def test_a_proposal_of_a_restored_back_up_is_taken_back_on_the_controller(gone_back: tuple[Service, str]) -> None:
    service, job_id = gone_back
    row = service.jobs.decisions.rollback(job_id, "me")
    assert row.state == "rolled_back" and holds(service, OLD)
    assert row.restored is not None and row.restored["gains"]["Kp"] == OLD.Kp
    last = audit.trail(service.store.engine, 1)[0]
    assert last.before is not None and last.after is not None
    assert (last.before["gains"]["Kp"], last.after["gains"]["Kp"]) == (NEW.Kp, OLD.Kp)


def test_a_proposal_of_a_restored_back_up_can_be_accepted_again(gone_back: tuple[Service, str]) -> None:
    service, job_id = gone_back
    assert service.jobs.decisions.accept(job_id, "me").state == "accepted" and holds(service, NEW)


def test_a_proposal_of_a_restored_back_up_is_not_said_to_have_its_old_gains_unread(
    gone_back: tuple[Service, str],
) -> None:
    service, job_id = gone_back
    service.controller.absent = Reason.NODE_LOST
    with pytest.raises(Failed):
        service.jobs.decisions.rollback(job_id, "me")
    assert service.store.get(job_id).state == "proposed"


def test_other_gains_are_said_where_a_proposal_of_a_restored_back_up_is_declined(
    gone_back: tuple[Service, str],
) -> None:
    service, job_id = gone_back
    service.controller.by_hand(gains=BY_HAND)
    row = service.jobs.decisions.rollback(job_id, "me")
    assert row.state == "rolled_back" and holds(service, BY_HAND)
    assert row.detail is not None and "set by others, left as they are" in row.detail


def test_where_the_controller_has_the_old_gains_a_proposal_of_a_restored_back_up_is_declined_without_writing(
    gone_back: tuple[Service, str],
) -> None:
    service, job_id = gone_back
    service.controller.by_hand(gains=OLD)
    row = service.jobs.decisions.rollback(job_id, "me")
    assert row.state == "rolled_back" and holds(service, OLD) and begun(service, job_id) == ["unknown"]


def test_what_another_host_has_declined_meanwhile_is_not_written(service: Service, monkeypatch: Patch) -> None:
    job_id = proposed(service)
    read = FakeLoop.read

    def slow(loop: FakeLoop) -> LoopState:
        if service.store.get(job_id).state == "proposed":
            service.store.decline(job_id, "gateway B")
        return read(loop)

    monkeypatch.setattr(FakeLoop, "read", slow)
    with pytest.raises(IllegalMove):
        service.jobs.decisions.accept(job_id, "me")
    assert service.store.get(job_id).state == JobState.ROLLED_BACK and holds(service, OLD)
