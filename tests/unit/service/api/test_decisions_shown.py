"""GET /decisions: who began, stopped, accepted and rolled back tests."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from fastapi.testclient import TestClient

from loopwright.service.api.gate.gate import Policy
from loopwright.service.inputs.request import FastRetune
from loopwright.service.security.keys import Scope
from loopwright.service.states.loop_state import LoopState
from loopwright.service.store.keyring import Keyring
from loopwright.tuning.gains import Gains
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import NEW, OLD, TAG, FakeLoop, Service
from tests.unit.service.processes import until


@pytest.fixture
def client(service: Service) -> Iterator[TestClient]:
    with TestClient(app_of(service.jobs)) as client:
        yield client


def proposed(service: Service, by: str, loop: str = TAG) -> str:
    job = service.jobs.start(loop, FastRetune(by=by)).id
    until(lambda: service.store.get(job).state == "proposed")
    until(lambda: service.jobs.running(job) is None)
    return job


def listed(client: TestClient, **query: Any) -> list[dict[str, Any]]:
    answer = client.get("/decisions", params=query)
    assert answer.status_code == 200, answer.text
    entries: list[dict[str, Any]] = answer.json()
    return entries


def test_what_was_decided_about_a_test(service: Service, client: TestClient) -> None:
    assert listed(client) == []
    job = proposed(service, "A. Lind")
    assert client.post(f"/jobs/{job}/accept", json={"by": "B. Berg"}).status_code == 200
    assert client.post(f"/jobs/{job}/rollback", json={"by": "C. Dahl"}).status_code == 200
    client.post(f"/loops/{TAG}/lock", json={"reason": "repairs", "by": "D. Ek"})
    entries = listed(client)
    assert [(each["what"], each["by"]) for each in entries] == [
        ("rollback", "C. Dahl"), ("accept", "B. Berg"), ("retune", "A. Lind"),
    ]  # fmt: skip
    rolled_back, accepted, begun = entries
    assert {each["job"] for each in entries} == {f"/jobs/{job}"} and {each["loop"] for each in entries} == {TAG}
    assert (accepted["previous_gains"]["Kp"], accepted["new_gains"]["Kp"]) == (OLD.Kp, NEW.Kp)
    assert (rolled_back["previous_gains"]["Kp"], rolled_back["new_gains"]["Kp"]) == (NEW.Kp, OLD.Kp)
    assert begun["previous_gains"] is begun["new_gains"] is None
    assert {each["error"] for each in entries} == {None}


def test_a_decision_that_failed_says_why(service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    job = proposed(service, "A. Lind")

    real = FakeLoop.accept

    def late(loop: FakeLoop, gains: Gains, instead_of: Gains) -> LoopState:
        service.controller.by_hand(gains=Gains(9.0, 99.0))
        return real(loop, gains, instead_of)

    with monkeypatch.context() as patch:
        patch.setattr(FakeLoop, "accept", late)
        assert client.post(f"/jobs/{job}/accept", json={"by": "B. Berg"}).status_code == 409
    failed = listed(client)[0]
    assert (failed["what"], failed["by"]) == ("accept_failed", "B. Berg")
    assert "meanwhile" in failed["error"] and failed["new_gains"] is None


def test_they_are_found_by_loop_name_and_time(service: Service, client: TestClient) -> None:
    first = proposed(service, "A. Lind")
    service.jobs.decisions.accept(first, "B. Berg")
    assert [each["what"] for each in listed(client, loop=TAG, by="B. Berg")] == ["accept"]
    assert [each["what"] for each in listed(client, by="local")] == []
    assert listed(client, loop="FIC-2") == listed(client, by="nobody") == []
    accepted = listed(client)[0]["at"]
    at = datetime.fromisoformat(accepted)
    assert listed(client, **{"from": accepted})[0]["what"] == "accept"
    elsewhere = at.astimezone(UTC) + timedelta(hours=2)
    west = elsewhere.replace(tzinfo=None).isoformat() + "+02:00"  # the same moment, in another zone
    assert listed(client, **{"from": west})[0]["what"] == "accept"
    assert listed(client, **{"from": (at + timedelta(seconds=1)).isoformat()}) == []


def test_pages_have_each_decision_once(service: Service, client: TestClient) -> None:
    job = proposed(service, "A. Lind")
    service.jobs.decisions.accept(job, "B. Berg")
    service.jobs.decisions.rollback(job, "B. Berg")
    url, seen = f"/decisions?limit=1&loop={TAG}&from=2026-01-01T00:00:00%2B02:00", []
    while url:
        answer = client.get(url)
        assert answer.status_code == 200, answer.text
        seen += [each["what"] for each in answer.json()]
        url = answer.links.get("next", {}).get("url", "")
    assert seen == ["rollback", "accept", "retune"]


@pytest.mark.parametrize(
    "query",
    ["from=yesterday", "from=2026-01-31T12:00:00", "from=0001-01-01T00:00:00%2B23:59",
     "from=9999-12-31T23:59:59-23:59", "limit=0", "cursor=x"],
)  # fmt: skip
def test_what_is_refused(client: TestClient, query: str) -> None:
    assert client.get(f"/decisions?{query}").status_code == 422


def test_a_key_that_reads_sees_names_and_no_addresses(service: Service) -> None:
    proposed(service, "A. Lind")
    keyring = Keyring(service.store.engine)
    _, key = keyring.create("supervisor", Scope.READ)
    with TestClient(app_of(service.jobs, Policy(keyring))) as client:
        assert client.get("/decisions").status_code == 401
        answer = client.get("/decisions", headers={"Authorization": f"Bearer {key}"})
        assert answer.status_code == 200 and len(answer.json()) == 1
        assert not {"address", "key_id"} & set(answer.json()[0])
