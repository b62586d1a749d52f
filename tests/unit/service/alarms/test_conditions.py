"""What is abnormal, row by row of the table of alarms, and when it becomes an alarm and ends."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime

import pytest

from loopwright.protocol.profile import NmtState
from loopwright.service.alarms.alarm import RULES, Alarm, AlarmKind
from loopwright.service.alarms.conditions import AlarmFacts, BusFacts, LoopFacts, conditions, to_be_asked
from loopwright.service.alarms.delays import Delays
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.listening.heard_loop import Heard
from loopwright.service.listening.heard_node import HeardHeartbeat
from loopwright.service.states.job_state import JobState
from loopwright.service.states.loop_state import LoopState, state_json
from loopwright.service.store.alarms import NOT_RESTORED, FalsePvJob, UnconfirmedJob, alarm_id
from loopwright.service.store.false_pv import FALSE_PV
from loopwright.service.store.live_jobs import Acceptance, JobInBrief
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode
from loopwright.tuning.reasons import ADVICE, Reason

T0 = 1_769_860_800.0
AT = "2026-01-31T12:00:00.000Z"
BUS = "socketcan:can0"
OLD, NEW = Gains(80.0, 1.2), Gains(58.5, 2.1)


def config(tag: str = "A", **changes: object) -> LoopConfig:
    fields = {
        "tag": tag, "bus": BUS, "controller_node": 32, "plant_node": 16, "pv_unit": "degC",
        "pv_limits": {"low": 49.0, "high": 51.0}, "t95_s": 9.1, "sp_deviation": 0.1,
    }  # fmt: skip
    return LoopConfig.model_validate(fields | changes)


def heard(at_s: float = T0, **changes: object) -> Heard:
    return replace(Heard(at_s, False, 50.0, 40.0, 50.0, 2, False, False), **changes)


def facts(*loops: LoopFacts, **changes: object) -> AlarmFacts:
    return replace(AlarmFacts("local", (BusFacts(BUS, None, T0 - 100.0),), loops), **changes)


def job(state: JobState, reason: Reason | None = None, id_: str = "4f0c2a9be113", loop: str = "A") -> JobInBrief:
    return JobInBrief(id_, loop, "local", state, False, "A. Lind", "relay", 3.0, False, reason, AT)


def steps(known: AlarmFacts, *ages_s: float, delays: Delays | None = None) -> list[Sequence[Alarm]]:
    """The alarms at these times after T0, of something that stays as it is."""
    delays = delays or Delays()
    return [delays.step(conditions(known), T0 + age_s) for age_s in ages_s]


def kinds(known: AlarmFacts) -> list[AlarmKind]:
    return [each.kind for each in conditions(known)]


def test_a_loop_that_is_as_it_should_be() -> None:
    accepted = Acceptance("4f0c2a9be113", AT, "A. Lind", NEW, 1.6)
    loop = LoopFacts(config(), heard(), gains=(NEW, T0 + 1.0), accepted=accepted)
    node = HeardHeartbeat(T0, False, NmtState.OPERATIONAL)
    assert not conditions(facts(loop, nodes={(BUS, 32): node}, tests=(job(JobState.ACCEPTED),)))
    assert set(RULES) == set(AlarmKind)


# priority 1


def unconfirmed(**changes: object) -> UnconfirmedJob:
    found = UnconfirmedJob("4f0c2a9be113", "A", "gw-2", AT, Reason.RESTORE_UNCONFIRMED, True)
    return replace(found, **changes)


@pytest.mark.parametrize(
    ("mode", "reason", "words", "first"),
    [
        (Mode.MANUAL, Reason.PV_FROZEN, "was left in manual at MV 42.5 %", "Check the sensor"),
        (Mode.OFF, Reason.BAD_SAMPLE, "was left in off at MV 41 %", "Check the sensor"),
        (Mode.AUTOMATIC, Reason.PV_FROZEN, "was left in automatic", "Look at the loop now: unless somebody has put it"),
        (None, Reason.PV_FROZEN, "could not be read back", "Look at the loop now: it may be in automatic"),
        (Mode.MANUAL, Reason.NODE_LOST, "was left in manual at MV 42.5 %", "Check the sensor"),  # found held only later
    ],
)
def test_a_false_pv_is_an_alarm_at_once_which_says_what_the_loop_was_left_in(
    mode: Mode | None, reason: Reason, words: str, first: str
) -> None:
    state = None if mode is None else LoopState(mode, 50.0, 50.0, 41.0, OLD, False, 0.0, 100.0, 0.1, True, 42.5)
    found = FalsePvJob("4f0c2a9be113", "A", "gw-2", AT, reason, None if state is None else state_json(state))
    known = facts(false_pvs=(found,), tests=(job(JobState.FAILED, reason),))
    ((alarm,), (later,)) = steps(known, 0.0, 1e6)
    assert (alarm.priority, alarm.kind, alarm.loops, alarm.gateway) == (1, AlarmKind.FALSE_PV, ["A"], "gw-2")
    assert alarm.text == f"PV was found to be false in a test; the loop {words}"
    assert alarm.advice.startswith(first) and "when PV is right again" in alarm.advice
    assert "No test begins until somebody acknowledges this" in alarm.advice and alarm.unacknowledged
    assert later == alarm, "it is the only alarm of that test"
    assert not conditions(replace(known, false_pvs=(), acknowledged=frozenset({alarm.id}))), (
        "nor is there one afterwards"
    )


def test_a_loop_that_was_not_confirmed_to_be_as_before_is_an_alarm_at_once_and_until_it_is_acknowledged() -> None:
    known = facts(unconfirmed=(unconfirmed(),), tests=(job(JobState.FAILED, Reason.RESTORE_UNCONFIRMED),))
    ((alarm,), (later,)) = steps(known, 0.0, 1e6)
    assert (alarm.priority, alarm.kind, alarm.subject, alarm.loops) == (1, AlarmKind.NOT_RESTORED, "A", ["A"])
    assert alarm.text == "Not confirmed that the loop is as before the test"
    assert "Look at the controller now" in alarm.advice and "until somebody acknowledges it" in alarm.advice
    assert (alarm.since, alarm.gateway, alarm.job, alarm.unacknowledged) == (AT, "gw-2", "/jobs/4f0c2a9be113", True)
    assert later == alarm, "it is the only alarm of that test"
    ids = {alarm_id(kind, "4f0c2a9be113") for kind in (NOT_RESTORED, FALSE_PV, "test_failed")}
    assert to_be_asked(facts(tests=known.tests)) == ids
    signed = facts(tests=known.tests, acknowledged=frozenset({alarm.id}))
    assert not conditions(signed), "whoever has acknowledged it has seen how the test ended"


def test_a_loop_that_was_read_back_later_says_so() -> None:
    ((alarm,),) = steps(facts(unconfirmed=(unconfirmed(monitored=False),)), 0.0)
    assert alarm.advice.startswith("The loop was read back later") and "until somebody acknowledges it" in alarm.advice
    ((alarm,),) = steps(facts(unconfirmed=(unconfirmed(reason=Reason.NODE_LOST),)), 0.0)
    assert alarm.priority == 1 and "signs" not in alarm.advice


# priority 2


def test_a_bus_that_is_down_is_one_alarm_which_names_its_loops() -> None:
    loops = (LoopFacts(config("B"), heard(silent=True)), LoopFacts(config("A")))
    known = facts(*loops, buses=(BusFacts(BUS, "no such interface", T0),))
    none, (alarm,), _ = steps(known, 0.0, 3.0, 60.0)
    assert not none
    assert (alarm.priority, alarm.kind, alarm.subject, alarm.loop) == (2, AlarmKind.BUS_DOWN, BUS, None)
    assert alarm.text == f"Bus {BUS} is down: no such interface" and alarm.loops == ["A", "B"]
    assert (alarm.since, alarm.unacknowledged) == (AT, False)


def test_an_error_that_names_the_bus_names_it_once() -> None:
    known = facts(buses=(BusFacts(BUS, f"bus '{BUS}' cannot be opened: no such device", T0),))
    _, (alarm,) = steps(known, 0.0, 3.0)
    assert alarm.text == f"Bus {BUS} is down: it cannot be opened: no such device"


def test_a_bus_that_only_the_listening_process_has_lost_says_so() -> None:
    known = facts(buses=(BusFacts(BUS, "the listening process has died", T0),))
    (found,) = conditions(known)
    assert found.text == f"No data of bus {BUS}: the listening process has died" and "Tests go on" in found.advice


def test_a_node_that_is_lost_is_one_alarm_which_names_its_loops() -> None:
    loops = [LoopFacts(config(tag, channel=n), heard(silent=True)) for n, tag in enumerate("AB", 1)]
    lost = HeardHeartbeat(T0, True, NmtState.OPERATIONAL)
    known = facts(*loops, nodes={(BUS, 32): lost, (BUS, 99): lost})
    none, (alarm,) = steps(known, 2.9, 3.0)
    assert not none and (alarm.priority, alarm.kind) == (2, AlarmKind.NODE_LOST)
    assert alarm.subject == f"node 20h on {BUS}" and alarm.loops == ["A", "B"] and alarm.since == AT
    assert alarm.text == "Node 20h (32) is lost: its heartbeat has stopped"


def test_a_node_that_is_not_operational_says_its_state() -> None:
    known = facts(LoopFacts(config()), nodes={(BUS, 16): HeardHeartbeat(T0, False, NmtState.PRE_OPERATIONAL)})
    none, (alarm,) = steps(known, 0.0, 3.0)
    assert not none and (alarm.priority, alarm.text) == (2, "Node 10h (16) is pre-operational: it controls nothing")


@pytest.mark.parametrize("state", [NmtState.OPERATIONAL, NmtState.BOOT_UP, None])
def test_a_node_in_another_state_is_none(state: NmtState | None) -> None:
    assert not conditions(facts(LoopFacts(config(), heard()), nodes={(BUS, 16): HeardHeartbeat(T0, False, state)}))


def test_after_a_bus_is_back_its_nodes_have_time_to_speak() -> None:
    known = facts(
        LoopFacts(config(), heard(T0 - 60.0, silent=True)),
        nodes={(BUS, 32): HeardHeartbeat(T0 - 60.0, True, NmtState.OPERATIONAL)},
        buses=(BusFacts(BUS, None, T0),),
    )
    assert [len(each) for each in steps(known, 0.0, 2.9, 3.0)] == [0, 0, 1]
    no_data = replace(known, nodes={})
    assert [len(each) for each in steps(no_data, 0.0, 2.9, 3.0)] == [0, 0, 1]


def test_a_loop_without_data_counts_from_its_last_sample() -> None:
    none, (alarm,) = steps(facts(LoopFacts(config(), heard(silent=True))), 2.9, 3.0)
    assert not none
    assert (alarm.priority, alarm.kind, alarm.subject, alarm.text) == (2, AlarmKind.NO_DATA, "A", "No data")
    assert alarm.since == AT


@pytest.mark.parametrize(("t95_s", "after_s"), [(9.1, 3.0), (3600.0, 720.0)])
def test_a_loop_of_which_no_sample_ever_came(t95_s: float, after_s: float) -> None:
    known = facts(LoopFacts(config(t95_s=t95_s)), buses=(BusFacts(BUS, None, T0),))
    none, (alarm,) = steps(known, after_s - 0.1, after_s)
    assert not none and alarm.text == "No data since the bus is up"


@pytest.mark.parametrize(
    ("pv", "text"),
    [(48.9, "PV is below its limit of 49 degC"), (51.1, "PV is above its limit of 51 degC"), (51.0, None), (49.0, None),
     (math.nan, None)],
)  # fmt: skip
def test_pv_outside_its_limits(pv: float, text: str | None) -> None:
    none, alarms = steps(facts(LoopFacts(config(), heard(pv=pv))), 0.0, 3.0)
    assert not none and [alarm.text for alarm in alarms] == ([] if text is None else [text])
    assert all((alarm.priority, alarm.kind) == (2, AlarmKind.PV_OUTSIDE_LIMITS) for alarm in alarms)


def test_a_pv_that_is_old_is_not_outside_its_limits() -> None:
    assert kinds(facts(LoopFacts(config(), heard(pv=99.0, silent=True)))) == [AlarmKind.NO_DATA]


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"on_trial": True}, "Gains are on trial that no job here has begun"),
        ({"session": True}, "A test runs that no job here has begun"),
        ({"mode": 3}, "A test runs that no job here has begun"),
        ({"on_trial": None, "session": None, "mode": 255}, None),
    ],
)
def test_a_test_that_no_job_here_has_begun(changes: dict[str, object], text: str | None) -> None:
    loop = LoopFacts(config(), heard(**changes))
    none, alarms = steps(facts(loop), 0.0, 5.0)
    assert not none and [alarm.text for alarm in alarms] == ([] if text is None else [text])
    assert all((alarm.priority, alarm.kind) == (2, AlarmKind.FOREIGN_TEST) for alarm in alarms)
    assert not steps(facts(loop), 0.0, 4.9)[1]
    assert not conditions(facts(replace(loop, job="4f0c2a9be113")))


def test_where_a_bus_is_not_listened_to_the_running_job_knows_pv() -> None:
    held = LoopState(Mode.EXPERIMENT, 50.0, 52.0, 40.0, OLD, True, 0.0, 100.0, 0.1, True)
    loop = LoopFacts(config(), held=held, job="4f0c2a9be113")
    assert kinds(facts(loop, buses=())) == [AlarmKind.PV_OUTSIDE_LIMITS]
    assert not conditions(facts(replace(loop, held=None), buses=()))


# priority 3


@pytest.mark.parametrize("state", JobState)
def test_only_a_test_that_failed_or_was_interrupted_is_abnormal(state: JobState) -> None:
    abnormal = state in (JobState.FAILED, JobState.INTERRUPTED)
    assert bool(conditions(facts(tests=(job(state, Reason.NODE_LOST),)))) == abnormal


def test_the_last_test_failed() -> None:
    ((alarm,),) = steps(facts(tests=(job(JobState.FAILED, Reason.NODE_LOST),)), 0.0)
    assert (alarm.priority, alarm.text, alarm.advice) == (
        3,
        "The last test failed: node lost",
        ADVICE[Reason.NODE_LOST],
    )
    assert (alarm.since, alarm.job, alarm.unacknowledged) == (AT, "/jobs/4f0c2a9be113", True)
    ((alarm,),) = steps(facts(tests=(job(JobState.INTERRUPTED),)), 0.0)
    assert (alarm.text, alarm.advice) == ("The last test was interrupted", "See the job.")
    assert conditions(facts(tests=(job(JobState.FAILED, "full_moon"),)))[0].text == "The last test failed: full moon"
    assert not conditions(
        facts(tests=(job(JobState.FAILED),), acknowledged=frozenset({alarm_id("test_failed", "4f0c2a9be113")}))
    )


def test_gains_that_differ_from_those_accepted() -> None:
    accepted = Acceptance("4f0c2a9be113", AT, "A. Lind", NEW, 1.6)
    loop = LoopFacts(config(), heard(), gains=(OLD, T0 + 1.0), accepted=accepted)
    ((alarm,),) = steps(facts(loop), 2.0)
    assert (alarm.priority, alarm.kind, alarm.job, alarm.unacknowledged) == (
        3, AlarmKind.GAINS_DIFFER, "/jobs/4f0c2a9be113", True,
    )  # fmt: skip
    assert alarm.text == ("The gains differ from those accepted last: Kp 80, Ti 1.2 s instead of Kp 58.5, Ti 2.1 s")
    assert not conditions(facts(replace(loop, gains=(OLD, T0 - 1.0)))), "read before they were accepted"
    assert not conditions(facts(replace(loop, gains=(NEW, T0 + 1.0))))
    assert not conditions(facts(replace(loop, gains=None)))
    assert not conditions(facts(replace(loop, job="5e0c2a9be113")))
    signed = frozenset({alarm.id})
    assert not conditions(facts(loop, acknowledged=signed))
    others = replace(loop, gains=(Gains(1.0, 1.0), T0 + 9.0))
    assert conditions(facts(others, acknowledged=signed)), "other gains than those that somebody has signed for"


# delays


def limits(*outside: bool) -> list[bool]:
    """Whether there is an alarm at each second, PV being outside at these."""
    delays, found = Delays(), []
    for n, out in enumerate(outside):
        known = facts(LoopFacts(config(), heard(pv=52.0 if out else 50.0)))
        found.append(bool(delays.step(conditions(known), T0 + n)))
    return found


def test_a_condition_that_comes_and_goes_within_the_on_delay_is_no_alarm() -> None:
    assert not any(limits(*[True, True, True, False] * 10))


def test_a_condition_that_goes_and_comes_within_the_off_delay_is_one_alarm() -> None:
    found = limits(*[True] * 4, *[False, False, True] * 5, *[False] * 5)
    assert found == [False] * 3 + [True] * 19 + [False] * 2


def test_an_alarm_keeps_its_beginning_and_takes_the_latest_words() -> None:
    delays = Delays()
    below, above = (facts(LoopFacts(config(), heard(pv=pv))) for pv in (48.0, 52.0))
    steps(below, 0.0, delays=delays)
    (first,) = delays.step(conditions(below), T0 + 3.0)
    (second,) = delays.step(conditions(above), T0 + 4.0)
    assert (first.id, first.since) == (second.id, second.since)
    assert "below" in first.text and "above" in second.text


@pytest.mark.parametrize("jump_s", [-3600.0, 3600.0])
def test_a_clock_that_jumps_ends_no_alarm_and_delays_none_for_long(jump_s: float) -> None:
    delays, known = Delays(), facts(LoopFacts(config(), heard(pv=52.0)))
    steps(known, 0.0, 3.0, delays=delays)
    assert delays.step(conditions(known), T0 + 4.0 + jump_s)
    none = facts(LoopFacts(config(), heard()))
    delays.step(conditions(none), T0 + 5.0 + jump_s)
    assert not delays.step(conditions(none), T0 + 8.0 + jump_s)
    assert not delays.step(conditions(known), T0)
    assert not delays.step(conditions(known), T0 + jump_s - 1e4)
    assert delays.step(conditions(known), T0 + jump_s - 1e4 + 3.0)


def test_the_worst_comes_first() -> None:
    known = facts(
        LoopFacts(config("B"), heard(pv=52.0)), LoopFacts(config("A"), heard(pv=52.0)),
        unconfirmed=(unconfirmed(loop="Z"),), tests=(job(JobState.FAILED, id_="2", loop="C"),),
    )  # fmt: skip
    found = steps(known, 0.0, 3.0)[1]
    assert [(alarm.priority, alarm.subject) for alarm in found] == [(1, "Z"), (2, "A"), (2, "B"), (3, "C")]


def test_times_are_utc() -> None:
    assert datetime.fromisoformat(AT) == datetime.fromtimestamp(T0, UTC)
