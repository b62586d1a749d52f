"""Events of jobs: one form for each kind, the same in the stream, in the list and in the document."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any, get_args

import pytest
from fastapi.testclient import TestClient
from jsonschema import Draft202012Validator

from loopwright.service.api import event_views
from loopwright.service.jobs.active_job import Running
from loopwright.service.live.snapshot import progress_of
from loopwright.service.store.jobs import JobEvent
from loopwright.tuning.plan import StageStarted
from tests.unit.service.api.test_api import start
from tests.unit.service.fakes import Service

ROOT = Path(__file__).parents[4]


def streamed(client: TestClient, job: str) -> list[tuple[str, str, dict[str, Any]]]:
    """The id, the name and the data of each event of a stream."""
    found = []
    for block in client.get(f"/jobs/{job}/events").text.split("\n\n"):
        fields = dict(line.split(": ", 1) for line in block.splitlines() if not line.startswith(":"))
        if "data" in fields:
            found.append((fields["id"], fields["event"], json.loads(fields["data"])))
    return found


def test_stream_list_and_document_agree(service: Service, client: TestClient) -> None:
    job = start(client)
    service.wait(job)
    client.post(f"/jobs/{job}/accept")
    told = [data for _, kind, data in streamed(client, job) if kind != "progress"]
    listed = client.get(f"/jobs/{job}/log").json()
    assert listed == told and [each["id"] for each in listed] == list(range(1, len(told) + 1))
    assert {"state", "stage_started", "decision_begun"} <= {each["kind"] for each in listed}
    document = client.app.openapi()  # type: ignore[attr-defined]
    schema = {"$ref": "#/components/schemas/JobEventView", "components": document["components"]}
    for each in listed:
        Draft202012Validator(schema).validate(each)
    wrong = next(each for each in listed if each["kind"] == "stage_started") | {"remaining_plant_time_s": "50"}
    assert not Draft202012Validator(schema).is_valid(wrong)


def test_the_list_has_pages(service: Service, client: TestClient) -> None:
    job = start(client)
    service.wait(job)
    whole, found, url = client.get(f"/jobs/{job}/log").json(), [], f"/jobs/{job}/log?limit=2"
    while url:
        page = client.get(url)
        found += page.json()
        url = page.links.get("next", {}).get("url", "")
    assert found == whole and len(whole) > 2
    assert client.get("/jobs/none/log").status_code == 404


def test_every_kind_that_is_stored_has_a_form() -> None:
    """The kinds as the code that stores them writes them."""
    stored = set()
    for path in (ROOT / "service").rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        stored |= set(re.findall(r'(?:append\((?:session, )?\w+(?:\.\w+)?, |\.tell\()"([a-z_]+)"', text))
        stored |= set(re.findall(r'^BEGUN = "([a-z_]+)"', text, re.MULTILINE))
    known = {get_args(each.model_fields["kind"].annotation)[0] for each in get_args(event_views.Stored)}
    assert stored == known, "an event of service/api/event_views.py for each"


def test_a_progress_event_says_when_it_was_and_where_the_stream_goes_on(service: Service, client: TestClient) -> None:
    service.tune.hold.clear()
    job = start(client)
    assert service.tune.inside.wait(60)
    running = service.jobs.running(job)
    assert running is not None
    view = event_views.progress_view(progress_of(running), 4)
    assert (view.id, view.kind) == (4, "progress") and view.at.endswith("Z")
    service.tune.hold.set()
    service.wait(job)


def test_an_event_of_another_version_is_a_note() -> None:
    event = JobEvent(job_id="a", seq=3, at="2026-01-31T12:00:00.000Z", plant_time_s=0.0, kind="held", data={"by": "x"})
    shown = event_views.event_view(event).root
    assert isinstance(shown, event_views.NoteEvent) and shown.id == 3 and shown.text == 'held: {"by": "x"}'


class At:
    """A loop whose plant time is set by the test."""

    t_s = 0.0


def test_what_remains_in_wall_time_is_at_the_pace_of_the_plant() -> None:
    now = [100.0]
    running = Running("a", "TIC-101", journal=Silent(), monotonic=lambda: now[0])  # type: ignore[arg-type]
    running.loop = loop = At()  # type: ignore[assignment]
    running.on_event(StageStarted("relay", 100.0, 100.0))
    assert running.pace() is None
    loop.t_s, now[0] = 50.0, 105.0
    assert running.pace() == pytest.approx(10.0)
    found = progress_of(running)
    assert found.remaining_plant_time_s == pytest.approx(150.0) and found.remaining_wall_time_s == pytest.approx(15.0)


class Silent:
    """A journal that keeps nothing."""

    def put(self, write: object) -> None:
        pass


def test_the_links_of_a_job_are_those_that_answer(service: Service, client: TestClient) -> None:
    job = start(client)
    service.wait(job)
    links = client.get(f"/jobs/{job}").json()["links"]
    assert links["accept"] and links["rollback"] and links["abort"] is None
    for name, url in links.items():
        if url is not None and name not in ("accept", "rollback", "abort"):
            assert client.get(url).status_code in (200, 409), (name, url)
    assert client.post(links["accept"]).json()["links"]["accept"] is None
    assert client.post(links["rollback"]).json()["links"]["rollback"] is None
