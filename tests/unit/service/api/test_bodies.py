"""Bodies, numbers and text at the edge of the API that are none, or have more than one meaning."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from fastapi.routing import APIRoute
from fastapi.testclient import TestClient

from loopwright.service.api.bodies import JsonRoute
from loopwright.service.api.gate.bodies import SMALL
from loopwright.service.api.gate.concurrency import DECIDES, kind_of
from loopwright.service.api.gate.gate import Policy
from loopwright.service.inputs.request import FastRetune
from loopwright.service.security.keys import Scope
from loopwright.service.server.assembly import make_jobs
from loopwright.service.store.keyring import Keyring
from loopwright.service.store.store import Store
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import TAG, FakeController, FakeLoop, FakeTune, Service, ThreadEngine, fake_rehearse
from tests.unit.service.postgres import Server

JSON = {"Content-Type": "application/json"}
POSTS = [
    f"/loops/{TAG}/retune", f"/loops/{TAG}/retune/preview", "/batches", "/tunings", "/jobs/none/rollback",
    f"/loops/{TAG}/acknowledge",
]  # fmt: skip


def refused(client: TestClient, url: str, body: str | bytes, **headers: str) -> Any:
    answer = client.post(url, content=body, headers={**JSON, **headers})
    assert answer.headers["content-type"] == "application/problem+json", answer.text
    return answer


def test_every_route_with_a_body_reads_it_strictly(service: Service) -> None:
    app = app_of(service.jobs)
    found = [route for route in app.routes if isinstance(route, APIRoute) and route.body_field]
    assert all(isinstance(route, JsonRoute) for route in found)
    documented = {
        (method.upper(), path)
        for path, operations in app.openapi()["paths"].items()
        for method, operation in operations.items()
        if "requestBody" in operation and not path.endswith("/abort")  # which nothing in its body hinders
    }
    assert {(method, route.path) for route in found for method in route.methods} == documented != set()


def test_a_key_given_twice_starts_nothing(client: TestClient, service: Service) -> None:
    answer = refused(client, POSTS[0], '{"dry_run": true, "dry_run": false}')
    assert answer.status_code == 422 and answer.json()["reason"] == "bad_input"
    assert answer.json()["errors"] == [
        {"where": "body.dry_run", "why": "this key is given twice: leave one of them out"}
    ]
    assert not service.store.recent()


@pytest.mark.parametrize("url", POSTS)
@pytest.mark.parametrize(
    "body",
    [
        b"[" * 1_000_000,
        b'{"a":' * 150_000,
        b"\xff\xfe",
        '{"by": "x"}'.encode("utf-16"),
        b'{"a": {"b": 1, "b": 2}}',
        b'{"Ms": NaN}',
        b'{"Ms": 1e999}',
        b'{"Ms": ' + b"9" * 5000 + b"}",
        rb'{"by": "\u0000"}',
        rb'{"by": "\ud800"}',
        b"{",
        b"null null",
        b" ",
    ],
    ids=lambda body: repr(body[:20]),
)
def test_what_is_no_body_is_422_everywhere(shared_client: TestClient, url: str, body: bytes) -> None:
    too_long = kind_of("POST", url) in DECIDES and len(body) > SMALL
    assert refused(shared_client, url, body).status_code == (413 if too_long else 422)


def test_a_body_with_a_byte_order_mark_is_read(client: TestClient) -> None:
    body = b"\xef\xbb\xbf" + json.dumps({"model": {"K": 1.0, "T_s": 3.0, "L_s": 1.0}, "method": "simc"}).encode()
    assert client.post("/tunings", content=body, headers=JSON).status_code == 200


@pytest.mark.parametrize("kind", ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data", ""])
def test_a_body_that_is_not_said_to_be_json(shared_client: TestClient, kind: str) -> None:
    answer = refused(shared_client, POSTS[0], b"{}", **{"Content-Type": kind})
    assert answer.status_code == 415 and "Content-Type: application/json" in answer.json()["detail"]


@pytest.fixture(scope="module")
def ended(shared_service: Service) -> str:
    """A job that is over."""
    job = shared_service.jobs.start(TAG, FastRetune()).id
    shared_service.wait(job)
    return job


@pytest.mark.parametrize("number", ["9" * 400, str(2**63), str(2**63 - 1), "-1", "abc", "1.5", "1e3", "٣", ""])
@pytest.mark.parametrize("what", ["event", "/jobs?limit=", "/jobs?cursor=", "/batches?cursor=", "/audit?cursor="])
def test_whole_numbers_out_of_all_bounds(shared_client: TestClient, ended: str, number: str, what: str) -> None:
    if what == "event":
        headers = {"Last-Event-ID": number.encode()}
        answer = shared_client.get(f"/jobs/{ended}/events", headers=headers)
    else:
        answer = shared_client.get(what + number)
    assert answer.status_code == 422, answer.text


def test_the_last_event_there_can_be(client: TestClient, service: Service) -> None:
    job = service.jobs.start(TAG, FastRetune()).id
    service.wait(job)
    assert client.get(f"/jobs/{job}/events", headers={"Last-Event-ID": str(2**53)}).status_code == 204


@pytest.mark.parametrize(
    "path",
    ["/loops/%00", "/jobs/a%00b", "/jobs?loop=%00", "/audit?loop=%00", "/decisions?by=%00", "/batches/%00"],
)
def test_text_that_no_database_keeps(path: str, tmp_path: Path, postgres: Server) -> None:
    store = Store(tmp_path, postgres.database())
    try:
        open_loop = lambda config: FakeLoop(FakeController())  # noqa: E731
        jobs = make_jobs({}, store, open_loop, FakeTune(), fake_rehearse, engine=ThreadEngine())
        client = TestClient(app_of(jobs, checks={}), raise_server_exceptions=False)
        answer = client.get(path)
        assert answer.status_code == 422 and "NUL" in answer.json()["detail"], answer.text
    finally:
        store.close()


# numbers, flags and texts are what they are in JSON


@pytest.mark.parametrize(
    ("path", "body", "where"),
    [
        (POSTS[0], {"Ms": "1.6"}, "body.Ms"),
        (POSTS[0], {"Ms": True}, "body.Ms"),
        (POSTS[0], {"derivative": "true"}, "body.derivative"),
        (POSTS[0], {"dry_run": 0}, "body.dry_run"),
        (POSTS[0], {"amplitude_pct": "10"}, "body.amplitude_pct"),
        (POSTS[0], {"by": 7}, "body.by"),
        (POSTS[0], {"method": "five-stage", "overshoot_window_pct": [10, "50"]}, "body.overshoot_window_pct.1"),
        (POSTS[0], {"dry_run": True, "plant": {"num": ["1"], "den": [1, 1]}}, "body.plant.num.0"),
        (POSTS[0], {"start": "design", "model": {"K": "1", "T_s": 3, "L_s": 1}}, "body.model.K"),
        (POSTS[1], {"sp_deviation": "2"}, "body.sp_deviation"),
        ("/batches", {"pattern": "*", "at_once_per_bus": "2"}, "body.at_once_per_bus"),
        ("/batches", {"pattern": "*", "stop_after_failures": True}, "body.stop_after_failures"),
        ("/tunings", {"model": {"K": 1, "T_s": "3", "L_s": 1}}, "body.model.T_s"),
        (f"/loops/{TAG}/lock", {"reason": 5}, "body.reason"),
        ("/jobs/none/accept", {"auto_rollback": "no"}, "body.auto_rollback"),
    ],
)
def test_strict_types(shared_client: TestClient, path: str, body: dict[str, Any], where: str) -> None:
    answer = refused(shared_client, path, json.dumps({"by": "me"} | body if path in POSTS[:3] else body))
    assert answer.status_code == 422 and where in [each["where"] for each in answer.json()["errors"]], answer.text


def test_whole_numbers_may_be_written_as_floats_and_a_query_is_text(shared_client: TestClient) -> None:
    plant = {"num": [2], "den": [3, 1], "seed": 3.0}
    assert shared_client.post(POSTS[1], json={"dry_run": True, "plant": plant, "Ms": 2}).status_code == 200
    assert shared_client.get("/jobs?limit=2").status_code == 200


@pytest.mark.parametrize("content", [None, b"", b"null"])
def test_no_test_begins_without_a_body(client: TestClient, service: Service, content: bytes | None) -> None:
    answer = client.post(POSTS[0], content=content, headers=JSON if content else {})
    assert answer.status_code == 422 and '{"by": "YOUR NAME"}' in answer.json()["detail"]
    assert client.post(POSTS[1]).status_code == 200, "a preview needs none"
    assert not service.store.recent()


@pytest.mark.parametrize("body", [{}, {"by": " "}, {"by": None, "Ms": 1.4}])
def test_a_test_is_signed_where_no_key_names_the_caller(
    client: TestClient, service: Service, body: dict[str, Any]
) -> None:
    for path, more in ((POSTS[0], {}), ("/batches", {"pattern": "*"})):
        answer = client.post(path, json=body | more)
        assert answer.status_code == 422 and answer.json()["errors"][0]["where"] == "body.by"
    assert not service.store.recent()
    assert client.post(POSTS[0], json=body | {"dry_run": True}).status_code == 202


def test_the_key_names_who_does_not_say_it(service: Service) -> None:
    keyring = Keyring(service.store.engine)
    _, key = keyring.create("control room", Scope.OPERATE)
    client = TestClient(app_of(service.jobs, Policy(keyring)), headers={"Authorization": f"Bearer {key}"})
    job = client.post(POSTS[0], json={}).json()
    assert job["by"] == "control room"
    assert client.post(POSTS[0]).status_code == 422, "a body it needs all the same"


@pytest.mark.parametrize(
    ("content", "headers", "by"),
    [
        (None, {}, "local"),
        (b"by=me", {"Content-Type": "application/x-www-form-urlencoded"}, "local"),
        (b'{"by": "A. Lind"}', {"Content-Type": "text/plain"}, "A. Lind"),
        (b'{"by": "A. Lind"}', {}, "A. Lind"),
        (b'{"by": 5}', JSON, "local"),
        (b"[" * 3000, JSON, "local"),
        (b'{"by": "\xff"}', JSON, "local"),
        (b"null", JSON, "local"),
    ],
)
def test_nothing_in_a_body_is_a_reason_not_to_stop(
    client: TestClient, service: Service, content: bytes | None, headers: dict[str, str], by: str
) -> None:
    service.tune.hold.clear()
    job = service.jobs.start(TAG, FastRetune()).id
    assert service.tune.inside.wait(60)
    assert client.post(f"/jobs/{job}/abort", content=content, headers=headers).status_code == 202
    service.tune.hold.set()
    service.wait(job)
    assert client.get(f"/jobs/{job}").json()["stopping"]["by"] == by
