"""Modes, changes without bumps, trials, the session and the relay."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.channel import Cause, Channel, ExperimentState, Mode, Parameters, Settings
from plantsim.plant import LinearPlant

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


def relay(c: Channel, amplitude: float = 10.0, hysteresis: float = 0.0, working: float = 50.0, parallel: float = 0.0,
          samples: int = 1000, low: float = 0.0, high: float = 100.0) -> None:  # fmt: skip
    c.start_relay(amplitude, hysteresis, working, parallel, samples, low, high)


@ACTIONS
@pytest.mark.parametrize(("before", "after"), list(itertools.permutations(LAWS, 2)))
def test_new_gains_do_not_move_the_output(before: str, after: str, reverse: bool) -> None:
    c = channel(LAWS[before], reverse=reverse)
    mv = moving(c)
    c.stage(LAWS[after])
    c.try_staged()
    assert c.on_trial and c.in_effect == LAWS[after] and c.accepted == LAWS[before]
    assert c.step(49.2) == pytest.approx(mv, abs=1e-9)
    c.go_back(Cause.COMMAND)
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
        c.stage(after)
        c.try_staged()
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
    assert c.in_effect == PI and not c.on_trial
    c.try_staged()
    c.accept()
    assert (c.accepted, c.on_trial, c.accept_count) == (PI2, False, 1)
    c.go_back(Cause.COMMAND)
    assert (c.in_effect, c.cause) == (PI2, Cause.COMMAND)


def trial(c: Channel) -> None:
    """What a tuner does in its session: another law, set-point, output and mode."""
    c.stage(PI2)
    c.try_staged()
    c.setpoint = 53.0
    c.step(49.2)
    c.command_mode(Mode.MANUAL)
    c.manual_output = 70.0
    c.step(49.2)


def test_a_lease_used_up_brings_everything_back() -> None:
    c = channel(PI)
    moving(c)
    c.renew_lease(5)
    trial(c)
    assert (c.lease, c.cause) == (3, Cause.NONE)
    c.renew_lease(2)
    c.step(49.2)
    assert c.mode is Mode.MANUAL
    mv = c.step(49.2)
    assert (c.mode, c.setpoint, c.in_effect, c.on_trial) == (Mode.AUTOMATIC, 50.0, PI, False)
    assert (c.lease, c.cause, c.manual_output) == (0, Cause.LEASE, 45.0)
    assert c.step(49.2) == pytest.approx(mv)


def test_the_session_notes_the_loop_when_it_opens_not_when_it_is_renewed() -> None:
    c = channel(PI, Mode.MANUAL)
    c.renew_lease(100)
    c.command_mode(Mode.AUTOMATIC)
    c.renew_lease(100)
    c.go_back(Cause.HEARTBEAT)
    assert (c.mode, c.manual_output, c.step(49.0), c.cause) == (Mode.MANUAL, 45.0, 45.0, Cause.HEARTBEAT)


def test_closing_the_session_ends_the_trial_and_leaves_the_rest() -> None:
    c = channel(PI)
    c.renew_lease(100)
    trial(c)
    mv = c.step(49.2)
    c.renew_lease(0)
    for _ in range(200):
        assert c.step(49.2) == mv
    assert (c.mode, c.setpoint, c.in_effect, c.lease, c.cause) == (Mode.MANUAL, 53.0, PI, 0, Cause.NONE)
    assert not c.on_trial


def test_closing_the_session_ends_an_experiment_without_a_bump() -> None:
    c = channel(PI)
    c.renew_lease(100)
    relay(c)
    mv = c.step(50.0)
    c.renew_lease(0)
    assert (c.mode, c.experiment_state) == (Mode.AUTOMATIC, ExperimentState.DONE)
    assert c.step(50.0) == pytest.approx(mv)


def test_the_next_session_notes_the_loop_as_it_is_then() -> None:
    c = channel(PI)
    c.renew_lease(100)
    c.setpoint = 52.0
    c.renew_lease(0)
    c.renew_lease(100)
    c.setpoint = 53.0
    c.go_back(Cause.COMMAND)
    assert c.setpoint == 52.0


def test_a_lease_runs_out_on_bad_measurements_too() -> None:
    c = channel(PI)
    moving(c)
    c.renew_lease(3)
    c.stage(PI2)
    c.try_staged()
    for _ in range(3):
        c.step(math.nan)
    assert (c.in_effect, c.cause) == (PI, Cause.LEASE)


@ACTIONS
def test_relay_switches_on_the_sign_of_the_error(reverse: bool) -> None:
    c = channel(PI, reverse=reverse)
    relay(c)
    assert c.mode is Mode.EXPERIMENT and c.experiment_state is ExperimentState.RUNNING
    below, above = (60.0, 40.0) if reverse else (40.0, 60.0)
    assert [c.step(pv) for pv in (49.9, 50.1, 49.9)] == [below, above, below]
    assert c.step(50.0) == 60.0


def test_relay_keeps_its_side_within_the_hysteresis() -> None:
    c = channel(PI)
    relay(c, hysteresis=1.0)
    assert [c.step(pv) for pv in (49.5, 50.5, 51.0, 50.5, 49.5, 49.0, 50.9)] == [60, 60, 40, 40, 40, 60, 60]


def test_relay_adds_its_parallel_path_and_keeps_the_limits() -> None:
    c = channel(PI, mv_high=61.0)
    relay(c, parallel=0.5)
    assert c.step(49.0) == pytest.approx(60.5)
    assert c.step(40.0) == 61.0


def test_relay_ends_at_a_pv_limit_without_a_bump() -> None:
    c = channel(PI)
    moving(c)
    relay(c, low=45.0, high=55.0)
    c.step(54.9)
    mv = c.step(54.9)
    assert c.step(55.1) == pytest.approx(mv, abs=0.5)
    assert (c.mode, c.cause, c.experiment_state) == (Mode.AUTOMATIC, Cause.PV_LIMIT, ExperimentState.ENDED_BY_LIMIT)


def test_relay_ends_after_its_samples_into_the_sessions_mode() -> None:
    c = channel(PI)
    moving(c)
    c.renew_lease(1000)
    c.command_mode(Mode.MANUAL)
    c.setpoint = 51.0
    relay(c, samples=10)
    modes = [c.step(49.2) and c.mode for _ in range(12)]
    assert modes == [Mode.EXPERIMENT] * 10 + [Mode.AUTOMATIC] * 2
    assert (c.setpoint, c.lease, c.experiment_state) == (50.0, 0, ExperimentState.DONE)


def test_relay_outside_a_session_comes_back_to_the_mode_before_it() -> None:
    for mode in (Mode.MANUAL, Mode.AUTOMATIC):
        c = channel(PI, mode)
        relay(c, samples=2)
        relay(c, samples=2)
        for _ in range(3):
            c.step(49.0)
        assert c.mode is mode


def test_a_session_opened_during_a_relay_comes_back_to_the_mode_before_it() -> None:
    c = channel(PI)
    relay(c)
    c.renew_lease(3)
    for _ in range(3):
        c.step(49.0)
    assert (c.mode, c.cause) == (Mode.AUTOMATIC, Cause.LEASE)


def test_relay_ends_into_automatic_by_command_without_a_bump() -> None:
    c = channel(PI)
    moving(c)
    relay(c)
    mv = c.step(49.2)
    c.command_mode(Mode.AUTOMATIC)
    assert c.step(49.2) == pytest.approx(mv)
    assert c.experiment_state is ExperimentState.DONE


def test_relay_swings_a_plant_at_its_ultimate_period() -> None:
    plant = LinearPlant([1], [1, 5, 10, 10, 5, 1], 0.0, 0.02, mv_nominal=50, pv_nominal=50)
    c = Channel(0.02, Settings(), PI, 50.0, Mode.AUTOMATIC, 50.0)
    c.step(plant.pv)
    relay(c, samples=10**6)
    y = np.array([plant.step(c.step(plant.pv)) for _ in range(6000)]) - 50
    ups = np.nonzero((y[:-1] < 0) & (y[1:] >= 0))[0]
    assert np.diff(ups)[-5:].mean() * 0.02 == pytest.approx(8.648, rel=0.02)
    assert 4 * 10 / (math.pi * np.ptp(y[-1000:]) / 2) == pytest.approx(2.885, rel=0.03)


REFUSED: list[Callable[[Channel], object]] = [
    lambda c: c.command_mode(7),
    lambda c: c.command_mode(Mode.EXPERIMENT),
    lambda c: c.renew_lease(-1),
    lambda c: relay(c, amplitude=0),
    lambda c: relay(c, hysteresis=-1),
    lambda c: relay(c, samples=0),
    lambda c: relay(c, low=60, high=40),
    lambda c: relay(c, working=math.nan),
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
    assert (c.mode, c.setpoint, c.settings, c.lease) == (Mode.AUTOMATIC, 50.0, Settings(), 0)
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
    lambda c: c.stage(PI2),
    lambda c: c.stage(P),
    lambda c: c.try_staged(),
    lambda c: c.accept(),
    lambda c: relay(c, amplitude=70.0, parallel=3.0, samples=3),
    lambda c: c.renew_lease(4),
    lambda c: c.renew_lease(0),
    lambda c: c.go_back(Cause.NMT),
]


@settings(deadline=None, max_examples=300)
@given(st.lists(st.sampled_from(range(len(COMMANDS))), max_size=40))
def test_any_order_of_commands_keeps_the_promises(order: list[int]) -> None:
    c = channel(PI, mv_low=10.0, mv_high=90.0)
    for index in order:
        COMMANDS[index](c)
        assert 10.0 <= c.mv <= 90.0
        assert c.on_trial or c.in_effect == c.accepted
        assert (c.mode is Mode.EXPERIMENT) == (c.experiment_state is ExperimentState.RUNNING)
    c.renew_lease(2)
    latched = c.setpoint
    c.stage(PID)
    c.try_staged()
    c.setpoint = 1.0
    for _ in range(2):
        c.step(50.0)
    assert (c.in_effect, c.on_trial, c.lease) == (c.accepted, False, 0)
    assert c.setpoint in (latched, 50.0, 57.0)
    assert c.mode is not Mode.EXPERIMENT


def test_a_biased_relay_has_two_amplitudes_and_begins_high_within_its_hysteresis() -> None:
    c = channel()
    c.step(50.4)
    c.start_relay(10.0, 0.5, 50.0, 0.0, 1000, 0.0, 100.0, amplitude_low=5.0)
    outputs = [c.step(pv) for pv in (50.4, 50.6, 50.0, 49.6, 49.4, 50.0)]
    assert outputs == [60.0, 45.0, 45.0, 45.0, 60.0, 60.0]


def test_a_relay_that_averages_is_not_switched_by_one_sample() -> None:
    c = channel()
    c.step(50.0)
    c.start_relay(10.0, 0.5, 50.0, 0.0, 1000, 0.0, 100.0, average=3)
    # means of the last three: 0, 0.4, 0.4, 0.6
    assert [c.step(pv) for pv in (50.0, 51.2, 50.0, 50.6)] == [60.0, 60.0, 60.0, 40.0]


def test_a_running_relay_takes_new_amplitudes_on_the_side_it_is_on() -> None:
    c = channel()
    c.step(50.0)
    c.start_relay(10.0, 0.5, 50.0, 0.0, 1000, 0.0, 100.0)
    assert [c.step(pv) for pv in (51.0, 50.0)] == [40.0, 40.0]
    c.start_relay(20.0, 0.5, 50.0, 0.0, 1000, 0.0, 100.0, amplitude_low=15.0)
    assert [c.step(pv) for pv in (50.0, 49.0)] == [35.0, 70.0]


@pytest.mark.parametrize(("amplitude_low", "average"), [(-1.0, 1), (math.nan, 1), (5.0, 0), (5.0, 101)])
def test_a_biased_relay_refuses_what_it_cannot_do(amplitude_low: float, average: int) -> None:
    c = channel()
    c.step(50.0)
    with pytest.raises(ValueError):
        c.start_relay(10.0, 0.5, 50.0, 0.0, 1000, 0.0, 100.0, amplitude_low, average)
    assert c.mode is Mode.AUTOMATIC
