"""Retunes of many loops on fakes; `look` is called by the tests, so that what happens does not hang on time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi.testclient import TestClient
from pydantic import ValidationError
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from loopwright.service.cli.client import Client
from loopwright.service.inputs.config import BusConfig, parse_site
from loopwright.service.inputs.request import FastRetune, retune_request
from loopwright.service.jobs.fleet import BadFleet, Fleet, FleetRequest, fleet_request
from loopwright.service.jobs.manager import Jobs
from loopwright.service.server.assembly import make_jobs
from loopwright.service.states.job_state import JobState
from loopwright.service.store import audit, batches
from loopwright.service.store.batches import BatchOver, NoSuchBatch, Part
from loopwright.service.store.journal_writes import Write
from loopwright.service.store.store import Store
from loopwright.service.store.tables import BatchRow
from loopwright.tuning.reasons import Aborted, Failed, Reason, Refused
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import (
    FakeController,
    FakeLoop,
    FakeTune,
    Service,
    ThreadEngine,
    away,
    fake_rehearse,
    loop_entry,
)
from tests.unit.service.jobs.test_lost_answers import LosesAnswers
from tests.unit.service.postgres import Server
from tests.unit.service.processes import PATIENCE_S, until

ENTRIES = [
    loop_entry(tag=f"{area}-{n}", area=area or None, bus=f"virtual:{bus}", channel=n + 1, controller_node=node)
    for node, (area, bus) in enumerate((("A", "x"), ("B", "x"), ("B", "y")), 10)
    for n in range(1, 4)
    if (area, bus, n) != ("B", "y", 3)
]
for entry in ENTRIES[6:]:
    entry["tag"] = entry["tag"].replace("B-", "B-Y")
TAGS = [entry["tag"] for entry in ENTRIES]


class Plant(Service):
    """Eight loops: A-1..3 and B-1..3 on bus x, B-Y1..2 on bus y; each with a controller of its own."""

    def __init__(self, folder: Path, **options: Any) -> None:
        self.controllers = {tag: FakeController() for tag in TAGS}
        super().__init__(folder, **options)

    def more_jobs(self, open_loop: Any, rehearse: Any = fake_rehearse, **options: Any) -> Jobs:
        self.loops = parse_site({"loops": ENTRIES}, "test").loops
        own = lambda config: FakeLoop(self.controllers[config.tag])  # noqa: E731
        jobs = super().more_jobs(own, rehearse, **options)
        self.fleet = Fleet(jobs)
        return jobs

    def running(self) -> list[str]:
        return sorted(self.store.busy())

    def settle(self) -> None:
        """Every job that runs ends, and the fleet sees it."""
        self.tune.hold.set()
        for row in self.store.unfinished():
            self.wait(row.id)
        self.fleet.poll()

    def hold(self) -> None:
        self.tune.hold.clear()

    def parts(self, batch_id: str) -> dict[str, Part]:
        return {part.loop: part for part in self.fleet.get(batch_id)[1]}

    def state(self, batch_id: str) -> str:
        return self.fleet.get(batch_id)[0].state


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Plant]:
    plant = Plant(tmp_path)
    yield plant
    plant.close()


def asked(**options: Any) -> FleetRequest:
    return fleet_request(**options)


def test_every_loop_gets_its_turn_and_no_bus_or_area_has_more_than_permitted(plant: Plant) -> None:
    """Counted at every step from the store, not from what the fleet thinks."""
    plant.hold()
    retune = plant.fleet.start(asked(pattern="*", at_once_per_bus=2, at_once_per_area=3)).id
    seen: list[str] = []
    for _ in range(20):
        plant.fleet.poll()
        now = plant.running()
        on_x = [tag for tag in now if "Y" not in tag]
        in_b = [tag for tag in now if tag.startswith("B")]
        assert len(on_x) <= 2 and len(now) - len(on_x) <= 2 and len(in_b) <= 3
        seen += now
        if not now:
            break
        plant.tune.hold.set()
        for row in plant.store.unfinished():
            plant.wait(row.id)
        plant.hold()
    assert sorted(seen) == sorted(TAGS), "each exactly once"
    assert plant.state(retune) == "done" and {p.job_state for p in plant.parts(retune).values()} == {JobState.PROPOSED}
    # As many as are permitted, not fewer: 2 of x and 2 of y at first.
    assert sorted(seen[:4]) == ["A-1", "A-2", "B-Y1", "B-Y2"]


def test_an_area_counts_over_its_buses_and_with_jobs_of_others(plant: Plant) -> None:
    plant.hold()
    plant.jobs.start("B-3", FastRetune())
    plant.fleet.start(asked(pattern="B-*", at_once_per_area=2))
    plant.fleet.poll()
    assert plant.running() == ["B-1", "B-3"]


def test_a_bus_takes_no_more_than_its_configuration_says(tmp_path: Path) -> None:
    plant = Plant(tmp_path, buses={"virtual:x": BusConfig(at_once=1)})
    plant.hold()
    plant.fleet.start(asked(pattern="*", at_once_per_bus=5))
    plant.fleet.poll()
    assert plant.running() == ["A-1", "B-Y1", "B-Y2"]
    plant.close()


def test_loops_are_begun_in_the_order_given_and_once(plant: Plant) -> None:
    plant.hold()
    retune = plant.fleet.start(asked(loops=["B-1", "A-1", "B-1"], at_once_per_bus=1)).id
    plant.fleet.poll()
    plant.fleet.poll()
    assert plant.running() == ["B-1"] and list(plant.parts(retune)) == ["B-1", "A-1"]


def test_a_busy_loop_is_waited_for(plant: Plant) -> None:
    plant.hold()
    other = plant.jobs.start("A-1", FastRetune())
    retune = plant.fleet.start(asked(loops=["A-1", "A-2"])).id
    plant.fleet.poll()
    assert plant.parts(retune)["A-1"].waiting and plant.running() == ["A-1", "A-2"]
    plant.settle()
    plant.settle()
    plant.settle()
    assert plant.state(retune) == "done"
    assert plant.parts(retune)["A-1"].job_id not in (None, other.id)


@pytest.mark.parametrize(
    ("ends", "counts"),
    [
        (Refused(Reason.NOT_AT_REST, "drifts"), True),
        (Failed(Reason.NODE_LOST, "silent"), True),
        (Aborted(Reason.MODE_CHANGED, "manual"), True),
        (Aborted(Reason.OPERATOR, "enough"), False),
    ],
)
def test_it_stops_after_so_many_failures_and_those_under_test_go_on(
    plant: Plant, ends: Exception, counts: bool
) -> None:
    plant.tune.ends = ends
    retune = plant.fleet.start(asked(loops=TAGS[:6], at_once_per_bus=2, stop_after_failures=3)).id
    for _ in range(10):
        plant.settle()
    row, parts = plant.fleet.get(retune)
    begun = [part for part in parts if part.job_id]
    if counts:  # 2, then 2 more since 2 are fewer than 3, then no more
        assert (row.state, row.stop_reason, len(begun)) == ("stopped", "failures", 4)
        assert row.detail == "4 ended without a proposal: A-1, A-2, A-3, B-1" and row.ended_at
        assert [part.state(False) for part in parts[4:]] == ["skipped"] * 2
    else:
        assert (row.state, row.stop_reason, len(begun)) == ("done", None, 6)


def test_abort_stops_what_runs_and_begins_nothing_more(plant: Plant) -> None:
    plant.hold()
    retune = plant.fleet.start(asked(pattern="A-*", at_once_per_bus=2)).id
    plant.fleet.poll()
    assert plant.running() == ["A-1", "A-2"]
    assert plant.fleet.abort(retune, "me").state == "stopping"
    for row in plant.store.unfinished():
        plant.wait(row.id)
    plant.fleet.poll()
    row, parts = plant.fleet.get(retune)
    assert (row.state, row.stop_reason) == ("aborted", "operator")
    assert [part.state(False) for part in parts] == ["aborted", "aborted", "skipped"]
    with pytest.raises(BatchOver, match=r"ended at .* as aborted: nothing of it is left to stop"):
        plant.fleet.abort(retune, "me")
    what = [(row.what, row.by) for row in audit.trail(plant.store.engine, 10)]
    assert ("batch_abort", "me") in what and ("batch", "service") in what


def test_a_retune_stopped_while_its_next_job_is_made_has_no_such_job(plant: Plant) -> None:
    """The note in the retune and the job are one transaction."""
    retune = plant.fleet.start(asked(loops=["A-1"])).id
    row, parts = plant.fleet.get(retune)
    plant.fleet.abort(retune, "me")
    plant.fleet.begin(row, asked(loops=["A-1"]), parts)  # it had looked before
    assert plant.running() == [] and plant.store.recent() == []


class Deaf(ThreadEngine):
    """Is killed before it begins anything."""

    def enqueue(self, job_id: str, queue: str) -> None:
        self.enqueued.append((job_id, queue))


def test_a_service_killed_in_between_goes_on_with_the_same_jobs(tmp_path: Path) -> None:
    first = Plant(tmp_path, engine=Deaf())
    retune = first.fleet.start(asked(pattern="A-*", at_once_per_bus=2)).id
    first.fleet.poll()
    begun = [row.id for row in first.store.unfinished()]
    first.jobs.stop_watching()
    first.store.close()
    again = Plant(tmp_path)
    for _ in range(5):
        again.settle()
    parts = again.parts(retune)
    assert again.state(retune) == "done" and {p.job_state for p in parts.values()} == {JobState.PROPOSED}
    assert [part.job_id for part in parts.values()][:2] == begun and len(again.store.recent()) == 3
    again.close()


def test_a_service_stopped_in_between_goes_on_where_it_was(tmp_path: Path) -> None:
    first = Plant(tmp_path)
    first.hold()
    retune = first.fleet.start(asked(pattern="A-*", at_once_per_bus=1, sp_deviation=1.5, by="night")).id
    first.fleet.poll()
    (cut,) = first.store.unfinished()
    assert first.tune.inside.wait(60)
    first.jobs.stop()  # as SIGTERM does: the job is aborted, its loop restored
    first.fleet.poll()  # too late to begin anything
    first.close()
    assert first.controllers["A-1"].state == FakeController().state
    again = Plant(tmp_path)
    assert again.store.get(cut.id).reason == "service_stopped" and again.state(retune) == "running"
    for _ in range(5):
        again.settle()
    parts = again.parts(retune)
    assert again.state(retune) == "done" and {p.job_state for p in parts.values()} == {JobState.PROPOSED}
    assert parts["A-1"].job_id != cut.id, "the loop whose job was cut short had another"
    jobs = again.store.recent()
    assert len(jobs) == 4 and {(j.request["sp_deviation"], j.by) for j in jobs} == {(1.5, "night")}
    again.close()


@pytest.fixture
def cut_short(tmp_path: Path) -> Iterator[tuple[Plant, str, str]]:
    """A retune of A-1 and A-2 after a stop of the service in the test of A-1: the next service, the retune, the job."""
    first = Plant(tmp_path)
    first.hold()
    retune = first.fleet.start(asked(loops=["A-1", "A-2"], at_once_per_bus=1)).id
    first.fleet.poll()
    assert first.tune.inside.wait(60)
    (cut,) = first.store.unfinished()
    first.jobs.stop()  # as SIGTERM does
    first.close()
    again = Plant(tmp_path)
    assert again.parts(retune)["A-1"].waiting
    yield again, retune, cut.id
    again.close()


def test_a_loop_cut_short_and_locked_before_the_next_start_is_skipped_also_after_the_unlock(
    cut_short: tuple[Plant, str, str],
) -> None:
    plant, retune, cut = cut_short
    plant.jobs.locking.lock("A-1", "valve is being overhauled", "night shift")
    for _ in range(3):
        plant.settle()
    row, parts = plant.fleet.get(retune)
    assert (row.state, [part.state(True) for part in parts]) == ("done", ["skipped", "proposed"])
    part = parts[0]
    assert (part.job_id, part.reason, part.failed) == (cut, "locked", False) and part.detail is not None
    assert "night shift" in part.detail and "valve is being overhauled" in part.detail
    plant.jobs.locking.unlock("A-1", "night shift")
    plant.fleet.poll()
    assert plant.running() == [] and len(plant.store.recent()) == 2


def test_a_loop_cut_short_and_gone_at_the_next_start_is_said_so_and_counts_as_failed(
    cut_short: tuple[Plant, str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    plant, retune, cut = cut_short
    del plant.loops["A-1"]
    given_up: list[str] = []
    give_up = batches.give_up

    def counted(session: Session, batch_id: str, position: int, detail: str, reason: Reason | None = None) -> None:
        given_up.append(detail)
        give_up(session, batch_id, position, detail, reason)

    monkeypatch.setattr(batches, "give_up", counted)
    for _ in range(3):
        plant.settle()
    part = plant.parts(retune)["A-1"]
    assert (part.job_id, part.reason, part.detail, part.failed) == (cut, None, "there is no loop A-1", True)
    assert plant.state(retune) == "done" and given_up == ["there is no loop A-1"]


def of_another_version(plant: Plant, batch_id: str) -> None:
    """The stored request has an option that this version does not know."""
    with plant.store.writing() as session:
        row = batches.find(session, batch_id)
        row.request = {**row.request, "renamed_since": 1}


def test_a_stored_request_that_this_version_does_not_take_ends_its_retune_and_no_other(plant: Plant) -> None:
    old = plant.fleet.start(asked(loops=["A-1", "A-2"], at_once_per_bus=1)).id
    plant.hold()
    plant.fleet.poll()
    assert plant.running() == ["A-1"]
    of_another_version(plant, old)
    new = plant.fleet.start(asked(loops=["B-Y1"])).id
    plant.fleet.poll()
    assert plant.running() == ["A-1", "B-Y1"] and plant.state(old) == "stopping"
    plant.settle()
    row, parts = plant.fleet.get(old)
    assert (row.state, row.stop_reason, plant.state(new)) == ("stopped", "service_stopped", "done")
    assert row.detail is not None and "renamed_since: no option of fast" in row.detail
    assert row.detail.endswith("Ask anew for the loops not begun: A-2")
    assert [part.state(False) for part in parts] == ["proposed", "skipped"]


def test_a_retune_whose_stored_request_this_version_does_not_take_can_be_aborted(plant: Plant) -> None:
    plant.hold()
    retune = plant.fleet.start(asked(loops=["A-1", "A-2"], at_once_per_bus=1)).id
    plant.fleet.poll()
    of_another_version(plant, retune)
    plant.fleet.abort(retune, "me")
    for row in plant.store.unfinished():
        plant.wait(row.id)
    plant.fleet.poll()
    assert plant.state(retune) == "aborted"


def test_a_defect_in_one_retune_does_not_hold_up_the_others(
    plant: Plant, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    first = plant.fleet.start(asked(loops=["A-1"])).id
    plant.fleet.start(asked(loops=["B-1"]))
    plant.hold()
    begin = plant.fleet.begin

    def defective(row: BatchRow, request: FleetRequest, parts: list[Part]) -> None:
        if row.id == first:
            raise KeyError("A-1")
        begin(row, request, parts)

    monkeypatch.setattr(plant.fleet, "begin", defective)
    plant.fleet.poll()
    assert plant.running() == ["B-1"] and f"a defect in the batch {first}" in caplog.text


def test_a_service_that_is_not_to_resume_ends_it(tmp_path: Path) -> None:
    first = Plant(tmp_path)
    retune = first.fleet.start(asked(pattern="A-*")).id
    first.close()
    again = Plant(tmp_path, resume=False)
    again.fleet.boot()
    again.fleet.poll()
    again.fleet.close()
    row, parts = again.fleet.get(retune)
    assert (row.state, row.stop_reason) == ("stopped", "service_stopped") and "--no-resume" in (row.detail or "")
    assert not any(part.job_id for part in parts)
    again.close()


def test_a_restored_back_up_begins_nothing(plant: Plant) -> None:
    retune = plant.fleet.start(asked(pattern="*")).id
    plant.store.restored("backup.sqlite")
    plant.fleet.poll()
    row, _ = plant.fleet.get(retune)
    assert (row.state, row.stop_reason) == ("stopped", "service_stopped") and plant.store.recent() == []


def test_a_loop_that_is_gone_at_the_next_start_is_said_so_and_counts_as_failed(plant: Plant) -> None:
    retune = plant.fleet.start(asked(loops=["A-1", "A-2"])).id
    del plant.loops["A-1"]
    plant.fleet.poll()
    plant.settle()
    part = plant.parts(retune)["A-1"]
    assert part.failed and part.detail == "there is no loop A-1" and plant.state(retune) == "done"


def test_a_dry_run_of_many(plant: Plant) -> None:
    plant.hold()
    plant.jobs.start("A-1", FastRetune())
    retune = plant.fleet.start(asked(pattern="A-*", dry_run=True)).id
    for _ in range(5):
        plant.fleet.poll()
        for part in plant.parts(retune).values():
            if part.job_id:
                plant.wait(part.job_id)
    assert plant.state(retune) == "done" and plant.running() == ["A-1"]


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({"loops": ["A-1", "Z-1", "Z-2"]}, ["Z-1", "Z-2"]),
        ({"pattern": "Q*"}, ["no loop has a tag like 'Q*'"]),
        ({"pattern": "A-*", "sp_deviation": 3.0}, ["A-1: sp_deviation 3 is more than", "A-3"]),
    ],
)
def test_what_cannot_be_done_on_all_is_begun_on_none(plant: Plant, body: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(BadFleet) as refused:
        plant.fleet.start(asked(**body))
    assert all(word in str(refused.value) for word in words)
    assert plant.fleet.recent(10) == []


@pytest.mark.parametrize(
    "body", [{}, {"loops": ["A-1"], "pattern": "*"}, {"loops": []}, {"pattern": "*", "start": "zn_pi"}]
)
def test_bad_wishes(body: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        asked(**body)


def idle_jobs(store: Store, entries: list[dict[str, Any]], engine: ThreadEngine) -> Jobs:
    """A host whose jobs stay queued."""
    loops = parse_site({"loops": entries}, "test").loops
    store.own_loops({tag: config.model_dump(mode="json") for tag, config in loops.items()})
    engine.launch(lambda job_id: None, {})
    return make_jobs(loops, store, lambda config: FakeLoop(FakeController()), FakeTune(), fake_rehearse, engine=engine)


def test_loops_of_another_host_are_begun_there_and_any_host_may_abort(tmp_path: Path, postgres: Server) -> None:
    database = postgres.database()
    stores = {name: Store(tmp_path / name, database, name) for name in ("a", "b")}
    engine = Deaf()
    a, b = idle_jobs(stores["a"], ENTRIES[:6], engine), idle_jobs(stores["b"], ENTRIES[6:], Deaf())
    fleet = Fleet(a)
    retune = fleet.start(asked(pattern="B-*", at_once_per_area=4)).id
    fleet.poll()
    assert [queue for _, queue in engine.enqueued] == ["a:virtual:x"] * 3 + ["b:virtual:y"]
    there = Fleet(b)
    there.poll()  # not its own: nothing more is begun
    assert there.abort(retune, "gateway B").state == "stopping" and len(engine.enqueued) == 4
    assert len(stores["a"].stop_requests()) == 3 and stores["b"].unfinished() == []
    for jobs in (a, b):
        jobs.stop()
    fleet.poll()
    assert there.get(retune)[0].state == "aborted"
    for store in stores.values():
        store.close()


# over HTTP
@pytest.fixture
def client(plant: Plant) -> Iterator[TestClient]:
    with TestClient(app_of(plant.jobs), raise_server_exceptions=False) as client:
        yield client


def until_over(client: TestClient, url: str) -> dict[str, Any]:
    for _ in range(2000):
        found: dict[str, Any] = client.get(url).json()
        if found["ended_at"]:
            return found
    raise AssertionError(found)


def test_a_retune_of_many_over_http(plant: Plant, client: TestClient) -> None:
    answer = client.post("/batches", json={"pattern": "A-*", "at_once_per_bus": 2, "by": "night shift"})
    assert answer.status_code == 202 and answer.headers["location"] == answer.json()["url"]
    body = until_over(client, answer.headers["location"])
    assert body["state"] == "done" and body["counts"] == {"proposed": 3} and body["failures"] == 0
    assert body["request"]["at_once_per_bus"] == 2 and body["by"] == "night shift"
    for part in body["loops"]:
        job = client.get(part["job"]).json()
        assert (job["loop"], job["state"]) == (part["loop"], part["state"]) == (part["loop"], "proposed")
    assert client.post(f"{body['url']}/abort").status_code == 409
    assert client.get("/batches/none").status_code == 404
    assert client.post("/batches/none/abort").status_code == 404
    refused = client.post("/batches", json={"by": "me", "loops": ["Z"]})
    assert refused.status_code == 422 and refused.json()["reason"] == "bad_input"
    assert [one["id"] for one in client.get("/batches").json()] == [body["id"]]


def test_loops_by_state(plant: Plant, client: TestClient) -> None:
    def tags(state: str) -> list[str]:
        return [loop["tag"] for loop in client.get("/loops", params={"state": state}).json()]

    plant.wait(plant.jobs.start("A-1", FastRetune()).id)
    plant.tune.ends = Failed(Reason.NODE_LOST, "silent")
    plant.wait(plant.jobs.start("A-2", FastRetune()).id)
    plant.wait(plant.jobs.start("A-2", retune_request(dry_run=True)).id)  # does not count
    plant.hold()
    plant.tune.inside.clear()
    plant.jobs.start("A-3", FastRetune())
    assert plant.tune.inside.wait(60)
    assert tags("proposed") == ["A-1"] and tags("failed") == ["A-2"]
    assert tags("busy") == tags("running") == ["A-3"]
    assert tags("idle") == [tag for tag in TAGS if tag != "A-3"] and tags("accepted") == []
    assert client.get("/loops/A-1").json()["last_job_state"] == "proposed"
    assert client.get("/loops", params={"state": "tired"}).status_code == 422


def pages(client: TestClient, path: str, **params: Any) -> list[list[dict[str, Any]]]:
    found, answer = [], client.get(path, params=params or None)
    while True:
        found.append(answer.json())
        following = answer.links.get("next")
        if following is None:
            return found
        answer = client.get(following["url"])


def test_pages_hold_everything_once_also_while_new_jobs_come(plant: Plant, client: TestClient) -> None:
    assert [[loop["tag"] for loop in page] for page in pages(client, "/loops", limit=3)] == [
        ["A-1", "A-2", "A-3"], ["B-1", "B-2", "B-3"], ["B-Y1", "B-Y2"],
    ]  # fmt: skip
    assert [len(page) for page in pages(client, "/loops", limit=4, state="idle")] == [4, 4]
    ids = []
    for n in range(7):
        job = plant.jobs.start("A-1" if n % 2 else "A-2", FastRetune()).id
        plant.wait(job)
        ids.insert(0, job)
    first = client.get("/jobs", params={"limit": 3, "state": "proposed"})
    newer = plant.jobs.start("A-3", FastRetune()).id
    plant.wait(newer)
    rest = pages(client, first.links["next"]["url"])
    assert [job["id"] for page in [first.json(), *rest] for job in page] == ids
    assert [[job["id"] for job in page] for page in pages(client, "/loops/A-1/jobs", limit=2)] == [
        [ids[1], ids[3]], [ids[5]],
    ]  # fmt: skip
    assert client.get("/loops/Z/jobs").status_code == 404
    assert client.get("/jobs", params={"cursor": "x"}).status_code == 422


def test_the_command_line_gets_the_whole_list(monkeypatch: pytest.MonkeyPatch) -> None:
    def answer(request: httpx.Request) -> httpx.Response:
        at = int(request.url.params.get("cursor", 0))
        links = {"Link": f'</loops?limit=2&cursor={at + 2}>; rel="next"'} if at < 4 else {}
        return httpx.Response(200, json=[at, at + 1], headers=links)

    client = Client("http://gateway")
    monkeypatch.setattr(client, "_http", httpx.Client(base_url="http://gateway", transport=httpx.MockTransport(answer)))
    assert client.pages("/loops") == [0, 1, 2, 3, 4, 5]


def test_unknown(plant: Plant) -> None:
    with pytest.raises(NoSuchBatch):
        plant.fleet.get("none")


def reasons(plant: Plant) -> list[Reason | None]:
    return [running.stop_reason for running in plant.jobs.registry.running.copy().values()]


@pytest.mark.parametrize("kept", [True, False])
def test_a_request_that_was_answered_with_an_error_begins_nothing(
    plant: Plant, monkeypatch: pytest.MonkeyPatch, kept: bool
) -> None:
    """Also while the answer to its COMMIT is awaited."""
    answers = LosesAnswers(plant.store, monkeypatch)
    lose = answers.lose

    def lost() -> None:
        plant.fleet.poll()
        lose()

    monkeypatch.setattr(answers, "lose", lost)
    answers.lose_next(kept)
    with pytest.raises(OperationalError):
        plant.fleet.start(asked(pattern="*"))
    assert answers.lost
    for _ in range(2):
        plant.fleet.poll()
    assert not plant.store.recent()
    shown = [(row.state, row.detail) for row, _ in plant.fleet.recent(10)]
    assert shown == ([("stopped", "its request was answered with an error: ask anew")] if kept else [])
    plant.fleet.start(asked(pattern="*"))
    plant.fleet.poll()
    assert plant.store.recent()


def test_an_abort_that_the_database_does_not_take_is_heard_at_once_and_kept(
    plant: Plant, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant.hold()
    plant.jobs.start("B-Y1", FastRetune())  # of nobody's retune: it goes on
    retune = plant.fleet.start(asked(pattern="A-*", at_once_per_bus=2)).id
    plant.fleet.poll()
    until(lambda: len(plant.jobs.registry.running) == 3)
    with monkeypatch.context() as patch:
        patch.setattr(plant.store, "writing", away)
        assert client.post(f"/batches/{retune}/abort", json={"by": "operator A"}).status_code == 202
        assert client.post(f"/batches/{retune}/abort", json={"by": "operator A"}).status_code == 202
        assert sorted(map(str, reasons(plant))) == ["None", "operator", "operator"]
    assert plant.jobs.journal.flush(PATIENCE_S)
    until(lambda: plant.running() == ["B-Y1"])
    until(lambda: plant.state(retune) == "aborted")
    parts = plant.parts(retune)
    assert [parts[f"A-{n}"].job_state for n in (1, 2, 3)] == [JobState.ABORTED, JobState.ABORTED, None]
    trail = [(row.what, row.by) for row in audit.trail(plant.store.engine, 100) if "abort" in row.what]
    assert sorted(trail) == [("abort", f"batch {retune}")] * 2 + [("batch_abort", "operator A")]


def test_no_more_loops_are_begun_while_an_abort_waits_for_the_database(
    plant: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant.hold()
    retune = plant.fleet.start(asked(pattern="A-*", at_once_per_bus=1)).id
    plant.fleet.poll()
    until(lambda: len(plant.jobs.registry.running) == 1)
    waiting: list[Write] = []
    with monkeypatch.context() as patch:
        patch.setattr(plant.jobs.journal, "put", waiting.append)
        with monkeypatch.context() as inner:
            inner.setattr(plant.store, "writing", away)
            plant.fleet.abort(retune, "me")
        until(lambda: not plant.running())
        plant.fleet.poll()
        assert plant.running() == [] and plant.state(retune) == "running"
    for write in waiting:
        plant.jobs.journal.put(write)
    assert plant.jobs.journal.flush(PATIENCE_S)
    plant.fleet.poll()
    assert plant.state(retune) == "aborted"


def test_an_abort_while_the_database_answers_nothing_says_that_the_tests_have_heard(
    plant: Plant, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant.hold()
    retune = plant.fleet.start(asked(loops=["A-1", "A-2"])).id
    plant.fleet.poll()
    until(lambda: len(plant.jobs.registry.running) == 2)
    with monkeypatch.context() as patch:
        patch.setattr(plant.store, "writing", away)
        patch.setattr(plant.store, "reading", away)
        answer = client.post(f"/batches/{retune}/abort")
        assert answer.status_code == 503 and "the 2 tests of batch" in answer.json()["detail"]
        assert reasons(plant) == [Reason.OPERATOR] * 2
    assert plant.jobs.journal.flush(PATIENCE_S)
    until(lambda: plant.state(retune) == "aborted")


def test_an_abort_of_a_retune_of_which_nothing_runs_is_refused_where_the_database_does_not_take_it(
    plant: Plant, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant.hold()
    plant.jobs.start("A-1", FastRetune())
    until(lambda: len(plant.jobs.registry.running) == 1)
    retune = plant.fleet.start(asked(loops=["A-1"])).id
    with monkeypatch.context() as patch:
        patch.setattr(plant.store, "writing", away)
        assert client.post(f"/batches/{retune}/abort").status_code == 503
    assert reasons(plant) == [None]
    assert client.post(f"/batches/{retune}/abort").status_code == 202
