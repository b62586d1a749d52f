"""Modes, limits, changes without bumps, gains on trial, and the way home."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from loopwright.controller.channel import Channel, Home, Mode, Parameters, RelaySettings, RelayState, Settings

Ts = 0.1
P, P2 = Parameters(3.0), Parameters(0.5)
PI, PI2 = Parameters(1.0, Ti=5.0), Parameters(4.0, Ti=1.0, b=0.3)
PID = Parameters(2.0, Ti=8.0, Td=1.0, Tf=0.1, b=0.8, c=0.5)
LAWS = {"P": P, "P2": P2, "PI": PI, "PI2": PI2, "PID": PID}
ACTIONS = pytest.mark.parametrize("reverse", [True, False], ids=["reverse", "direct"])


def channel(law: Parameters = PI, mode: Mode = Mode.AUTOMATIC, reverse: bool = True, **limits: float) -> Channel:
    return Channel(Ts, Settings(reverse=reverse, **limits), law, 50.0, mode, 45.0)


def moving(c: Channel) -> float:
    """Some history off the set-point, ending on two equal samples so that only a bump can move MV."""
    for n in range(40):
        c.step(49.0 + 0.5 * math.sin(n / 5))
    c.step(49.2)
    return c.step(49.2)


RELAY = RelaySettings(10.0, 0.0, 50.0, 1000, 0.0, 100.0)


@ACTIONS
@pytest.mark.parametrize(("before", "after"), list(itertools.permutations(LAWS, 2)))
def test_new_gains_do_not_move_the_output(before: str, after: str, reverse: bool) -> None:
    c = channel(LAWS[before], reverse=reverse)
    mv = moving(c)
    c.try_gains(LAWS[after])
    assert c.on_trial and c.in_effect == LAWS[after] and c.accepted == LAWS[before]
    assert c.step(49.2) == pytest.approx(mv, abs=1e-9)
    c.go_back()
    mv = c.mv
    assert not c.on_trial and c.in_effect == LAWS[before]
    assert c.step(49.2) == pytest.approx(mv, abs=1e-9)


@ACTIONS
@pytest.mark.parametrize("law", list(LAWS))
def test_mode_changes_do_not_move_the_output(law: str, reverse: bool) -> None:
    c = channel(LAWS[law], reverse=reverse)
    mv = moving(c)
    c.command_mode(Mode.MANUAL)
    assert c.manual_output == mv
    assert c.step(48.0) == c.step(52.0) == mv
    c.manual_output = 60.0
    assert c.step(52.0) == 60.0
    c.command_mode(Mode.AUTOMATIC)
    assert c.step(52.0) == pytest.approx(60.0, abs=1e-9)


def test_gains_change_without_a_bump_while_saturated_and_leave_the_limit_at_once() -> None:
    for after in (P2, PI2):
        c = channel(PI)
        for _ in range(500):
            c.step(0.0)
        c.try_gains(after)
        c.step(0.0)
        assert c.mv == 100.0
        assert c.step(60.0) < 100.0


def test_starts_at_the_output_it_is_given() -> None:
    for law in LAWS.values():
        assert channel(law).step(42.0) == pytest.approx(45.0)
    assert channel(mode=Mode.MANUAL).step(42.0) == 45.0
    assert channel(mode=Mode.OFF, safe_output=7.0).step(42.0) == 7.0


def test_off_is_the_safe_output_at_once_and_comes_back_from_there() -> None:
    c = channel(PI, safe_output=5.0, rate_limit_per_s=1.0)
    moving(c)
    c.command_mode(Mode.OFF)
    assert c.step(49.2) == 5.0
    c.command_mode(Mode.AUTOMATIC)
    assert c.step(49.2) == pytest.approx(5.0, abs=0.11)


def test_rate_limit_and_limits_hold_in_manual() -> None:
    c = channel(mode=Mode.MANUAL, mv_low=20, mv_high=80, rate_limit_per_s=10.0)
    c.manual_output = 100.0
    u = [c.step(50.0) for _ in range(100)]
    assert u[:3] == pytest.approx([46, 47, 48])
    assert max(u) == 80


@pytest.mark.parametrize(("wanted", "limits", "first"), [(0, (10, 30), 30), (100, (10, 30), 30), (100, (60, 90), 60)])
def test_limits_moved_away_from_the_output_win_over_the_rate(
    wanted: float, limits: tuple[float, float], first: float
) -> None:
    c = channel(mode=Mode.MANUAL, rate_limit_per_s=10.0)
    c.manual_output = wanted
    c.settings = Settings(mv_low=limits[0], mv_high=limits[1], rate_limit_per_s=10.0)
    assert c.step(50.0) == first


def test_a_set_point_change_acts_through_its_weight() -> None:
    c = channel(PI2)
    mv = c.step(50.0)
    c.setpoint = 52.0
    assert c.step(50.0) - mv == pytest.approx(4.0 * 0.3 * 2.0)


def test_turning_the_action_round_does_not_move_the_output() -> None:
    c = channel(PI)
    mv = moving(c)
    c.settings = Settings(reverse=False)
    assert c.step(49.2) == pytest.approx(mv)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e30, 200.5, -100.5])
@pytest.mark.parametrize("law", list(LAWS))
def test_a_bad_measurement_holds_the_output_and_leaves_no_trace(law: str, bad: float) -> None:
    c, twin = channel(LAWS[law]), channel(LAWS[law])
    mv = moving(c)
    moving(twin)
    assert [c.step(bad) for _ in range(5)] == [mv] * 5
    assert c.bad_samples == 5
    assert [c.step(49.0 + n) for n in range(9)] == [twin.step(49.0 + n) for n in range(9)]


@pytest.mark.parametrize("pv", [200.0, -100.0])
def test_a_measurement_out_of_its_span_is_one_up_to_the_width_of_the_span(pv: float) -> None:
    c = channel(PI)
    assert c.step(49.0) != c.step(pv)
    assert c.bad_samples == 0


def test_the_operator_can_move_the_output_by_hand_without_a_sensor() -> None:
    c = channel()
    assert c.step(math.nan) == 45.0
    c.command_mode(Mode.MANUAL)
    c.manual_output = 30.0
    assert c.step(math.nan) == 30.0
    c.command_mode(Mode.AUTOMATIC)
    assert c.step(math.nan) == 30.0
    assert c.step(20.0) == pytest.approx(30.0)


def test_accepting_makes_the_trial_the_set_to_come_back_to() -> None:
    c = channel(PI)
    c.stage(PI2)
    assert (c.staged, c.in_effect, c.on_trial) == (PI2, PI, False)
    c.try_gains(PI2)
    c.accept(PI2)
    assert (c.accepted, c.on_trial, c.accept_count) == (PI2, False, 1)
    c.go_back()
    assert c.in_effect == PI2


@pytest.mark.parametrize("tried", [PI2, PID], ids=["the accepted ones", "others"])
def test_what_is_accepted_is_in_effect_whatever_was_tried_before(tried: Parameters) -> None:
    c = channel(PI)
    mv = moving(c)
    c.try_gains(tried)
    c.accept(PI2)
    assert (c.accepted, c.in_effect, c.on_trial) == (PI2, PI2, False)
    assert c.step(49.2) == pytest.approx(mv)


HOMES = {
    "off": Home(Mode.OFF, 50.0, 45.0, 5.0),
    "manual": Home(Mode.MANUAL, 50.0, 45.0, 45.0),
    "automatic": Home(Mode.AUTOMATIC, 50.0, 45.0, 48.0),
}


@pytest.mark.parametrize("home", HOMES.values(), ids=list(HOMES))
def test_home_is_mode_set_point_manual_output_and_the_accepted_gains(home: Home) -> None:
    c = channel(PI)
    c.try_gains(PI2)
    c.setpoint, c.manual_output = 53.0, 70.0
    c.go_home(home)
    assert (c.mode, c.setpoint, c.manual_output) == (home.mode, home.setpoint, home.manual_output)
    assert (c.in_effect, c.on_trial) == (PI, False)


@ACTIONS
def test_the_way_home_in_automatic_has_no_bump(reverse: bool) -> None:
    c = channel(PI, reverse=reverse)
    c.try_gains(PI2)
    c.setpoint = 53.0
    mv = moving(c)
    c.go_home(HOMES["automatic"])
    assert c.step(49.2) == pytest.approx(mv)


def test_home_in_manual_is_reached_no_faster_than_the_rate_limit_allows() -> None:
    c = channel(PI, rate_limit_per_s=10.0)
    mv = moving(c)
    c.go_home(Home(Mode.MANUAL, 50.0, 20.0, 20.0))
    assert [c.step(49.2) for _ in range(3)] == pytest.approx([mv - 1.0, mv - 2.0, mv - 3.0])


@pytest.mark.parametrize(("mode", "mv"), [(Mode.OFF, 5.0), (Mode.MANUAL, 60.0), (Mode.AUTOMATIC, 48.0)], ids=str)
def test_without_pv_the_output_is_at_once_what_the_mode_stands_for(mode: Mode, mv: float) -> None:
    c = channel(PI, safe_output=5.0, rate_limit_per_s=1.0)
    moving(c)
    c.command_mode(mode)
    c.manual_output = 60.0
    c.without_pv(48.0)
    assert c.mv == mv
    assert c.step(51.0) == pytest.approx(mv, abs=0.11), "and the law goes on from there"


def test_without_pv_the_output_keeps_its_limits() -> None:
    c = channel(PI, mv_low=20.0, mv_high=40.0)
    c.without_pv(99.0)
    assert c.mv == 40.0


def test_only_an_experiment_in_its_relay_is_one() -> None:
    with pytest.raises(ValueError, match="cannot start with an experiment"):
        channel(mode=Mode.EXPERIMENT)
    c = channel(PI)
    c.start_relay(RELAY)
    assert (c.mode, c.relay_state) == (Mode.EXPERIMENT, RelayState.RUNNING)
    c.command_mode(Mode.AUTOMATIC)
    assert (c.relay, c.relay_state) == (None, RelayState.DONE)


REFUSED: list[Callable[[Channel], object]] = [
    lambda c: c.command_mode(7),
    lambda c: c.command_mode(Mode.EXPERIMENT),
    lambda c: setattr(c, "setpoint", math.nan),
    lambda c: setattr(c, "manual_output", math.inf),
    lambda c: setattr(c, "settings", Settings(mv_low=2, mv_high=1)),
    lambda c: setattr(c, "settings", Settings(pv_low=2, pv_high=1)),
    lambda c: setattr(c, "settings", Settings(rate_limit_per_s=-1)),
]


@pytest.mark.parametrize("command", REFUSED)
def test_what_has_no_meaning_is_refused_and_changes_nothing(command: Callable[[Channel], object]) -> None:
    c = channel(PI)
    mv = moving(c)
    with pytest.raises(ValueError):
        command(c)
    assert (c.mode, c.setpoint, c.settings) == (Mode.AUTOMATIC, 50.0, Settings())
    assert c.step(49.2) != mv  # it still integrates


COMMANDS: list[Callable[[Channel], object]] = [
    lambda c: c.step(40.0),
    lambda c: c.step(58.0),
    lambda c: c.step(math.nan),
    lambda c: c.command_mode(Mode.OFF),
    lambda c: c.command_mode(Mode.MANUAL),
    lambda c: c.command_mode(Mode.AUTOMATIC),
    lambda c: setattr(c, "manual_output", 120.0),
    lambda c: setattr(c, "setpoint", 57.0),
    lambda c: c.stage(P),
    lambda c: c.try_gains(PI2),
    lambda c: c.accept(PID),
    lambda c: c.accept(c.in_effect),
    lambda c: c.go_back(),
    lambda c: c.start_relay(RelaySettings(70.0, 0.0, 60.0, 3, 0.0, 100.0)),
    lambda c: c.go_home(HOMES["manual"]),
    lambda c: c.without_pv(99.0),
]


@settings(deadline=None, max_examples=300)
@given(st.lists(st.sampled_from(range(len(COMMANDS))), max_size=40), st.sampled_from(list(HOMES)))
def test_any_order_of_commands_keeps_the_promises(order: list[int], home: str) -> None:
    c = channel(PI, mv_low=10.0, mv_high=90.0)
    for index in order:
        COMMANDS[index](c)
        assert 10.0 <= c.mv <= 90.0
        assert c.on_trial or c.in_effect == c.accepted
        assert (c.mode is Mode.EXPERIMENT) == (c.relay is not None) == (c.relay_state is RelayState.RUNNING)
    c.go_home(HOMES[home])
    assert (c.in_effect, c.on_trial, c.relay) == (c.accepted, False, None)
    assert (c.mode, c.setpoint, c.manual_output) == (HOMES[home].mode, 50.0, 45.0)
