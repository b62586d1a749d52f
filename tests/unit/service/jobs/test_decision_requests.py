"""Decisions about a loop of another gateway: carried out there once, and never after somebody was told that they were
not."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy.exc import OperationalError

from loopwright.service.errors import Conflict, GatewayLost, Locked, NotKnown, Stopping
from loopwright.service.jobs.forwarded_decisions import answer_to, raise_of
from loopwright.service.jobs.machine import Machine
from loopwright.service.jobs.registry import Registry
from loopwright.service.jobs.requested_decisions import RequestedDecisions
from loopwright.service.security.keys import Scope
from loopwright.service.security.principal import Principal, current
from loopwright.service.states.job_state import IllegalMove, JobState
from loopwright.service.store import audit, decision_requests, idempotency_effects
from loopwright.service.store.decision_requests import AnswerKind, DecisionRequest, RequestAnswer, RequestState, What
from loopwright.service.store.idempotency import IdempotencyKeys
from loopwright.service.store.store import Busy
from loopwright.tuning.gains import Gains
from loopwright.tuning.reasons import Failed, Reason, Refused
from tests.unit.service.api.test_api import assert_problem
from tests.unit.service.fakes import NEW, OLD, FakeLoop, held_acceptances
from tests.unit.service.postgres import Server
from tests.unit.service.processes import until
from tests.unit.service.two_gateways import HERE, TAG_THERE, THERE, TwoGateways, two_gateways


@pytest.fixture
def fleet(tmp_path: Path, postgres: Server) -> Iterator[TwoGateways]:
    with two_gateways(tmp_path, postgres.database()) as found:
        yield found


EXPIRES_S = decision_requests.EXPIRES_S


@pytest.fixture(autouse=True)
def no_hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine nothing expires by itself."""
    monkeypatch.setattr(decision_requests, "EXPIRES_S", 1000.0)


@pytest.fixture
def writes(monkeypatch: pytest.MonkeyPatch) -> list[Gains]:
    """Every write of gains to a controller."""
    accept, found = FakeLoop.accept, []

    def noted(loop: FakeLoop, gains: Gains, instead_of: Gains) -> Any:
        found.append(gains)
        return accept(loop, gains, instead_of)

    monkeypatch.setattr(FakeLoop, "accept", noted)
    return found


def test_accepted_and_rolled_back_at_another_gateway(fleet: TwoGateways, writes: list[Gains]) -> None:
    job = fleet.there.proposed()
    answer = fleet.here.decide(job, "accept")
    assert answer.status_code == 200, answer.text
    view = answer.json()
    assert (view["state"], view["decided"]["by"], view["decision_request"]) == ("accepted", "A. Lind", None)
    assert fleet.there.controller.state.gains == NEW
    answer = fleet.here.decide(job, "rollback")
    assert (answer.status_code, answer.json()["state"]) == (200, "rolled_back")
    assert fleet.there.controller.state.gains == OLD and writes == [NEW, OLD]
    assert fleet.here.requests() == [("accept", "done"), ("rollback", "done")]


def test_the_audit_log_says_who_has_asked_and_at_which_gateway(fleet: TwoGateways) -> None:
    job = fleet.there.proposed()
    token = current.set(Principal("control room", Scope.OPERATE, "0f3ac2d9be11", "10.0.0.7", gateway=HERE))
    try:
        fleet.here.jobs.decisions.accept(job, "A. Lind")
    finally:
        current.reset(token)
    row = next(row for row in audit.trail(fleet.there.store.engine, 10) if row.what == "accept")
    assert (row.key, row.key_id, row.address, row.gateway) == ("control room", "0f3ac2d9be11", "10.0.0.7", HERE)
    assert (row.by, row.loop) == ("A. Lind", TAG_THERE)
    fleet.there.decide(job, "rollback")  # at home, over HTTP
    entries = fleet.here.http.get("/audit", params={"what": "rollback"}).json()
    assert [(each["by"], each["gateway"]) for each in entries] == [("A. Lind", THERE)]
    decisions = fleet.here.http.get("/decisions", params={"loop": TAG_THERE}).json()
    assert [(each["what"], each["gateway"]) for each in decisions][:2] == [("rollback", THERE), ("accept", HERE)]


def test_a_proposal_is_declined_at_any_gateway_which_writes_nothing(fleet: TwoGateways, writes: list[Gains]) -> None:
    job = fleet.there.proposed()
    fleet.age(3600.0)
    assert fleet.here.decide(job, "rollback").json()["state"] == "rolled_back"
    assert fleet.here.requests() == [] and writes == []


def test_a_proposal_of_a_restored_database_is_taken_back_by_the_gateway_of_its_loop(
    fleet: TwoGateways, writes: list[Gains]
) -> None:
    job = fleet.there.proposed()
    fleet.there.controller.by_hand(gains=NEW)  # accepted after the dump
    fleet.here.store.doubt_proposals("the service was started with --no-resume")
    assert fleet.here.decide(job, "rollback").json()["state"] == "rolled_back"
    assert fleet.there.controller.state.gains == OLD and writes == [OLD]


def test_what_the_gateway_refuses_is_answered_as_it_is_there(fleet: TwoGateways, writes: list[Gains]) -> None:
    job = fleet.there.proposed()
    fleet.there.controller.absent = Reason.NODE_LOST
    problem = assert_problem(fleet.here.decide(job, "accept"), 503)
    assert (problem["reason"], problem["detail"]) == ("node_lost", "node 32 does not answer")
    view = fleet.here.http.get(f"/jobs/{job}").json()
    assert view["state"] == "proposed"
    asked = view["decision_request"]
    assert (asked["what"], asked["by"], asked["gateway"], asked["state"]) == ("accept", "A. Lind", HERE, "refused")
    fleet.there.controller.absent = None
    by_hand = Gains(0.9, 4.0)
    fleet.there.controller.by_hand(gains=by_hand)
    assert "the gains were changed" in assert_problem(fleet.here.decide(job, "accept"), 409)["detail"]
    fleet.there.controller.by_hand(gains=OLD)
    writes.clear()
    fleet.here.http.post(f"/loops/{TAG_THERE}/lock", json={"reason": "valve"})
    assert assert_problem(fleet.here.decide(job, "accept"), 409)["reason"] == "locked"
    fleet.here.http.post(f"/loops/{TAG_THERE}/unlock")
    assert writes == []
    assert fleet.here.decide(job, "accept").status_code == 200
    assert fleet.here.http.get(f"/jobs/{job}").json()["decision_request"] is None
    assert_problem(fleet.here.decide(job, "accept"), 409)


def test_a_lock_that_comes_before_the_gateway_has_begun_holds(fleet: TwoGateways, writes: list[Gains]) -> None:
    job = fleet.there.proposed()
    fleet.stop_looking()
    asked = fleet.asked(job)
    fleet.there.jobs.locking.lock(TAG_THERE, "valve", "me")
    fleet.there.jobs.requested_decisions.look()
    assert assert_problem(asked.result(60), 409)["reason"] == "locked"
    assert writes == [] and fleet.there.controller.state.gains == OLD


def test_the_same_key_again_gets_the_same_answer_and_writes_nothing(fleet: TwoGateways, writes: list[Gains]) -> None:
    job = fleet.there.proposed()
    first = fleet.here.decide(job, "accept", Idempotency_Key="one")
    again = [gateway.decide(job, "accept", Idempotency_Key="one") for gateway in (fleet.here, fleet.there)]
    assert first.status_code == 200 and [each.json() for each in again] == [first.json()] * 2
    assert writes == [NEW] and len(fleet.here.requests()) == 1


def test_asked_at_both_gateways_at_once_it_is_written_once(fleet: TwoGateways, writes: list[Gains]) -> None:
    job = fleet.there.proposed()
    with ThreadPoolExecutor(4) as pool:
        found = sorted(
            pool.map(lambda gateway: gateway.decide(job, "accept").status_code, (fleet.here, fleet.there) * 2)
        )
    assert found == [200, 409, 409, 409] and writes == [NEW]


@pytest.mark.parametrize("age_s", [11.0, 7200.0, None])
def test_a_gateway_that_does_not_answer_is_said_so_at_once(fleet: TwoGateways, age_s: float | None) -> None:
    job = fleet.there.proposed()
    if age_s is None:
        fleet.here.sql("DELETE FROM gateways")
    else:
        fleet.age(age_s)
    problem = assert_problem(fleet.here.decide(job, "accept"), 503)
    assert problem["reason"] == "gateway_lost" and "nothing was written" in problem["detail"]
    since = {11.0: r"last there \d\d s ago", 7200.0: "last there 2 h ago", None: "has not run since"}[age_s]
    assert re.search(f"gateway {THERE} does not answer: it .*{since}", problem["detail"]), problem
    assert fleet.here.requests() == []


def test_a_gateway_that_falls_silent_meanwhile(fleet: TwoGateways, writes: list[Gains]) -> None:
    """Who asked was told that nothing was written: it stays so when the gateway is back."""
    job = fleet.there.proposed()
    fleet.stop_looking()
    asked = fleet.asked(job)
    fleet.age(3.5)
    fleet.here.lose_patience()
    problem = assert_problem(asked.result(60), 503)
    assert problem["reason"] == "gateway_lost" and "withdrawn" in problem["detail"]
    assert fleet.here.requests() == [("accept", "withdrawn")]
    fleet.there.jobs.requested_decisions.look()
    assert writes == [] and fleet.here.requests() == [("accept", "withdrawn")]
    assert fleet.here.http.get(f"/jobs/{job}").json()["decision_request"]["state"] == "withdrawn"


def test_one_that_takes_longer_is_202_and_the_job_says_what_becomes_of_it(
    fleet: TwoGateways, writes: list[Gains]
) -> None:
    job = fleet.there.proposed()
    fleet.stop_looking()
    asked = fleet.asked(job)
    fleet.here.lose_patience()
    answer = asked.result(60)
    assert (answer.status_code, answer.headers["location"]) == (202, f"/jobs/{job}")
    assert answer.json()["state"] == "proposed" and answer.json()["decision_request"]["state"] == "waiting"
    fleet.there.jobs.requested_decisions.look()
    until(lambda: fleet.here.http.get(f"/jobs/{job}").json()["state"] == "accepted")
    assert writes == [NEW] and fleet.here.http.get(f"/jobs/{job}").json()["decision_request"] is None


def test_one_that_writes_for_long_is_202_and_under_way(fleet: TwoGateways) -> None:
    job = fleet.there.proposed()
    with held_acceptances() as (inside, free):
        asked = fleet.asked(job)
        assert inside.wait(60)
        fleet.age(3600.0)  # what was begun is not withdrawn
        fleet.here.lose_patience()
        answer = asked.result(60)
        assert answer.status_code == 202 and answer.json()["decision_request"]["state"] == "under_way"
        free.set()
        until(lambda: fleet.here.requests() == [("accept", "done")])
    assert fleet.here.http.get(f"/jobs/{job}").json()["state"] == "accepted"


def test_one_whose_gateway_comes_back_an_hour_later_is_not_carried_out(fleet: TwoGateways, writes: list[Gains]) -> None:
    """Also where the gateway at which it was asked ended before it could withdraw it."""
    job = fleet.there.proposed()
    fleet.stop_looking()
    decision_requests.ask(fleet.here.store, THERE, What.ACCEPT, TAG_THERE, job, "A. Lind")
    fleet.here.sql("UPDATE decision_requests SET asked_s = asked_s - 3600, expires_s = expires_s - 3600")
    assert fleet.here.http.get(f"/jobs/{job}").json()["decision_request"]["state"] == "expired"
    fleet.there.jobs.requested_decisions.look()
    assert fleet.here.requests() == [("accept", "expired")] and writes == []
    assert fleet.there.controller.state.gains == OLD


def test_the_time_after_which_it_is_not_begun_is_ten_seconds(
    fleet: TwoGateways, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(decision_requests, "EXPIRES_S", EXPIRES_S)
    fleet.stop_looking()
    decision_requests.ask(fleet.here.store, THERE, What.WRITES_OVER, TAG_THERE, None, "me")
    fleet.here.sql("UPDATE decision_requests SET expires_s = expires_s - 5")
    assert len(decision_requests.take(fleet.there.store, 1)) == 1
    decision_requests.ask(fleet.here.store, THERE, What.WRITES_OVER, TAG_THERE, None, "me")
    fleet.here.sql("UPDATE decision_requests SET expires_s = expires_s - 10 WHERE state = 'waiting'")
    assert decision_requests.take(fleet.there.store, 1) == []


def test_one_that_its_gateway_had_begun_as_it_was_killed_is_not_begun_again(
    fleet: TwoGateways, writes: list[Gains]
) -> None:
    job = fleet.there.proposed()
    fleet.stop_looking()
    decision_requests.ask(fleet.here.store, THERE, What.ACCEPT, TAG_THERE, job, "A. Lind")
    assert len(decision_requests.take(fleet.there.store, 4)) == 1  # and the process is gone
    RequestedDecisions(fleet.there.store, Machine(), Registry(), {}).look()
    assert fleet.here.requests() == [("accept", "cut_off")] and writes == []
    assert fleet.here.http.get(f"/jobs/{job}").json()["decision_request"]["state"] == "cut_off"
    RequestedDecisions(fleet.there.store, Machine(), fleet.there.jobs.registry, {}).look()
    assert writes == []


def test_a_gateway_that_ends_begins_nothing(fleet: TwoGateways, writes: list[Gains]) -> None:
    job = fleet.there.proposed()
    fleet.stop_looking()
    decision_requests.ask(fleet.here.store, THERE, What.ACCEPT, TAG_THERE, job, "A. Lind")
    fleet.there.jobs.request_stop()
    fleet.there.jobs.requested_decisions.look()
    assert fleet.here.requests() == [("accept", "waiting")] and writes == []


def test_withdrawn_and_begun_at_the_same_time_one_of_them_wins(fleet: TwoGateways) -> None:
    fleet.stop_looking()
    begun = 0
    with ThreadPoolExecutor(2) as pool:
        for _ in range(60):
            number = decision_requests.ask(fleet.here.store, THERE, What.WRITES_OVER, TAG_THERE, None, "me")
            together = threading.Barrier(2)

            def take(together: threading.Barrier = together) -> list[DecisionRequest]:
                together.wait(20)
                return decision_requests.take(fleet.there.store, 4)

            taken = pool.submit(take)
            together.wait(20)
            withdrawn = decision_requests.withdraw(fleet.here.store, number)
            assert withdrawn != bool(taken.result(20))
            state = RequestState.WITHDRAWN if withdrawn else RequestState.UNDER_WAY
            assert decision_requests.get(fleet.here.store, number).state is state
            begun += not withdrawn
            decision_requests.cut_off(fleet.there.store, [])
    assert begun < 60, "every one was begun before it could be withdrawn: nothing was tried"


def test_a_repetition_after_the_asking_gateway_was_killed_joins_the_request(
    fleet: TwoGateways, writes: list[Gains]
) -> None:
    """The key notes the effect when the decision is carried out, whoever asked with it last."""
    job = fleet.there.proposed()
    fleet.stop_looking()
    keys = IdempotencyKeys(fleet.here.store)
    claim = keys.claim("key", "one", "fingerprint")
    assert isinstance(claim, idempotency_effects.Claim)
    token = idempotency_effects.current.set(claim)
    try:
        first = decision_requests.ask(fleet.here.store, THERE, What.ACCEPT, TAG_THERE, job, "A. Lind")
        assert decision_requests.ask(fleet.here.store, THERE, What.ACCEPT, TAG_THERE, job, "A. Lind") == first
        assert decision_requests.ask(fleet.here.store, THERE, What.ROLLBACK, TAG_THERE, job, "A. Lind") != first
    finally:
        idempotency_effects.current.reset(token)
    fleet.here.sql("DELETE FROM decision_requests WHERE number <> :first", first=first)
    fleet.there.jobs.requested_decisions.look()
    until(lambda: fleet.here.requests() == [("accept", "done")])
    again = IdempotencyKeys(fleet.there.store)  # of a gateway that has not been cut off
    fleet.here.sql("UPDATE idempotency_keys SET host = 'gone'")
    found = again.claim("key", "one", "fingerprint")
    assert isinstance(found, idempotency_effects.Claim) and found.effect == f"/jobs/{job}" and writes == [NEW]


def test_a_lock_made_here_waits_for_a_decision_that_writes_there(fleet: TwoGateways) -> None:
    job = fleet.there.proposed()
    with held_acceptances() as (inside, free), ThreadPoolExecutor(2) as pool:
        decision = pool.submit(fleet.there.jobs.decisions.accept, job, "me")
        assert inside.wait(20)
        lock = pool.submit(fleet.here.jobs.locking.lock, TAG_THERE, "valve", "me")
        until(lambda: ("writes_over", "under_way") in fleet.here.requests())
        assert not lock.done() and TAG_THERE in fleet.here.jobs.locking.locks()
        free.set()
        assert decision.result(20).state == "accepted" and lock.result(20)[0].reason == "valve"


def test_a_lock_whose_gateway_does_not_say_that_nothing_writes(fleet: TwoGateways) -> None:
    fleet.stop_looking()
    ages_s = {"does not say": -1e6, "was withdrawn, nothing was written": 3.5}
    for number, (words, age_s) in enumerate(ages_s.items(), 1):
        asked = fleet.waiting(fleet.here.jobs.locking.lock, TAG_THERE, "valve", "me")
        assert len(fleet.here.requests()) == number
        fleet.age(age_s)
        fleet.here.lose_patience()
        with pytest.raises(Conflict, match=f"locked now, but .* gateway {THERE} .*{words}"):
            asked.result(60)
        fleet.age(-1e6)
    fleet.age(11.0)  # what it may have begun before is over by now
    assert fleet.here.jobs.locking.lock(TAG_THERE, "valve", "me")[0].reason == "valve"


def test_a_database_that_goes_away_while_the_answer_is_waited_for(
    fleet: TwoGateways, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = fleet.there.proposed()
    fleet.stop_looking()
    asked = fleet.asked(job)

    def away(*_: object) -> DecisionRequest:
        raise OperationalError("SELECT", {}, Exception("the server is gone"))

    monkeypatch.setattr(decision_requests, "get", away)
    fleet.here.lose_patience()
    answer = asked.result(60)
    assert "is not known" in assert_problem(answer, 503)["detail"] and answer.headers["retry-after"]


@pytest.mark.parametrize("error", [
    IllegalMove(JobState.ACCEPTED, JobState.ACCEPTED), Busy(TAG_THERE, "4f0c2a9be113"), Locked("locked by me"),
    Conflict("other gains"), Failed(Reason.NODE_LOST, "node 32 does not answer"),
    Refused(Reason.GAINS_CHANGED, "held"), GatewayLost("silent"),
])  # fmt: skip
def test_an_error_comes_across_as_it_is(error: Exception) -> None:
    answer = RequestAnswer.model_validate_json(answer_to(error).model_dump_json())
    with pytest.raises(Exception) as caught:
        raise_of(answer, TAG_THERE, THERE)
    assert str(caught.value) == str(error)
    assert getattr(caught.value, "reason", None) == getattr(error, "reason", None)


def test_errors_that_are_of_the_other_gateway_name_it() -> None:
    for error, kind in ((Stopping("it stops"), Stopping), (NotKnown(""), NotKnown), (KeyError("x"), Exception)):
        with pytest.raises(kind, match=THERE):
            raise_of(answer_to(error), TAG_THERE, THERE)
    assert answer_to(KeyError("x")).kind is AnswerKind.DEFECT
