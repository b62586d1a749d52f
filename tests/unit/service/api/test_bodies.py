"""Bodies, numbers and text at the edge of the API that are none, or have more than one meaning."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from fastapi.routing import APIRoute
from fastapi.testclient import TestClient

from loopwright.service.api.app import create_app
from loopwright.service.api.bodies import JsonRoute
from loopwright.service.api.gate.bodies import SMALL
from loopwright.service.api.gate.places import DECIDES, kind_of
from loopwright.service.inputs.request import FastRetune
from loopwright.service.server.assembly import make_jobs
from loopwright.service.store.store import Store
from tests.unit.service.fakes import TAG, FakeController, FakeLoop, FakeTune, Service, ThreadEngine, fake_rehearse
from tests.unit.service.postgres import Server

JSON = {"Content-Type": "application/json"}
POSTS = [
    f"/loops/{TAG}/retune", f"/loops/{TAG}/retune/preview", "/retunes", "/tunings", "/jobs/none/rollback",
    f"/loops/{TAG}/dismiss",
]  # fmt: skip


def refused(client: TestClient, url: str, body: str | bytes, **headers: str) -> Any:
    answer = client.post(url, content=body, headers={**JSON, **headers})
    assert answer.headers["content-type"] == "application/problem+json", answer.text
    return answer


def test_every_route_with_a_body_reads_it_strictly(service: Service) -> None:
    app = create_app(service.jobs)
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
        b'{"ms": NaN}',
        b'{"ms": 1e999}',
        b'{"ms": ' + b"9" * 5000 + b"}",
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
@pytest.mark.parametrize("what", ["event", "/jobs?limit=", "/jobs?cursor=", "/retunes?cursor=", "/audit?cursor="])
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
    ["/loops/%00", "/jobs/a%00b", "/jobs?loop=%00", "/audit?loop=%00", "/decisions?by=%00", "/retunes/%00"],
)
def test_text_that_no_database_keeps(path: str, tmp_path: Path, postgres: Server) -> None:
    store = Store(tmp_path, postgres.database())
    try:
        open_loop = lambda config: FakeLoop(FakeController())  # noqa: E731
        jobs = make_jobs({}, store, open_loop, FakeTune(), fake_rehearse, engine=ThreadEngine())
        client = TestClient(create_app(jobs, checks={}), raise_server_exceptions=False)
        answer = client.get(path)
        assert answer.status_code == 422 and "NUL" in answer.json()["detail"], answer.text
    finally:
        store.close()
