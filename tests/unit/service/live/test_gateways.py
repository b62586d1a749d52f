"""What one gateway shows of another one's loops: its rows, how old they are, and what is said when there are none."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import event
from sqlalchemy.exc import OperationalError

from loopwright.service.inputs.request import FastRetune
from loopwright.service.listening.heard_loop import Heard
from loopwright.service.live import other_gateways, own_gateway
from loopwright.service.live.live import Live
from loopwright.service.live.other_gateways import OtherGateways
from loopwright.service.live.own_gateway import Announcing, OwnGateway
from loopwright.service.store import gateways
from loopwright.tuning.reasons import Reason
from tests.unit.service.fakes import NEW, OLD, Service
from tests.unit.service.live_viewer import viewing
from tests.unit.service.postgres import Server
from tests.unit.service.processes import until
from tests.unit.service.served import served
from tests.unit.service.two_gateways import HERE, TAG_HERE, TAG_THERE, THERE, OneGateway, TwoGateways, two_gateways


@pytest.fixture
def fleet(tmp_path: Path, postgres: Server) -> Iterator[TwoGateways]:
    with two_gateways(tmp_path, postgres.database()) as found:
        yield found


def hears(fleet: TwoGateways, pv: float = 49.5, on_trial: bool = False) -> None:
    """The gateway there has just heard its loop and read its controller, and says so."""
    fleet.there.listening.hears(Heard(time.time(), False, pv, 41.0, 50.0, 2, on_trial, False))
    fleet.there.jobs.directory.read(TAG_THERE)
    fleet.write()
    fleet.here.look_again()


def writing() -> list[threading.Thread]:
    """The threads that write a gateway's row."""
    return [thread for thread in threading.enumerate() if thread.name == "row of this gateway"]


def detail(fleet: TwoGateways) -> Any:
    fleet.here.look_again()
    answer = fleet.here.http.get(f"/loops/{TAG_THERE}")
    assert answer.status_code == 200, answer.text
    return answer.json()


def detail_here(fleet: TwoGateways) -> Any:
    return fleet.here.http.get(f"/loops/{TAG_HERE}").json()


def test_a_loop_of_another_gateway_is_shown_as_it_is_there(fleet: TwoGateways) -> None:
    hears(fleet)
    found = detail(fleet)
    live = found["live"]
    assert found["gateway"] == THERE and found["live_error"] is None
    assert (live["pv"], live["sp"], live["mv"], live["mode"], live["on_trial"]) == (
        49.5,
        50.0,
        41.0,
        "automatic",
        False,
    )
    assert (live["gains"]["Kp"], live["gains"]["Ti"], live["sample_time_s"]) == (OLD.Kp, OLD.Ti, 0.1)
    assert (live["mv_low"], live["mv_high"], live["reverse_acting"]) == (0.0, 100.0, True)
    assert fleet.here.http.get(f"/loops/{TAG_HERE}").json()["gateway"] == HERE


def test_gains_that_differ_from_those_accepted_are_seen_from_another_gateway(fleet: TwoGateways) -> None:
    job = fleet.there.proposed()
    hears(fleet)
    assert fleet.here.decide(job, "accept").status_code == 200
    differ = [fleet.here.http.get("/loops").json()[1]["gains_differ"]]
    hears(fleet)
    differ.append(fleet.here.http.get("/loops").json()[1]["gains_differ"])
    assert detail(fleet)["live"]["gains"]["Kp"] == NEW.Kp and detail(fleet)["gains_differ"] is False
    fleet.there.controller.by_hand(gains=OLD)
    hears(fleet)
    differ.append(fleet.here.http.get("/loops").json()[1]["gains_differ"])
    hears(fleet, on_trial=True)
    differ.append(fleet.here.http.get("/loops").json()[1]["gains_differ"])
    assert differ[1:] == [False, True, None]


@pytest.mark.parametrize(("age_s", "words"), [
    (-10.0, None), (4.0, f"no data from gateway {THERE} for "), (10.5, f"gateway {THERE} does not answer"),
    (90_000.0, "last there 25 h ago"), (300_000.0, "3 days ago"),
])  # fmt: skip
def test_old_rows_are_not_shown_as_new(fleet: TwoGateways, age_s: float, words: str | None) -> None:
    hears(fleet)
    fleet.age(age_s)
    found = detail(fleet)
    if words is None:
        assert found["live"]["pv"] == 49.5 and found["live_error"] is None
    else:
        assert found["live"] is None and words in found["live_error"]["detail"]
        assert found["live_error"]["reason"] == "gateway_lost" and found["live_error"]["advice"]
    row = fleet.here.others.values(TAG_THERE, THERE)
    assert (row.pv is None) == (words is not None)
    assert (row.no_data is None) == (words is None)
    last = found["last_data"]
    if words is None:
        assert last is None and row.last is None
    else:
        assert [last[name] for name in ("pv", "sp", "mv", "mode")] == [49.5, 50.0, 41.0, "automatic"]
        assert row.age_s is not None and age_s < last["age_s"] <= row.age_s
    listed = {each["name"]: each for each in fleet.here.http.get("/gateways").json()}
    assert (listed[HERE]["answers"], listed[THERE]["answers"]) == (True, age_s <= 10.0)


@pytest.mark.parametrize(("age_s", "words"), [
    (0.0, None), (3.0, None), (3.1, "no data from gateway gw-2 for 3 s"), (10.0, "no data from gateway gw-2 for 10 s"),
    (10.1, "gateway gw-2 does not answer: it was last there 10 s ago"),
    (150.0, "gateway gw-2 does not answer: it was last there 2 min ago"),
])  # fmt: skip
def test_the_ages_at_which_it_changes(
    fleet: TwoGateways, monkeypatch: pytest.MonkeyPatch, age_s: float, words: str | None
) -> None:
    """A part of the age it had when it was read, the rest has passed since."""
    hears(fleet)
    row = gateways.every(fleet.here.store)[THERE]
    since_s = min(age_s / 2, 2.0)
    monkeypatch.setattr(gateways, "every", lambda _: {THERE: replace(row, age_s=age_s - since_s)})
    clock = [100.0]
    others = OtherGateways(fleet.here.store, lambda: clock[0])
    others.look()
    clock[0] += since_s
    assert others.why_no_data(THERE) == words and others.answers(THERE) == (age_s <= 10.0)
    found = others.values(TAG_THERE, THERE)
    assert (found.pv is None) == (words is not None) and found.age_s is not None and found.age_s >= age_s


def test_a_loop_that_is_silent_there_has_the_age_of_its_last_sample(fleet: TwoGateways) -> None:
    fleet.there.listening.hears(Heard(time.time() - 60.0, True, 49.5, 41.0, 50.0, 2, False, False))
    fleet.write()
    fleet.age(5.0)
    found = detail(fleet)
    assert found["live"] is None and found["last_data"]["pv"] == 49.5 and found["last_data"]["age_s"] > 65.0


def test_what_a_job_has_read_is_as_old_as_what_its_gateway_has_said(fleet: TwoGateways) -> None:
    """A bus that is not listened to: the job that runs on the loop knows it, and its reading has no age of its own."""
    fleet.there.tune.hold.clear()
    fleet.there.jobs.start(TAG_THERE, FastRetune())
    assert fleet.there.tune.inside.wait(60)
    fleet.there.listening.hears(None, down="this bus cannot be opened by a second process")
    fleet.write()
    fleet.age(5.0)
    row = fleet.here.others.values(TAG_THERE, THERE)
    assert row.last is None, "not looked at yet"
    fleet.here.look_again()
    fleet.here.others.look()
    row = fleet.here.others.values(TAG_THERE, THERE)
    assert row.pv is None and row.last is not None and row.last.sp == 50.0
    assert row.age_s is not None and 5.0 < row.age_s < 60.0


def test_a_loop_that_was_never_heard_has_no_old_values(fleet: TwoGateways) -> None:
    fleet.age(5.0)
    assert detail(fleet)["last_data"] is None
    assert detail_here(fleet)["last_data"] is None


def test_a_loop_of_this_gateway_that_has_fallen_silent(fleet: TwoGateways) -> None:
    fleet.here.listening.hears(Heard(time.time() - 60.0, True, 49.5, 41.0, 50.0, 2, False, False))
    fleet.here.controller.absent = Reason.NODE_LOST
    found = detail_here(fleet)
    assert found["live"] is None and found["live_error"]["reason"] == "node_lost"
    assert found["last_data"]["pv"] == 49.5 and found["last_data"]["age_s"] > 59.0


def test_how_far_a_job_of_the_other_gateway_has_come(fleet: TwoGateways) -> None:
    """Of a gateway that says nothing it is what its job has stored: nothing before its first stage."""
    fleet.there.tune.hold.clear()
    job = fleet.there.http.post(f"/loops/{TAG_THERE}/retune", json={"by": "me"}).json()["url"]
    assert fleet.there.tune.inside.wait(60)
    fleet.write()

    def figures(gateway: OneGateway) -> list[object]:
        gateway.look_again()
        found = gateway.http.get(job).json()
        return [found[name] for name in ("stage", "progress", "remaining_plant_time_s", "plant_time_s")]

    present = json.loads(gateways.every(fleet.here.store)[THERE].present)
    (said,) = present["jobs"]
    assert figures(fleet.here) == [said[name] for name in _FIGURES]
    said |= {"stage": "verify", "progress": 0.75, "remaining_plant_time_s": 12.5, "plant_time_s": 30.5}
    fleet.here.sql("UPDATE gateways SET present = :text", text=json.dumps(present))
    assert figures(fleet.here) == ["verify", 0.75, 12.5, 30.5]
    with served(fleet.here.app) as door, httpx.stream("GET", f"http://127.0.0.1:{door.port}{job}/events") as stream:
        data = (json.loads(line[6:]) for line in stream.iter_lines() if line.startswith("data: "))
        progress = next(event for event in data if event["kind"] == "progress")
        fleet.age(12.0)
        until(lambda: figures(fleet.here)[:2] == ["preflight", 0.0])
        fleet.there.tune.hold.set()
    assert [progress[name] for name in _FIGURES] == ["verify", 0.75, 12.5, 30.5]


_FIGURES = ("stage", "progress", "remaining_plant_time_s", "plant_time_s")


def test_a_bus_that_is_down_there(fleet: TwoGateways) -> None:
    hears(fleet)
    fleet.there.listening.hears(None, down="nobody is there")
    fleet.write()
    error = detail(fleet)["live_error"]
    assert error["reason"] == "bus_lost" and error["detail"] == f"gateway {THERE}: nobody is there"
    assert [(bus.gateway, bus.up) for bus in fleet.here.others.buses()] == [(THERE, False)]


def test_the_gateways(fleet: TwoGateways) -> None:
    fleet.here.others.look()
    found = fleet.here.http.get("/gateways").json()
    assert [(each["name"], each["here"], each["loops"]) for each in found] == [(HERE, True, 1), (THERE, False, 1)]
    there = found[1]
    assert (there["url"], there["answers"]) == (f"https://{THERE}.example", True) and there["last_seen"].endswith("Z")
    assert [bus["bus"] for bus in there["buses"]] == ["virtual:test"] and there["version"] == found[0]["version"]
    fleet.here.sql("DELETE FROM gateways")
    fleet.here.look_again()
    there = fleet.here.http.get("/gateways").json()[1]
    assert (there["name"], there["answers"], there["last_seen"], there["version"]) == (THERE, False, None, None)


def test_what_cannot_be_read_is_said(fleet: TwoGateways) -> None:
    fleet.here.sql("UPDATE gateways SET present = '{\"loops\": 3}', version = '9.9'")
    error = detail(fleet)["live_error"]
    assert (
        error["reason"] == "gateway_lost"
        and "of version 9.9 says cannot be read here (buses, jobs, loops)" in (error["detail"])
    )
    hears(fleet)
    assert detail(fleet)["live"] is not None


def test_settings_are_written_when_they_change_and_after_a_row_that_failed(
    fleet: TwoGateways, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, given = gateways.write, []

    def noted(*arguments: Any) -> None:
        given.append(arguments[-1])
        if len(given) == 4:
            raise OperationalError("INSERT", {}, Exception("the server is gone"))
        write(*arguments)

    monkeypatch.setattr(gateways, "write", noted)
    hears(fleet)
    hears(fleet)
    fleet.there.controller.by_hand(gains=NEW)
    hears(fleet)
    with pytest.raises(OperationalError):
        hears(fleet)
    hears(fleet)
    assert [text is not None for text in given] == [True, False, True, False, True]
    assert detail(fleet)["live"]["gains"]["Kp"] == NEW.Kp


def test_however_many_ask_the_database_is_asked_once_a_second(fleet: TwoGateways) -> None:
    asked: list[str] = []

    @event.listens_for(fleet.here.store.engine, "before_cursor_execute")
    def note(_connection: object, _cursor: object, statement: str, *_: object) -> None:
        if "FROM gateways" in statement:
            asked.append(statement)

    clock = [100.0]
    others = OtherGateways(fleet.here.store, lambda: clock[0])
    threads = [threading.Thread(target=others.look) for _ in range(20)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(asked) == 1
    clock[0] += other_gateways.LOOK_S
    others.look()
    assert len(asked) == 2


def test_without_the_database_the_rows_grow_old_and_it_is_said_whose_fault_that_is(
    fleet: TwoGateways, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [100.0]
    others = OtherGateways(fleet.here.store, lambda: clock[0])
    others.look()
    assert others.why_no_data(THERE) is None

    def away(_store: object) -> Any:
        raise OperationalError("SELECT", {}, Exception("the server is gone"))

    with monkeypatch.context() as patch:
        patch.setattr(gateways, "every", away)
        clock[0] += 1e6 + 5.0  # the row of the gateway there is ahead by so much, see TwoGateways.write
        with pytest.raises(OperationalError):
            others.look()
        assert "the database, by which it is seen, does not answer" in str(others.why_no_data(THERE))
        assert others.values(TAG_THERE, THERE).pv is None
    others.look()
    assert others.why_no_data(THERE) is None


def test_the_thread_goes_on_by_itself_when_the_database_is_back(
    fleet: TwoGateways, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(own_gateway, "WRITE_S", 0.02)
    write, tried, away = gateways.write, [], threading.Event()

    def perhaps(*arguments: Any) -> None:
        tried.append(away.is_set())
        if away.is_set():
            raise OperationalError("INSERT", {}, Exception("the server is gone"))
        write(*arguments)

    monkeypatch.setattr(gateways, "write", perhaps)
    fleet.there.announcing.start()
    until(lambda: len(tried) > 2)
    away.set()
    until(lambda: tried.count(True) > 2)
    away.clear()
    fleet.here.sql("DELETE FROM gateways")
    until(lambda: gateways.age_s(fleet.here.store, THERE) is not None)


def test_a_name_that_another_service_has_taken_is_not_written_to(fleet: TwoGateways) -> None:
    """The other service writes the row of this name."""
    before = gateways.every(fleet.here.store)[THERE].at_s
    fleet.here.sql("UPDATE hosts SET claim = 'another', claimed_by = 'process 1' WHERE host = :name", name=THERE)
    fleet.there.announcing.start()
    until(lambda: not writing())
    assert gateways.every(fleet.here.store)[THERE].at_s == before


def test_a_file_is_not_written_to_once_a_second_and_there_is_one_gateway(service: Service) -> None:
    from loopwright.service.listening.listening import Listening
    from tests.unit.service.apps import app_of

    listening = Listening(service.jobs.directory.loops, service.store, on=False)
    announcing = Announcing(service.jobs, OwnGateway(service.jobs, listening))
    announcing.start()
    assert not writing()
    announcing.close()
    (only,) = TestClient(app_of(service.jobs, checks={})).get("/gateways").json()
    assert (only["name"], only["here"], only["answers"], only["loops"], only["url"]) == ("local", True, True, 2, None)


def test_rows_of_gateways_without_loops_are_forgotten_after_30_days(fleet: TwoGateways) -> None:
    fleet.age(0.0)
    gone = "INSERT INTO gateways SELECT :name, at_s - :days * 86400, url, version, present, settings FROM gateways"
    fleet.here.sql(gone, name="old", days=31)
    fleet.here.sql(f"{gone} WHERE name = 'gw-2'", name="younger", days=29)
    fleet.age(31 * 86_400.0)
    gateways.forget(fleet.here.store)
    assert set(gateways.every(fleet.here.store)) == {"younger", THERE}, "one that has loops stays"


def test_the_stream_shows_rows_buses_and_progress_of_the_other_gateway(fleet: TwoGateways) -> None:
    live = Live(fleet.here.jobs, fleet.here.listening, others=fleet.here.others)
    from tests.unit.service.apps import app_of

    app = app_of(fleet.here.jobs, checks={}, listening=fleet.here.listening, live=live, others=fleet.here.others)
    fleet.there.tune.hold.clear()
    job = fleet.there.http.post(f"/loops/{TAG_THERE}/retune", json={"by": "me"}).json()["url"]
    assert fleet.there.tune.inside.wait(20)
    with served(app) as door:
        try:
            hears(fleet)
            with viewing(f"http://127.0.0.1:{door.port}", f"/live?loops={TAG_THERE}") as viewer:
                row = viewer.row(TAG_THERE, lambda row: row["pv"] is not None)
                assert (row["gateway"], row["pv"], row["mode"], row["no_data"]) == (THERE, 49.5, "automatic", None)
                assert row["job"] == job and row["last_job"]["state"] == "running"
                viewer.becomes("jobs", lambda found: found.get("jobs") and found["jobs"][0]["progress"] is not None)
                viewer.becomes("buses", lambda found: any(bus["gateway"] == THERE for bus in found.get("buses", [])))
                fleet.age(12.0)
                row = viewer.row(TAG_THERE, lambda row: row["pv"] is None)
                viewer.row(TAG_THERE, lambda row: f"gateway {THERE} does not answer" in row["no_data"])
                assert row["gateway"] == THERE and row["job"] == job
                fleet.here.sql("DELETE FROM gateways")
                viewer.row(TAG_THERE, lambda row: "has not run since" in row["no_data"])
        finally:
            live.close()


def test_the_row_of_a_hundred_loops_is_small(fleet: TwoGateways) -> None:
    """It is written again and again."""
    hears(fleet)
    present = fleet.there.own.present(time.time())
    present.loops *= 100
    assert 10_000 < len(present.model_dump_json()) < 20_000
