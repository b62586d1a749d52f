"""A PV that is false within its limits, on a bus in memory: the controller holds the loop in manual at the MV of the
rest, whoever dies or commands meanwhile, and every reader of the loop takes that for right."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from loopwright.protocol.objects import Value, lookup
from loopwright.protocol.profile import TUNER_NODE, Abort, Cause, NmtCommand, Order
from loopwright.protocol.sdo import SdoAbort
from loopwright.protocol.session import object_of
from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.runner import RunResult, run
from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.plan import Mode, Note, Plan, SetGains, SetMode, SetOutput, SetSetpoint
from loopwright.tuning.reasons import Ended, Failed, FalsePv, Reason
from tests.unit.service.bus_site import NEW, RELAY, Killed, Site

LIMITS = RunLimits(40.0, 60.0, 0.0, 100.0)
FROZEN = FalsePv(Reason.PV_FROZEN, "PV is exactly 50.1 for 10 samples")


def moves(first: tuple[object, ...], strike: Callable[[], None] = lambda: None) -> Plan[None]:
    """A plan that moves the loop so, and then finds PV to be false."""
    yield first  # type: ignore[misc]
    for _ in range(5):
        yield ()
    strike()
    raise FROZEN


MOVED = pytest.mark.parametrize(
    "first",
    [
        (RELAY, SetMode(Mode.EXPERIMENT)),
        (SetGains(NEW), SetSetpoint(50.4)),
        (SetMode(Mode.MANUAL), SetOutput(70.0)),
    ],
    ids=["relay", "step", "output"],
)


def false_pv(
    site: Site, first: tuple[object, ...] = (RELAY,), strike: Callable[[], None] = lambda: None
) -> tuple[RunResult[None], list[str], LoopState]:
    """The run, what it has noted, and the state before."""
    if site.plant.pace:
        site.let_run()
    before = site.loop.read()
    notes: list[str] = []
    result = run(
        moves(first, strike), site.loop, limits=LIMITS,
        on_event=lambda event: notes.append(event.text) if isinstance(event, Note) else None,
    )  # fmt: skip
    return result, notes, before


def is_held(site: Site) -> bool:
    """Once a sample has carried the output to the plant. PV may be anything: it moves nothing."""
    site.pass_time(0.3)
    mv = site.mv
    site.plant.plants[0].disturbance = 20.0
    site.pass_time(3.0)
    return site.is_home(mode=Mode.MANUAL) and site.mv == mv == pytest.approx(50.0, abs=0.5)


@MOVED
@pytest.mark.parametrize("pace", [1.0, 0.0])
def test_the_loop_is_left_in_manual_at_the_MV_of_the_rest(pace: float, first: tuple[object, ...]) -> None:
    site = Site(pace)
    result, notes, before = false_pv(site, first)
    assert result.ended is FROZEN
    assert result.restored is not None
    assert (result.restored.mode, result.restored.gains) == (Mode.MANUAL, before.gains)
    assert result.restored.manual_output == pytest.approx(before.mv, abs=0.5)
    assert site.controller.sessions[0].cause is Cause.HELD
    assert any("left in manual at MV" in note and "operator" in note for note in notes), notes
    if pace:
        assert is_held(site)


@pytest.mark.parametrize("mode", [Mode.MANUAL, Mode.OFF])
def test_a_loop_that_was_in_manual_or_off_is_as_it_was(mode: Mode) -> None:
    site = Site(mode=mode)
    result, _, before = false_pv(site)
    assert result.ended is FROZEN
    site.pass_time(0.3)
    after = site.loop.read()
    assert after == replace(before, pv=after.pv)


def test_a_controller_without_the_order_HOLD_is_refused_before_anything_moves() -> None:
    site = Site(0.0)
    del site.controller.dictionary.by_index[lookup(object_of(Order.HOLD)).index]
    result, _, before = false_pv(site)
    assert result.ended is not None and result.ended.reason is Reason.DEVICE_MISMATCH
    assert "20h (32) does not know the order HOLD (object 2179h)" in result.ended.detail
    assert (site.names(), site.controller.sessions[0].last) == ([], 0), "no session was opened"
    assert site.loop.accept(NEW, before.gains).gains == NEW, "accepting needs no HOLD"


def killed(site: Site, when: str) -> tuple[LoopState, int]:
    """The gateway dies before the write of that object: home, and the number of the session."""
    site.let_run()
    home, number = site.begun()
    site.loop.step((RELAY,))
    for _ in range(5):
        site.loop.step(())

    def strike(call: int) -> None:
        site.gateway.dead = site.gateway.dead or when in [name for name, _ in site.written]

    site.gateway.before = strike
    with pytest.raises(Killed):
        site.loop.hold()
        site.loop.restore(home)
    return home, number


def test_a_kill_after_HOLD_leaves_it_held_and_the_next_process_finds_it_so() -> None:
    site = Site()
    home, number = killed(site, "controller_order_hold")
    site.pass_time(2.0)
    assert site.controller.sessions[0].cause is Cause.HELD and is_held(site)
    _, after = site.another()
    restored = after.restore(home, number)
    assert (restored.held, restored.changed, restored.state.mode) == (True, {}, Mode.MANUAL)
    assert is_held(site)


def test_a_kill_before_HOLD_takes_it_home_as_ever() -> None:
    site = Site()
    home, number = site.begun()
    site.loop.step((RELAY,))
    site.gateway.dead = True
    site.pass_time(2.0)
    assert site.controller.sessions[0].cause is Cause.HEARTBEAT
    _, after = site.another()
    restored = after.restore(home, number)
    assert (restored.held, restored.state.mode) == (False, Mode.AUTOMATIC)


@pytest.mark.parametrize(
    ("name", "value"), [("controller_mode_command", Mode.AUTOMATIC), ("controller_setpoint", 50.5)]
)
def test_what_an_operator_does_with_a_held_loop_stays(name: str, value: float) -> None:
    site = Site()
    result, _, before = false_pv(site)
    number = site.controller.sessions[0].last
    site.hand(name, value)
    _, after = site.another()
    restored = after.restore(before, number)
    assert restored.held
    assert list(restored.changed) == ["mode" if name.endswith("command") else "set-point"]
    assert site.is_home(50.5 if name.endswith("setpoint") else 50.0, Mode(site.channel.mode))
    assert site.channel.mode == (Mode.AUTOMATIC if name.endswith("command") else Mode.MANUAL)
    assert result.ended is FROZEN


def test_an_operator_who_was_faster_has_the_last_word() -> None:
    site = Site()
    result, notes, _ = false_pv(site, (RELAY,), lambda: site.hand("controller_setpoint", 50.25))
    assert result.ended is FROZEN
    assert site.is_home(50.25), "in automatic, as the operator's command has left it"
    assert any("could not be held" in note and "set-point" in note for note in notes), notes
    assert any("the loop was left in automatic: an operator has to look" in note for note in notes), notes


def test_a_bus_that_is_away_for_a_moment_does_not_keep_it_from_being_held() -> None:
    site = Site()
    home, _ = site.begun()
    site.loop.step((RELAY,))
    lost = iter([OSError(100, "network is down")] * 15)

    def strike(call: int) -> None:
        site.lost = next(lost, None)

    site.gateway.before = strike
    site.loop.hold()
    assert site.loop.restore(home).held
    assert is_held(site)


def test_a_node_that_is_stopped_meanwhile_sends_the_MV_of_the_rest() -> None:
    site = Site()
    home, _ = site.begun()
    site.loop.step((SetMode(Mode.MANUAL), SetOutput(70.0)))
    site.loop.step(())
    site.loop.hold()
    site.nmt(NmtCommand.STOP)
    site.pass_time(0.5)
    assert site.mv == pytest.approx(50.0, abs=0.5)
    with pytest.raises(Failed, match=str(Reason.NODE_NOT_OPERATIONAL.value)):
        site.loop.restore(home)
    site.nmt(NmtCommand.START)
    assert site.loop.restore(home).held and is_held(site)


def test_another_tuner_may_test_a_held_loop_and_its_home_is_manual() -> None:
    site = Site()
    false_pv(site)
    _, other = site.another(TUNER_NODE - 1)
    assert other.begin().mode is Mode.MANUAL


def test_HOLD_whose_answer_is_lost_with_the_session_is_known_to_have_come() -> None:
    """The controller is stopped the moment it has taken the order: the session is over, and held."""
    site = Site()
    home, _ = site.begun()
    site.loop.step((RELAY,))
    writes, name = site.controller.dictionary.on_write, object_of(Order.HOLD)
    carry_out = writes[name]

    def order(sub: int, value: Value) -> None:
        carry_out(sub, value)
        site.controller.sessions[0].end(Cause.LEASE)
        raise SdoAbort(Abort.DEVICE_STATE)

    writes[name] = order
    site.loop.hold()
    assert site.loop.restore(home).held and is_held(site)


def test_HOLD_given_twice_is_one_and_nothing_moves_the_loop_after_it() -> None:
    site = Site()
    home, _ = site.begun()
    site.loop.step((RELAY,))
    site.loop.hold()
    site.loop.hold()
    with pytest.raises(Ended):
        site.loop.step((SetMode(Mode.AUTOMATIC),))
        site.loop.step((SetMode(Mode.AUTOMATIC),))
    assert site.channel.mode == Mode.MANUAL
    assert site.loop.restore(home).held and is_held(site)


def test_a_session_that_is_over_when_HOLD_comes_is_said_to_have_ended_in_automatic() -> None:
    """The heartbeat was missing for too long: home is as before, and nothing says that the loop is held."""
    site = Site()
    result, notes, _ = false_pv(site, (RELAY,), lambda: site.pass_time(30.0))
    assert result.ended is FROZEN and result.restored is not None
    assert result.restored.mode is Mode.AUTOMATIC and site.is_home()
    assert any("could not be held" in note for note in notes), notes
    assert any("left in automatic" in note for note in notes) and not any("in manual at MV" in note for note in notes)


def test_HOLD_of_one_channel_leaves_the_other_alone() -> None:
    site = Site(channels=2)
    site.let_run()
    second = site.tuner(site.gateway, channel=2)
    home = second.begin()
    second.step((RELAY,))
    second.hold()
    assert second.restore(home).held
    assert [each.channel.mode for each in site.controller.sessions] == [Mode.AUTOMATIC, Mode.MANUAL]
    assert [each.cause for each in site.controller.sessions] == [Cause.NONE, Cause.HELD]
