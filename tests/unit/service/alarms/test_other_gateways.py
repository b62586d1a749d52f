"""Alarms of the gateways of one database: each once, acknowledged anywhere, and a gateway that has fallen silent."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy.exc import OperationalError

from loopwright.service.alarms.alarm import Alarm, AlarmKind
from loopwright.service.alarms.conditions import AlarmFacts, GatewayFacts, conditions, to_be_asked
from loopwright.service.alarms.delays import Delays
from loopwright.service.alarms.merging import merged, only_known_here
from loopwright.service.listening.heard_loop import Heard
from loopwright.service.store import gateways
from tests.unit.service.fakes import OLD
from tests.unit.service.postgres import Server
from tests.unit.service.two_gateways import HERE, TAG_HERE, TAG_THERE, THERE, TwoGateways, two_gateways

T0 = 1_769_860_800.0
LONG_AGO_S = T0 - 3600.0
SILENT = GatewayFacts(THERE, T0, True, LONG_AGO_S, (TAG_THERE,))


def alarms_at(delays: Delays, gateway: GatewayFacts, *moments_s: float) -> list[Alarm]:
    """The alarms at the last of these moments, looked at at each of them."""
    found: list[Alarm] = []
    for now_s in moments_s:
        found = delays.step(conditions(AlarmFacts(HERE, gateways=[gateway])), now_s)
    return found


# pure


def test_a_gateway_that_is_there_is_no_alarm() -> None:
    assert alarms_at(Delays(), replace(SILENT, silent=False), T0, T0 + 60.0) == []


def test_a_silent_gateway_is_an_alarm_after_ten_seconds_and_until_three_after_it_is_back() -> None:
    delays = Delays()
    assert alarms_at(delays, SILENT, T0 + 4.0, T0 + 9.9) == []
    (alarm,) = alarms_at(delays, SILENT, T0 + 10.0)
    assert (alarm.priority, alarm.kind, alarm.gateway, alarm.loop, alarm.loops) == (
        2,
        "gateway_offline",
        THERE,
        None,
        [TAG_THERE],
    )
    assert alarm.text == f"Gateway {THERE} does not answer" and alarm.since == "2026-01-31T12:00:00.000Z"
    assert "is not known here" in alarm.advice and not alarm.unacknowledged
    back = replace(SILENT, silent=False, last_s=T0 + 20.0)
    assert alarms_at(delays, back, T0 + 20.0, T0 + 22.9) == [alarm] and alarms_at(delays, back, T0 + 23.0) == []


def test_a_gateway_is_waited_for_since_the_database_has_answered() -> None:
    delays, unseen = Delays(), replace(SILENT, waited_from_s=T0 + 60.0)
    assert alarms_at(delays, unseen, T0 + 60.0, T0 + 69.9) == []
    (alarm,) = alarms_at(delays, unseen, T0 + 70.0)
    assert alarm.since == "2026-01-31T12:00:00.000Z", "when it was last there"


def test_a_gateway_that_never_was_there() -> None:
    delays, never = Delays(), replace(SILENT, last_s=None, waited_from_s=T0)
    assert alarms_at(delays, never, T0, T0 + 9.9) == [] and len(alarms_at(delays, never, T0 + 10.0)) == 1


def alarm(id_: str, kind: AlarmKind = AlarmKind.PV_OUTSIDE_LIMITS, host: str = THERE, **changes: Any) -> Alarm:
    given: dict[str, Any] = {
        "id": id_, "priority": 2, "kind": kind, "subject": TAG_THERE, "text": "text", "advice": "advice", "gateway":
        host, "since": "2026-01-31T12:00:00.000Z", "loop": None, "loops": [], "job": None, "unacknowledged": False,
        "acknowledged": None,
    }  # fmt: skip
    return Alarm(**given | changes)


def facts_with(*theirs: Alarm, acknowledged: Sequence[str] = ()) -> AlarmFacts:
    there = GatewayFacts(THERE, T0, False, LONG_AGO_S, (TAG_THERE,), theirs)
    return AlarmFacts(HERE, gateways=[there], acknowledged=frozenset(acknowledged))


def test_each_alarm_is_once_and_the_worst_first() -> None:
    own, same = alarm("b", host=HERE), alarm("b", text="as the other says it")
    worst = alarm("a", priority=1)
    assert merged([own], facts_with(same, worst)) == [worst, own]


def test_what_a_silent_gateway_has_said_counts_until_that_is_an_alarm() -> None:
    silent = alarm("s", AlarmKind.GATEWAY_OFFLINE)
    assert merged([], facts_with(alarm("a"))) == [alarm("a")]
    assert merged([silent], facts_with(alarm("a"))) == [silent]
    assert alarm("a") in merged([alarm("s", AlarmKind.GATEWAY_OFFLINE, host="gw-3")], facts_with(alarm("a")))


def test_what_was_acknowledged_is_gone_wherever_it_comes_from() -> None:
    theirs = alarm("g", AlarmKind.GAINS_DIFFER, unacknowledged=True)
    assert to_be_asked(facts_with(theirs, alarm("a"))) == {"g"}
    assert merged([alarm("g", host=HERE)], facts_with(theirs, acknowledged=["g"])) == []


def test_a_gateway_says_what_the_others_cannot_find_in_the_database() -> None:
    known = [alarm(str(kind), kind, HERE) for kind in AlarmKind]
    said = {each.kind for each in only_known_here([*known, alarm("b")], HERE)}
    assert set(AlarmKind) - said == {
        AlarmKind.NOT_RESTORED, AlarmKind.FALSE_PV, AlarmKind.TEST_FAILED, AlarmKind.GATEWAY_OFFLINE,
        AlarmKind.SUSPECT_GAINS,
        AlarmKind.ROLLED_BACK, AlarmKind.MODEL_MISMATCH,
    }  # fmt: skip
    assert only_known_here([alarm("b")], HERE) == []


# two gateways


@pytest.fixture
def fleet(tmp_path: Path, postgres: Server) -> Iterator[TwoGateways]:
    with two_gateways(tmp_path, postgres.database()) as found:
        yield found


def hears(fleet: TwoGateways, pv: float) -> None:
    fleet.there.listening.hears(Heard(time.time(), False, pv, 41.0, 50.0, 2, False, False))


def outside_its_limits(fleet: TwoGateways) -> Alarm:
    """The alarm as its gateway has it and has said it."""
    hears(fleet, 101.0)
    assert fleet.there.alarms_after(0.0) == []
    (found,) = fleet.there.alarms_after(3.0)
    fleet.write()
    return found


def test_an_alarm_of_the_other_gateway(fleet: TwoGateways) -> None:
    found = outside_its_limits(fleet)
    assert fleet.here.alarms_after(0.0) == [found], "with the time and the delay of its gateway"
    assert (found.gateway, found.loop, found.text) == (THERE, TAG_THERE, "PV is above its limit of 100 degC")
    assert fleet.here.http.get("/alarms").json() == [found.model_dump(mode="json")]
    assert fleet.here.watch.counts() == {1: 0, 2: 0, 3: 0}, "its own gateway counts it"
    assert fleet.here.own.present(time.time()).alarms == [], "and says it"
    answer = fleet.here.http.post(f"/alarms/{found.id}/acknowledge", json={"by": "A. Lind"})
    assert answer.status_code == 409 and "it goes by itself 3 s after its cause has gone" in answer.json()["detail"]
    hears(fleet, 50.0)
    fleet.there.alarms_after(1.0)
    assert fleet.there.alarms_after(3.0) == []
    fleet.write()
    assert fleet.here.alarms_after(0.0) == []


def test_an_alarm_of_the_other_gateway_is_acknowledged_here(
    fleet: TwoGateways, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = fleet.there.proposed()
    assert fleet.there.decide(job, "accept").status_code == 200
    monkeypatch.setattr(fleet.there.listening, "gains_read", lambda _tag: (OLD, time.time()))
    (differ,) = fleet.there.alarms_after(0.0)
    fleet.write()
    assert fleet.here.alarms_after(0.0) == [differ] and differ.kind is AlarmKind.GAINS_DIFFER
    answer = fleet.here.http.post(f"/alarms/{differ.id}/acknowledge", json={"by": "A. Lind"})
    assert answer.status_code == 200 and answer.json()["acknowledged"]["by"] == "A. Lind"
    assert fleet.here.alarms_after(0.0) == [], "although the row of its gateway has it still"
    assert fleet.there.alarms_after(0.0) == []


def test_a_gateway_that_does_not_answer(fleet: TwoGateways) -> None:
    found = outside_its_limits(fleet)
    assert fleet.here.alarms_after(0.0) == [found]
    fleet.age(5.0)
    assert fleet.here.alarms_after(60.0) == [found], "what it has said last"
    fleet.age(11.0)
    (silent,) = fleet.here.alarms_after(2.0)
    assert (silent.kind, silent.subject, silent.loops) == (AlarmKind.GATEWAY_OFFLINE, f"gateway {THERE}", [TAG_THERE])
    fleet.write()
    fleet.here.alarms_after(1.0)
    assert fleet.here.alarms_after(3.0) == [found]


def test_no_gateway_is_silent_because_the_database_was_away(
    fleet: TwoGateways, monkeypatch: pytest.MonkeyPatch
) -> None:
    def away(_store: object) -> Any:
        raise OperationalError("SELECT", {}, Exception("the server is gone"))

    found = outside_its_limits(fleet)
    assert fleet.here.alarms_after(60.0) == [found]
    with monkeypatch.context() as patch:
        patch.setattr(gateways, "every", away)
        assert fleet.here.alarms_after(60.0) == [found], "what the database has said last stays"
    fleet.age(61.0)  # the gateway there could not write either
    assert fleet.here.alarms_after(0.0) == fleet.here.alarms_after(1.0) == [found]
    assert [each.kind for each in fleet.here.alarms_after(10.0)] == [AlarmKind.GATEWAY_OFFLINE]


def test_a_gateway_without_loops_is_not_missed(fleet: TwoGateways) -> None:
    fleet.here.sql("DELETE FROM loops WHERE host = :name", name=THERE)
    fleet.age(600.0)
    assert fleet.here.alarms_after(0.0) == fleet.here.alarms_after(60.0) == []
    assert gateways.loops_elsewhere(fleet.there.store) == {HERE: (TAG_HERE,)}
