"""Alarms of a service: over restarts, beside a database that is away, on two gateways of one database, acknowledged."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.exc import OperationalError
from typer.testing import CliRunner

from loopwright.service.alarms.alarm import Alarm, AlarmKind
from loopwright.service.alarms.watch import AlarmWatch, NoSuchAlarm
from loopwright.service.api.metrics import exposition, registry
from loopwright.service.cli import main as cli
from loopwright.service.cli.client import Client
from loopwright.service.errors import Conflict
from loopwright.service.inputs.request import FastRetune
from loopwright.service.jobs.aftercare import Aftercare
from loopwright.service.listening.heard_loop import Heard, InEffect
from loopwright.service.listening.listening import Listening
from loopwright.service.states.job_state import JobState
from loopwright.service.store import audit, unconfirmed_restorations
from loopwright.service.store.jobs import Job
from loopwright.service.store.store import Store
from loopwright.service.store.tables import LoopRow
from loopwright.tuning.plan import Mode
from loopwright.tuning.reasons import Failed, Reason
from tests.unit.service.api.test_api import assert_problem
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import OLD, TAG, FakeController, Service
from tests.unit.service.postgres import Server
from tests.unit.service.processes import until

T0 = 1_769_860_800.0
BUS = "virtual:test"


@pytest.fixture(autouse=True)
def by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """No thread looks after loops: each test says when."""
    monkeypatch.setattr(Aftercare, "start", lambda self: None)


class OpenEar(Listening):
    """A listening that hears what a test puts there. why: why the bus is down."""

    def __init__(self, service: Service) -> None:
        super().__init__(service.jobs.directory.loops, service.store, on=False)
        self.off = {}
        self.reported = True
        self.why: str | None = None
        self.hear()

    @property
    def begun(self) -> bool:
        return self.reported

    def hear(self, **changes: Any) -> None:
        usual = Heard(T0, False, 50.0, 40.0, 50.0, 2, False, False)
        self.heard = dict.fromkeys(("FIC-2",), usual) | {TAG: replace(usual, **changes)}

    def buses(self) -> dict[str, str | None]:
        return {BUS: self.why}


class Clock:
    def __init__(self) -> None:
        self.now_s = T0

    def __call__(self) -> float:
        return self.now_s


class Watched:
    def __init__(self, service: Service) -> None:
        self.service, self.clock = service, Clock()
        self.ear = OpenEar(service)
        self.watch = AlarmWatch(service.jobs, self.ear, clock=self.clock)

    def after(self, seconds: float) -> list[tuple[int, str]]:
        self.clock.now_s += seconds
        return [(alarm.priority, alarm.text) for alarm in self.watch.look()]


@pytest.fixture
def watched(service: Service) -> Watched:
    return Watched(service)


def ended(
    service: Service, how: Exception | None = None, becomes: Callable[[FakeController], None] | None = None
) -> Job:
    """A test that has ended so, after its controller has become so in the middle of it."""
    service.tune.ends = how
    service.tune.hold.clear()
    service.tune.inside.clear()
    row = service.jobs.start(TAG, FastRetune())
    assert service.tune.inside.wait(60)
    if becomes is not None:
        becomes(service.controller)
    service.tune.hold.set()
    service.wait(row.id)
    service.tune.ends = None
    return service.store.get(row.id)


def not_restored(controller: FakeController) -> None:
    """The session is over, and the loop is not as it was, although nobody says that he has moved it."""
    controller.end_session()
    controller.home = replace(controller.home, mode=Mode.MANUAL)


def left(service: Service) -> Job:
    job = ended(service, becomes=not_restored)
    assert (job.state, job.reason, job.restore_unconfirmed) == (JobState.FAILED, Reason.RESTORE_UNCONFIRMED, True)
    return job


def ids(alarms: Sequence[Alarm]) -> list[str]:
    return [alarm.id for alarm in alarms]


# what is heard


def test_what_is_heard_becomes_an_alarm_and_ends_by_itself(watched: Watched) -> None:
    assert watched.after(0.0) == []
    watched.ear.hear(pv=101.0)
    assert watched.after(1.0) == watched.after(2.9) == []
    assert watched.after(0.1) == [(2, "PV is above its limit of 100 degC")]
    watched.ear.why = "no such interface"
    assert watched.after(1.0) == watched.after(1.9) == [(2, "PV is above its limit of 100 degC")]
    assert watched.after(1.1) == [(2, f"Bus {BUS} is down: no such interface")]
    assert [sorted(alarm.loops) for alarm in watched.watch.look()] == [["FIC-2", TAG]]
    watched.ear.why = None
    watched.ear.hear()
    assert watched.after(0.1) and watched.after(3.0) == []


def test_a_bus_that_is_back_gives_its_loops_time(watched: Watched) -> None:
    watched.after(0.0)
    watched.ear.why = "no such interface"
    watched.after(60.0)
    watched.ear.why = None
    watched.ear.hear(silent=True)
    assert watched.after(1.0) == [] and watched.after(3.0) == [(2, "No data")]


def test_before_the_listening_process_has_reported_nothing_is_known(watched: Watched) -> None:
    watched.ear.heard, watched.ear.reported = {}, False
    assert watched.after(0.0) == watched.after(60.0) == []
    watched.ear.reported = True
    assert watched.after(1.0) == watched.after(2.9) == [] and len(watched.after(0.2)) == 2


def test_what_is_not_listened_to_is_no_alarm(service: Service) -> None:
    watch = AlarmWatch(service.jobs, Listening(service.jobs.directory.loops, service.store, on=False))
    assert list(watch.look()) == []


def test_a_trial_of_a_job_of_ours_is_none_and_one_of_others_is(watched: Watched) -> None:
    service = watched.service
    service.tune.hold.clear()
    service.jobs.start(TAG, FastRetune())
    assert service.tune.inside.wait(60)
    watched.ear.hear(on_trial=True, session=True)
    assert watched.after(0.0) == watched.after(6.0) == []
    service.tune.hold.set()
    until(lambda: not service.jobs.under_test())
    assert watched.after(1.0) == watched.after(4.9) == []
    assert watched.after(0.1) == [(2, "Gains are on trial that no job here has begun")]


def test_gains_that_somebody_has_changed_after_they_were_accepted(
    watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = watched.service
    job = ended(service)
    service.jobs.decisions.accept(job.id, "A. Lind")
    accepted_s = time.time()
    monkeypatch.setattr(watched.ear, "gains_read", lambda tag: (OLD, accepted_s - 60.0))
    assert watched.after(0.0) == []
    monkeypatch.setattr(watched.ear, "gains_read", lambda tag: (OLD, accepted_s + 1.0) if tag == TAG else None)
    ((priority, text),) = watched.after(1.0)
    assert priority == 3 and text.startswith("The gains differ from those accepted last: Kp 0.5,")
    (alarm,) = watched.watch.look()
    watched.watch.acknowledge(alarm.id, "B. Berg")
    assert watched.after(1.0) == []
    service.jobs.decisions.rollback(job.id, "A. Lind")
    assert watched.after(1.0) == [], "nothing is accepted any more"


def test_the_gains_that_were_read_have_the_time_of_the_reading(service: Service) -> None:
    loop = service.jobs.directory.in_effect(TAG)
    assert isinstance(loop, InEffect) and abs(loop.began_s - time.time()) < 60.0


# the database


def test_while_the_database_is_away_the_buses_are_watched(watched: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    ended(watched.service, Failed(Reason.NODE_LOST, "silent"))
    assert watched.after(0.0) == [(3, "The last test failed: node lost")]

    def away(*_: object) -> None:
        raise OperationalError("SELECT", {}, Exception("the database is locked"))

    monkeypatch.setattr("loopwright.service.alarms.facts.latest_tests", away)
    watched.ear.why = "no such interface"
    watched.after(1.0)
    assert [priority for priority, _ in watched.after(3.0)] == [2, 3]


def test_each_change_is_reported_once(watched: Watched) -> None:
    changes: list[int] = []
    watched.watch.on_change = lambda: changes.append(len(watched.watch.latest or ()))
    for _ in range(3):
        watched.after(1.0)
    ended(watched.service, Failed(Reason.NODE_LOST, "silent"))
    for _ in range(3):
        watched.after(1.0)
    assert changes == [0, 1]


def test_the_next_test_ends_the_alarm_of_the_last_one(watched: Watched) -> None:
    service = watched.service
    ended(service, Failed(Reason.NODE_LOST, "silent"))
    assert len(watched.after(0.0)) == 1
    service.tune.hold.clear()
    job = service.jobs.start(TAG, FastRetune())
    assert watched.after(1.0) == []
    service.tune.hold.set()
    service.wait(job.id)
    assert service.store.get(job.id).state == JobState.PROPOSED and watched.after(1.0) == []


def test_a_loop_that_was_not_confirmed_stays_an_alarm_over_restarts_until_it_is_acknowledged(tmp_path: Path) -> None:
    with closing(Service(tmp_path)) as first:
        job = left(first)
        (alarm,) = Watched(first).watch.look()
        assert (alarm.priority, alarm.kind, alarm.loop) == (1, AlarmKind.NOT_RESTORED, TAG)
        assert alarm.job == f"/jobs/{job.id}" and "Look at the controller now" in alarm.advice
    with closing(Service(tmp_path)) as second:
        assert unconfirmed_restorations.confirmed(second.store, job.id, {}, "read back")
        ended(second)
        watched = Watched(second)
        (again,) = watched.watch.look()
        assert again.id == alarm.id and again.since == alarm.since, "although a later test has ended well"
        assert again.advice.startswith("The loop was read back later")
        signed = watched.watch.acknowledge(alarm.id, "A. Lind")
        assert signed.acknowledged is not None and signed.acknowledged.by == "A. Lind"
        assert list(watched.watch.look()) == []
    with closing(Service(tmp_path)) as third:
        watched = Watched(third)
        assert list(watched.watch.look()) == []
        assert watched.watch.find(alarm.id) == signed
        (entry,) = audit.trail(third.store.engine, 10, what=["acknowledge_alarm"])
        assert (entry.subject, entry.loop, entry.by) == (alarm.id, TAG, "A. Lind")
        assert entry.before is not None and entry.before["text"] == alarm.text


def test_whoever_answers_for_the_loop_has_acknowledged_the_alarm(watched: Watched) -> None:
    job = left(watched.service)
    (alarm,) = watched.watch.look()
    assert watched.service.jobs.aftercare.acknowledge(TAG, "B. Berg") == [job.id]
    assert list(watched.watch.look()) == [], "neither of the loop nor of the test"
    found = watched.watch.find(alarm.id)
    assert found.acknowledged is not None and found.acknowledged.by == "B. Berg"
    with pytest.raises(Conflict, match=r"was acknowledged by B\. Berg"):
        watched.watch.acknowledge(alarm.id, "A. Lind")


def test_a_loop_that_is_looked_after_for_another_reason_is_an_alarm_until_it_is_home(watched: Watched) -> None:
    def gone(controller: FakeController) -> None:
        controller.absent = Reason.NODE_LOST

    service = watched.service
    job = ended(service, becomes=gone)
    assert (job.reason, job.restore_unconfirmed) == (Reason.NODE_LOST, True)
    assert [priority for priority, _ in watched.after(0.0)] == [1]
    assert unconfirmed_restorations.confirmed(service.store, job.id, {}, "read back")
    assert watched.after(1.0) == [(3, "The last test failed: node lost")]


# two gateways


@pytest.fixture
def two(postgres: Server, tmp_path: Path) -> Iterator[tuple[Store, Store]]:
    url = postgres.database()
    stores = Store(tmp_path / "1", url, "gw-1"), Store(tmp_path / "2", url, "gw-2")
    with stores[0].writing() as session:
        session.add(LoopRow(tag="A", host="gw-1", config={}))
    yield stores
    for store in stores:
        store.close()


class Gateway:
    """As much of the jobs of a gateway as its alarms want."""

    def __init__(self, store: Store) -> None:
        self.store = store
        self.directory = self
        self.loops: dict[str, object] = {}

    def under_test(self) -> dict[str, str]:
        return {}


def test_two_gateways_of_one_database_say_the_same_and_do_not_double(two: tuple[Store, Store]) -> None:
    job = two[0].create("A", {}, "me", False)
    two[0].move(job.id, JobState.RUNNING)
    two[0].move(job.id, JobState.FAILED, reason=Reason.RESTORE_UNCONFIRMED.value, restore_unconfirmed=True)
    watches = [AlarmWatch(Gateway(store), Listening({}, store, on=False)) for store in two]
    one, other = (list(watch.look()) for watch in watches)
    assert one == other and [(alarm.priority, alarm.gateway) for alarm in one] == [(1, "gw-1")]
    assert [watch.counts() for watch in watches] == [{1: 1, 2: 0, 3: 0}, {1: 0, 2: 0, 3: 0}]
    watches[1].acknowledge(one[0].id, "A. Lind")
    assert ids(watches[0].look()) == ids(watches[1].look()) == []
    with pytest.raises(Conflict, match=r"was acknowledged by A\. Lind"):
        watches[0].acknowledge(one[0].id, "B. Berg")


def test_of_two_who_sign_at_the_same_time_one_is_told_of_the_other(
    two: tuple[Store, Store], monkeypatch: pytest.MonkeyPatch
) -> None:
    job = two[0].create("A", {}, "me", False)
    two[0].move(job.id, JobState.FAILED, reason=Reason.RESTORE_UNCONFIRMED.value)
    slow, fast = (AlarmWatch(Gateway(store), Listening({}, store, on=False)) for store in two)
    (alarm,) = slow.look()
    monkeypatch.setattr(slow, "look", lambda fresh_s=0.0: [alarm])
    fast.acknowledge(alarm.id, "A. Lind")
    with pytest.raises(Conflict, match=r"was acknowledged by A\. Lind"):
        slow.acknowledge(alarm.id, "B. Berg")
    assert len(audit.trail(two[0].engine, 10, what=["acknowledge_alarm"])) == 1


# REST and the command line


def test_over_rest(service: Service, client: TestClient) -> None:
    assert client.get("/alarms").json() == []
    job = left(service)
    time_of = service.store.get(job.id).ended_at
    alarm = the_alarm(client)
    assert (alarm["priority"], alarm["kind"], alarm["subject"], alarm["loops"]) == (1, "not_restored", TAG, [TAG])
    assert (alarm["since"], alarm["job"], alarm["acknowledged"]) == (time_of, f"/jobs/{job.id}", None)
    assert client.get(f"/alarms/{alarm['id']}").json() == alarm
    answer = client.post(f"/alarms/{alarm['id']}/acknowledge", json={"by": "A. Lind"})
    assert answer.status_code == 200 and answer.json()["acknowledged"]["by"] == "A. Lind"
    assert client.get("/alarms").json() == []
    assert client.get(f"/alarms/{alarm['id']}").json() == answer.json()
    detail = assert_problem(client.post(f"/alarms/{alarm['id']}/acknowledge", json={}), 409)["detail"]
    assert "acknowledged by A. Lind at " in detail
    for path in ("/alarms/none", "/alarms/none/acknowledge"):
        method = "POST" if path.endswith("acknowledge") else "GET"
        assert "there is no alarm none" in assert_problem(client.request(method, path), 404)["detail"]
    assert client.get("/audit?what=acknowledge_alarm").json()[0]["by"] == "A. Lind"


def the_alarm(client: TestClient) -> dict[str, Any]:
    """The only alarm, once a look that is a moment old does no longer count."""
    until(lambda: client.get("/alarms").json())
    (alarm,) = client.get("/alarms").json()
    return dict(alarm)


def test_an_alarm_whose_cause_lasts_is_not_acknowledged(service: Service) -> None:
    watched = Watched(service)
    watched.ear.why = "no such interface"
    watched.after(0.0)
    watched.after(3.0)
    (alarm,) = watched.watch.look()
    with TestClient(app_of(service.jobs, listening=watched.ear, alarms=watched.watch)) as client:
        detail = assert_problem(client.post(f"/alarms/{alarm.id}/acknowledge", json={"by": "me"}), 409)["detail"]
        assert detail == (
            "an alarm of priority 2 is not acknowledged: it goes by itself 3 s after its cause has gone. "
            f"{BUS}: Bus {BUS} is down: no such interface"
        )
        lines = client.get("/metrics").text.splitlines()
        assert [line for line in lines if line.startswith("loopwright_alarms")] == [
            'loopwright_alarms{priority="1"} 0.0', 'loopwright_alarms{priority="2"} 1.0',
            'loopwright_alarms{priority="3"} 0.0',
        ]  # fmt: skip
    with pytest.raises(NoSuchAlarm):
        watched.watch.find("none")
    assert b"loopwright_alarms{" not in exposition(registry({}, service.store, {}))


def test_on_the_command_line(service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Client, "__init__", lambda self, url: setattr(self, "_http", client))

    def said(*arguments: str) -> str:
        done = CliRunner().invoke(cli.app, ["alarms", *arguments], catch_exceptions=False)
        assert done.exit_code == 0, done.output
        return done.stdout

    assert said() == "No active alarms.\n"
    left(service)
    alarm = the_alarm(client)
    shown = said()
    assert alarm["id"] in shown and TAG in shown and "Not confirmed" in " ".join(shown.split())
    assert f'"id": "{alarm["id"]}"' in said("--json")
    assert said("--acknowledge", alarm["id"], "--by", "A. Lind").startswith(f"{TAG}: acknowledged by A. Lind at ")
    assert said() == "No active alarms.\n"
