"""What clients expect of every HTTP API: reasons, HEAD, unknown parameters, ETags, and a document with all of it."""

from __future__ import annotations

from typing import Any

import pytest
from fastapi.testclient import TestClient

from loopwright.service.api.problems import TYPE
from tests.unit.service.api.test_api import assert_problem, finished, start
from tests.unit.service.fakes import TAG, Service


@pytest.mark.parametrize(
    ("method", "path", "status", "reason"),
    [
        ("GET", "/nothing", 404, "not_found"),
        ("GET", "/loops/TIC-999", 404, "unknown_loop"),
        ("GET", "/jobs/nothing", 404, "unknown_job"),
        ("GET", "/batches/nothing", 404, "unknown_batch"),
        ("GET", "/alarms/nothing", 404, "unknown_alarm"),
        ("DELETE", "/loops", 405, "method_not_allowed"),
        ("GET", "/jobs?limit=0", 422, "bad_input"),
    ],
)
def test_every_problem_has_a_reason_and_a_type(
    client: TestClient, method: str, path: str, status: int, reason: str
) -> None:
    body = assert_problem(client.request(method, path), status)
    assert body["reason"] == reason and body["type"] == f"{TYPE}{reason}"


def test_a_decision_in_the_wrong_state_names_the_state(service: Service, client: TestClient) -> None:
    job = finished(service, client)
    assert client.post(f"{job['url']}/rollback").status_code == 200
    body = assert_problem(client.post(f"{job['url']}/accept"), 409)
    assert (body["reason"], body["state"]) == ("wrong_state", "rolled_back")


def test_a_busy_loop_is_named_with_its_job(service: Service, client: TestClient) -> None:
    service.tune.hold.clear()
    job_id = start(client)
    body = assert_problem(client.post(f"/loops/{TAG}/retune", json={"by": "me"}), 409)
    assert (body["reason"], body["job"]) == ("loop_busy", f"/jobs/{job_id}")


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("/loops/TIC-101/observation?ms=1.6", "query.ms: there is no such query parameter; did you mean Ms?"),
        ("/jobs?stat=running", "query.stat: there is no such query parameter; did you mean state?; the parameters are"),
        ("/healthz?verbose=1", "query.verbose: there is no such query parameter; there are none"),
        (f"/loops/{TAG}?x=1", "query.x"),
    ],
)
def test_an_unknown_query_parameter_is_refused(client: TestClient, path: str, words: str) -> None:
    body = assert_problem(client.get(path), 422)
    assert words in body["detail"] and body["errors"][0]["where"].startswith("query.")


def test_an_abort_is_never_refused_for_a_parameter(service: Service, client: TestClient) -> None:
    service.tune.hold.clear()
    job_id = start(client)
    assert client.post(f"/jobs/{job_id}/abort?now=1").status_code == 202


@pytest.mark.parametrize("path", ["/healthz", "/loops", f"/loops/{TAG}", "/methods", "/openapi.json", "/nothing"])
def test_head_is_get_without_the_body(client: TestClient, path: str) -> None:
    got, head = client.get(path), client.head(path)
    assert (head.status_code, head.content) == (got.status_code, b"")
    assert head.headers["content-type"] == got.headers["content-type"]


def test_head_of_a_stream_ends(client: TestClient) -> None:
    head = client.head("/live")
    assert head.status_code == 200 and head.headers["content-type"].startswith("text/event-stream")


def test_samples_that_have_not_changed_are_not_sent_again(service: Service, client: TestClient) -> None:
    url = f"{finished(service, client)['url']}/samples"
    first = client.get(url)
    again = client.get(url, headers={"If-None-Match": f'"other", {first.headers["etag"]}'})
    assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", first.headers["etag"])
    of_a_stage = client.get(url, params={"stage": "relay"})
    assert of_a_stage.headers["etag"] != first.headers["etag"]


def test_a_stream_says_when_to_come_back(service: Service, client: TestClient) -> None:
    job = finished(service, client)
    with client.stream("GET", f"{job['url']}/events") as stream:
        assert next(stream.iter_lines()) == "retry: 2000"


def test_the_first_page_is_found_by_a_relative_link(client: TestClient) -> None:
    for path in ("/", "/ui"):
        answer = client.get(path, follow_redirects=False)
        assert answer.status_code in (307, 308) and answer.headers["location"] == "/ui/"


def test_the_document_names_what_a_client_is_made_of(client: TestClient) -> None:
    document: dict[str, Any] = client.get("/openapi.json").json()
    operations = [each for item in document["paths"].values() for each in item.values()]
    ids = [each["operationId"] for each in operations]
    assert len(set(ids)) == len(ids) and {"retune_loop", "get_job", "list_loops"} <= set(ids)
    tags = {tag["name"] for tag in document["tags"]}
    assert all(set(each["tags"]) <= tags and each["description"] for each in operations)
    for each in operations:
        if "202" in each["responses"]:
            assert "Location" in each["responses"]["202"]["headers"]
        if "429" in each["responses"]:
            assert "Retry-After" in each["responses"]["429"]["headers"]
