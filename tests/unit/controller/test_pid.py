"""The control law against difference equations written out, and against python-control around a plant."""

from __future__ import annotations

import math

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from loopwright.controller.channel import Channel, Mode, Parameters, Settings
from loopwright.plantsim.plant import LinearPlant

Ts = 0.1
WIDE = Settings(mv_low=-1e9, mv_high=1e9, pv_low=-1e9, pv_high=1e9)


def closed_loop(plant: LinearPlant, channel: Channel, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """PV and MV after a unit set-point step at sample 0, the loop at rest before."""
    channel.step(plant.pv)
    channel.setpoint += 1.0
    y, u = [], []
    for _ in range(samples):
        y.append(plant.pv)
        u.append(channel.step(plant.pv))
        plant.step(u[-1])
    return np.array(y), np.array(u)


@pytest.mark.parametrize(
    "p",
    [
        Parameters(1.2),
        Parameters(0.8, Ti=4),
        Parameters(0.8, Ti=4, b=0.4),
        Parameters(1.0, Ti=5, Td=0.8, Tf=0.2),
        Parameters(1.0, Ti=5, Td=0.8, Tf=0.2, b=0.5, c=1.0),
        Parameters(0.5, Ti=5, Td=0.05),
        Parameters(0.9, Td=0.5, Tf=0.1),
    ],
)
def test_closed_loop_is_that_of_the_transfer_functions(p: Parameters) -> None:
    num, den, n = [2.0], [3.0, 4.0, 1.0], 400
    y, u = closed_loop(LinearPlant(num, den, 0.0, Ts), Channel(Ts, WIDE, p, 0.0, Mode.AUTOMATIC), n)

    z = control.tf("z")
    z.dt = Ts
    one = control.tf([1], [1], Ts)
    integral = one * p.Kp * Ts / p.Ti / (z - 1) if p.Ti else one * 0
    slope = one * p.Kp * p.Td * (z - 1) / ((p.Tf + Ts) * z - p.Tf) if p.Td else one * 0
    from_sp, from_pv = p.Kp * p.b + integral + p.c * slope, p.Kp + integral + slope
    plant = control.sample_system(control.tf(num, den), Ts)
    # u = from_sp*r - from_pv*G*u; state space keeps the accuracy that products of polynomials lose.
    inner = control.feedback(one, control.ss(plant) * control.ss(from_pv))
    t = np.arange(n) * Ts
    _, expected_u = control.forced_response(inner * control.ss(from_sp), t, np.ones(n))
    _, expected_y = control.forced_response(control.ss(plant), t, expected_u)
    assert u == pytest.approx(expected_u, abs=1e-6)
    assert y == pytest.approx(expected_y, abs=1e-6)


def test_tends_to_the_continuous_loop_as_the_sample_time_shrinks() -> None:
    plant, pi = control.tf([2], [3, 4, 1]), control.tf([0.8 * 4, 0.8], [4, 0])
    worst = []
    for sample_time in (0.1, 0.05, 0.025):
        n = round(20 / sample_time)
        channel = Channel(sample_time, WIDE, Parameters(0.8, Ti=4), 0.0, Mode.AUTOMATIC)
        y, _ = closed_loop(LinearPlant([2], [3, 4, 1], 0.0, sample_time), channel, n)
        _, exact = control.step_response(control.feedback(pi * plant, 1), np.arange(n) * sample_time)
        worst.append(np.abs(y - exact).max())
    assert worst[0] < 0.03
    assert worst[1] / worst[0] == pytest.approx(0.5, abs=0.05)
    assert worst[2] / worst[1] == pytest.approx(0.5, abs=0.05)


def test_p_control_leaves_its_bias_alone_however_long_it_saturates() -> None:
    channel = Channel(Ts, Settings(), Parameters(2.0), 50.0, Mode.AUTOMATIC, 40.0)
    assert channel.step(50.0) == 40.0
    assert [channel.step(0.0) for _ in range(5000)][-1] == 100.0
    assert channel.step(51.0) == pytest.approx(38.0)


def test_integral_does_not_wind_up() -> None:
    channel = Channel(Ts, Settings(), Parameters(1.0, Ti=5.0), 50.0, Mode.AUTOMATIC, 50.0)
    for _ in range(20000):
        channel.step(20.0)
    assert channel.mv == 100.0
    assert channel.step(55.0) == pytest.approx(95.0, abs=0.1)


@pytest.mark.parametrize(("Td", "tracking_s"), [(0.0, 5.0), (0.8, 2.0)])
def test_a_saturated_integral_rests_where_tracking_takes_away_what_the_error_adds(Td: float, tracking_s: float) -> None:
    # A slow filter keeps the derivative's own answer to the last move out of sight.
    channel = Channel(Ts, Settings(), Parameters(1.0, Ti=5.0, Td=Td, Tf=1e6), 50.0, Mode.AUTOMATIC, 50.0)
    for _ in range(5000):
        channel.step(30.0)
    excess = 20.0 / 5.0 * tracking_s
    assert channel.step(30.0 + excess + 1.0) == pytest.approx(99.0, abs=1e-3)


def test_integral_does_not_wind_up_behind_the_rate_limit() -> None:
    channel = Channel(Ts, Settings(rate_limit_per_s=1.0), Parameters(1.0, Ti=5.0), 50.0, Mode.AUTOMATIC, 50.0)
    channel.step(50.0)
    u = np.array([channel.step(40.0) for _ in range(100)] + [channel.step(52.0) for _ in range(20)])
    assert np.abs(np.diff(u)).max() == pytest.approx(0.1)
    assert u[100] < u[99]


def test_direct_action_mirrors_reverse_action() -> None:
    up = Channel(Ts, Settings(), Parameters(1.5, 3, 0.4, 0.1, 0.7, 0.3), 50.0, Mode.AUTOMATIC, 50.0)
    down = Channel(Ts, Settings(reverse=False), Parameters(1.5, 3, 0.4, 0.1, 0.7, 0.3), 50.0, Mode.AUTOMATIC, 50.0)
    for pv in 50 + np.sin(np.arange(200) / 9):
        assert up.step(float(pv)) - 50 == pytest.approx(50 - down.step(float(pv)), abs=1e-9)


def test_negative_gain_plant_under_direct_action_settles() -> None:
    plant = LinearPlant([-1.5], [8, 1], 2.0, Ts, mv_nominal=50, pv_nominal=50)
    channel = Channel(Ts, Settings(reverse=False), Parameters(1.5, 8), 50.0, Mode.AUTOMATIC, 50.0)
    channel.step(plant.pv)
    channel.setpoint = 55.0
    for _ in range(2000):
        plant.step(channel.step(plant.pv))
    assert plant.pv == pytest.approx(55.0, abs=1e-3)


@pytest.mark.parametrize(
    "values",
    [{"Kp": 0.0}, {"Kp": -1.0}, {"Kp": math.nan}, {"Kp": 1, "Ti": -1}, {"Kp": 1, "Td": math.inf}, {"Kp": 1, "Tf": -1}],
)
def test_refuses_parameters_without_meaning(values: dict[str, float]) -> None:
    with pytest.raises(ValueError):
        Parameters(**values)


numbers = st.floats(-1e4, 1e4)


@settings(deadline=None, max_examples=200)
@given(
    parameters=st.builds(Parameters, st.floats(1e-3, 1e3), st.sampled_from([0.0, 0.01, 3.0, 1e4]), st.floats(0, 10)),
    pvs=st.lists(st.one_of(numbers, st.sampled_from([math.nan, math.inf, -math.inf])), min_size=1, max_size=60),
    setpoint=numbers,
    rate=st.sampled_from([0.0, 5.0]),
)
def test_limits_and_rate_hold_whatever_is_measured(
    parameters: Parameters, pvs: list[float], setpoint: float, rate: float
) -> None:
    channel = Channel(Ts, Settings(10, 90, 20, rate), parameters, setpoint, Mode.AUTOMATIC, 50.0)
    before = channel.mv
    for pv in pvs:
        mv = channel.step(pv)
        assert 10 <= mv <= 90
        assert not rate or abs(mv - before) <= rate * Ts + 1e-9
        before = mv
    # Nothing that was measured stays in the way: with PV far below, MV ends at the top.
    for _ in range(300):
        channel.step(setpoint)
    assert math.isfinite(channel.mv)
