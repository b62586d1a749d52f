"""GET /live behind the real server: who sees what, and when a stream ends."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from sqlalchemy import event as database_event
from sqlalchemy.exc import OperationalError

from loopwright.service.alarms.watch import AlarmWatch
from loopwright.service.api.gate.gate import Policy
from loopwright.service.inputs.request import FastRetune
from loopwright.service.listening.bins import Rows
from loopwright.service.listening.heard_loop import Heard
from loopwright.service.listening.listening import Listening
from loopwright.service.listening.rings import Rings
from loopwright.service.live import live as module
from loopwright.service.live.jobs import LookedUpJobs
from loopwright.service.live.live import Live
from loopwright.service.live.rows import loop_row
from loopwright.service.security.keys import Scope
from loopwright.service.store.keyring import Keyring
from loopwright.tuning.reasons import Failed, Reason
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import TAG, Service
from tests.unit.service.live_viewer import LiveViewer, viewing
from tests.unit.service.processes import until
from tests.unit.service.served import served


class Screens:
    """A service behind a real server, and its live stream."""

    def __init__(self, service: Service, live: Live, listening: Listening, alarms: AlarmWatch, port: int) -> None:
        self.service, self.live, self.listening, self.alarms = service, live, listening, alarms
        self.base = f"http://127.0.0.1:{port}"

    def viewers(self) -> int:
        return self.live.viewers


@contextmanager
def screens_of(service: Service, policy: Policy | None = None) -> Iterator[Screens]:
    listening = Listening(service.jobs.directory.loops, service.store, on=False)
    alarms = AlarmWatch(service.jobs, listening)
    live = Live(service.jobs, listening, alarms)
    with served(app_of(service.jobs, policy, listening=listening, live=live, alarms=alarms)) as door:
        try:
            yield Screens(service, live, listening, alarms, door.port)
        finally:
            live.close()


@pytest.fixture
def screens(service: Service) -> Iterator[Screens]:
    with screens_of(service) as found:
        yield found


def states(viewer: LiveViewer) -> list[str]:
    return [each["data"]["state"] for name, each in viewer.messages if name == "job" and each["kind"] == "state"]


def test_what_comes_first(screens: Screens) -> None:
    with viewing(screens.base, f"/live?loops={TAG}") as viewer:
        assert viewer.answer.headers["content-type"].startswith("text/event-stream")
        assert viewer.answer.headers["x-accel-buffering"] == "no"
        hello = viewer.until("hello")
        assert (hello["gateway"], hello["loops"], hello["back_s"]) == ("local", [TAG], 10.0)
        assert abs(hello["now_s"] - time.time()) < 60.0
        assert viewer.until("samples") == {
            "tag": TAG, "past": True, "n": [], "at_s": [], "sp": [], "pv": [], "mv": [], "mode": [], "gap_before": [],
        }  # fmt: skip
        row = viewer.row(TAG)
        assert row["pv"] is row["sp"] is row["mv"] is row["mode"] is row["age_s"] is row["under_test"] is None
        assert row["no_data"] == "listening is turned off"
        viewer.becomes("jobs", lambda message: message.get("jobs") == [])
        viewer.becomes("buses", bool)
        found = dict(viewer.messages)
        assert found["buses"]["buses"] == [
            {"gateway": "local", "bus": "virtual:test", "up": None, "why": "listening is turned off"}
        ]


def test_every_viewer_sees_a_test_from_its_first_event_to_its_decision(screens: Screens) -> None:
    service = screens.service
    service.tune.hold.clear()
    job = service.jobs.start(TAG, FastRetune(by="A. Lind")).id
    until(lambda: service.store.get(job).state == "running")
    with (
        viewing(screens.base, f"/live?loops={TAG}") as early,
        viewing(screens.base) as elsewhere,
    ):
        live = early.until("jobs", lambda message: message["jobs"])["jobs"][0]
        assert (live["id"], live["loop"], live["by"], live["stopping"]) == (job, TAG, "A. Lind", False)
        assert early.row(TAG, lambda row: row["job"])["last_job"] == {"url": f"/jobs/{job}", "state": "running"}
        service.tune.hold.set()
        early.until("job", lambda each: each["data"].get("state") == "proposed")
        early.becomes("jobs", lambda message: message.get("jobs") == [])
        service.jobs.decisions.rollback(job, "B. Berg")
        early.until("job", lambda each: each["data"].get("state") == "rolled_back")
        assert states(early) == ["queued", "running", "proposed", "rolled_back"]
        stored = [f"{job}.{each.seq}" for each in service.store.events(job)]
        assert early.ids == stored, "each event once, in order"
        elsewhere.row(TAG, lambda row: row["last_job"]["state"] == "rolled_back")
        assert not elsewhere.ids
    with viewing(screens.base, f"/live?loops={TAG}", last_event_id=stored[2]) as again:
        again.until("job", lambda each: each["data"].get("state") == "rolled_back")
        assert again.ids == stored[3:]
    with viewing(screens.base, f"/live?loops={TAG}") as later:
        later.until("loops")
        later.until("loops")
        assert not later.ids, "what was over before is not told"


def test_alarms_come_first_and_on_every_change_as_a_whole(screens: Screens) -> None:
    service = screens.service
    with viewing(screens.base) as viewer:
        viewer.becomes("alarms", lambda message: message.get("alarms") == [])
        service.tune.ends = Failed(Reason.NODE_LOST, "silent")
        service.wait(service.jobs.start(TAG, FastRetune()).id)
        (alarm,) = viewer.until("alarms")["alarms"]
        assert (alarm["priority"], alarm["loop"], alarm["text"]) == (3, TAG, "The last test failed: node lost")
        with viewing(screens.base) as later:
            later.becomes("alarms", lambda message: message.get("alarms") == [alarm])
            screens.alarms.acknowledge(alarm["id"], "A. Lind")
            for each in (viewer, later):
                each.becomes("alarms", lambda message: message.get("alarms") == [])
        seen = [message for name, message in viewer.messages if name == "alarms"]
        assert seen == [{"alarms": []}, {"alarms": [alarm]}, {"alarms": []}]


def test_many_viewers_ask_the_database_as_often_as_one(screens: Screens) -> None:
    asked: list[float] = []

    @database_event.listens_for(screens.service.store.engine, "before_cursor_execute")
    def _(*arguments: object) -> None:
        if 'jobs.dry_run, jobs."by"' in str(arguments[2]):  # no other query has these side by side
            asked.append(time.monotonic())

    with viewing(screens.base) as first:
        others = [viewing(screens.base) for _ in range(10)]
        viewers = [first, *(each.__enter__() for each in others)]
        try:
            for viewer in viewers:
                viewer.until("loops")
            begin, before = time.monotonic(), len(asked)
            for _ in range(3):
                first.until("loops")
            most = 2.0 * (time.monotonic() - begin) / module.LOOK_S + 2.0
            assert 0 < len(asked) - before <= most
        finally:
            for each in others:
                each.__exit__(None, None, None)
    until(lambda: screens.viewers() == 0)


def test_a_loop_that_is_heard_again_and_unknown_numbers(screens: Screens) -> None:
    with viewing(screens.base) as viewer:
        viewer.until("loops")
        screens.listening.heard = {TAG: Heard(time.time(), False, 49.5, math.nan, 50.0, 2, None, None)}
        row = viewer.row(TAG, lambda row: row["pv"])
        assert (row["pv"], row["mv"], row["mode"]) == (49.5, None, "automatic")


def test_what_is_heard_before_a_late_answer_is_in_the_past(screens: Screens, monkeypatch: pytest.MonkeyPatch) -> None:
    def memory(tag: str, from_s: float, to_s: float, points: int) -> Rows:
        rings = Rings()
        asked_s = time.time()
        for n in range(4):
            rings.put(asked_s + 0.5 * (n - 1), n, 50.0, 40.0, 50.0, 0, 2, 0)  # two are heard before the answer is made
        return rings.rows(from_s, to_s, points)

    monkeypatch.setattr(screens.listening, "memory", memory)
    with viewing(screens.base, f"/live?loops={TAG}&back_s=60") as viewer:
        assert viewer.until("samples")["n"] == [0, 1, 2, 3]


def test_while_the_database_is_away_the_loops_are_shown(screens: Screens, monkeypatch: pytest.MonkeyPatch) -> None:
    away = threading.Event()
    real = LookedUpJobs.look

    def look(*arguments: object, **more: object) -> None:
        if away.is_set():
            raise OperationalError("SELECT", {}, Exception("the database is locked"))
        real(*arguments, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(LookedUpJobs, "look", look)
    with viewing(screens.base) as viewer:
        viewer.until("loops")
        away.set()
        for _ in range(3):
            viewer.until("loops")
        away.clear()
        screens.service.tune.hold.clear()
        job = screens.service.jobs.start(TAG, FastRetune()).id
        assert viewer.until("jobs", lambda message: message["jobs"])["jobs"][0]["id"] == job
        screens.service.tune.hold.set()


def test_rows_that_could_not_be_made_once_are_made_again(screens: Screens, monkeypatch: pytest.MonkeyPatch) -> None:
    defects: list[str] = []

    def defective(tag: str, *arguments: Any) -> object:
        if 0 < len(defects) < 3:
            defects.append(tag)
            raise ValueError("a defect")
        return loop_row(tag, *arguments)

    monkeypatch.setattr("loopwright.service.live.live.loop_row", defective)
    with viewing(screens.base) as viewer:
        viewer.until("loops")
        defects.append("from now on")
        until(lambda: len(defects) == 3)
        viewer.until("loops")
        viewer.until("loops")


def test_a_stream_ends_with_its_key(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "REVOKED_WITHIN_S", 0.05)
    keyring = Keyring(service.store.engine)
    row, key = keyring.create("a", Scope.READ)
    with (
        screens_of(service, Policy(keyring)) as screens,
        viewing(screens.base, authorization=f"Bearer {key}") as viewer,
    ):
        viewer.until("loops")
        keyring.revoke(row.id)
        viewer.rest()
        assert viewer.comments == ["the key of this stream was revoked or has expired"]
        until(lambda: screens.viewers() == 0)


def test_a_stream_ends_with_the_service(screens: Screens) -> None:
    with viewing(screens.base) as viewer:
        viewer.until("loops")
        screens.live.close()
        viewer.rest()


@pytest.mark.parametrize(
    ("query", "status"),
    [("loops=NONE", 404), ("back_s=601", 422), ("back_s=nan", 422), ("loops=" + ",".join("ABCDEFGHI"), 422)],
)
def test_what_is_refused(screens: Screens, query: str, status: int) -> None:
    with pytest.raises(AssertionError) as refused, viewing(screens.base, f"/live?{query}"):
        pass
    assert f'"status":{status}' in str(refused.value)
