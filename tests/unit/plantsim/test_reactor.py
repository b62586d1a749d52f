"""The reactor against its balance, its recomputed linear figures, and itself sampled differently."""

from __future__ import annotations

import math

import numpy as np
import pytest

from loopwright.controller.channel import Channel, Mode, Parameters, Settings
from loopwright.plantsim.reactor import INLET, MV_NOMINAL, STEADY_STATE, Reactor, derivative


def pvs(sample_time: float, duration: float, mv: float) -> np.ndarray:
    reactor = Reactor(sample_time)
    return np.array([reactor.step(mv) for _ in range(round(duration / sample_time))])


def test_the_initial_state_is_at_rest() -> None:
    assert max(map(abs, derivative(STEADY_STATE, MV_NOMINAL, INLET))) < 1e-10
    reactor = Reactor(0.1)
    for _ in range(5000):
        reactor.step(50.0)
    assert reactor.state == pytest.approx(STEADY_STATE, rel=1e-12)


def test_linear_gain() -> None:
    both = (pvs(0.5, 400, mv)[-1] for mv in (50.1, 49.9))
    assert (next(both) - next(both)) / 0.2 == pytest.approx(0.774, abs=0.001)


def test_waits_for_the_sensor_then_answers_inversely() -> None:
    y = pvs(0.1, 100, 51.0) - STEADY_STATE[2]
    assert np.abs(y[:100]).max() < 1e-10
    assert y[120] < -0.005
    assert y.min() > -0.15
    assert y[-1] > 0.75


@pytest.mark.parametrize("sample_time", [0.3, 0.7, 1.0, 3.0])
def test_does_not_depend_on_the_sample_time(sample_time: float) -> None:
    reference, other = pvs(0.1, 63, 60.0), pvs(sample_time, 63, 60.0)
    every = round(sample_time / 0.1)
    assert other == pytest.approx(reference[every - 1 :: every], abs=2e-5)


def swing(Kp: float) -> float:
    """How much a P loop's oscillation grows from the third to the sixth hundred s after a small set-point step."""
    Ts = 0.1
    reactor = Reactor(Ts)
    channel = Channel(Ts, Settings(pv_high=1000), Parameters(Kp), STEADY_STATE[2], Mode.AUTOMATIC, MV_NOMINAL)
    channel.step(reactor.pv)
    channel.setpoint += 0.05
    y = np.array([reactor.step(channel.step(reactor.pv)) for _ in range(6000)])
    return float(np.ptp(y[5000:]) / np.ptp(y[2000:3000]))


def test_ultimate_gain_under_p_control() -> None:
    assert swing(1.51) < 0.97
    assert swing(1.529) == pytest.approx(1, abs=0.025)
    assert swing(1.55) > 1.03


@pytest.mark.parametrize("mv", [-50.0, 0.0, 100.0, 1000.0])
def test_survives_the_ends_of_its_range(mv: float) -> None:
    y = pvs(0.1, 600, mv)
    assert np.isfinite(y).all()
    assert y[-1] == pytest.approx(y[-1000], abs=1e-3)


def test_hotter_feeds_are_a_disturbance_and_the_load_acts_as_the_output() -> None:
    hotter, loaded, moved = Reactor(0.1), Reactor(0.1), Reactor(0.1)
    hotter.inlet_offset_K = 10.0
    loaded.disturbance = 3.0
    for _ in range(3000):
        hotter.step(50.0)
        assert loaded.step(50.0) == moved.step(53.0)
    assert hotter.state[4] > STEADY_STATE[4] + 3
    assert abs(hotter.pv - STEADY_STATE[2]) > 1


def test_holds_its_valves_on_an_output_that_is_no_number() -> None:
    reactor = Reactor(0.1)
    for _ in range(200):
        reactor.step(math.nan)
    assert reactor.pv == pytest.approx(STEADY_STATE[2])
