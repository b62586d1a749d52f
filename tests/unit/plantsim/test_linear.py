"""Linear plants against closed forms and against python-control."""

from __future__ import annotations

import math

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from loopwright.plantsim.plant import LinearPlant

FIVE_LAGS = [1, 5, 10, 10, 5, 1]


def step_response(plant: LinearPlant, samples: int, mv: float = 1.0) -> np.ndarray:
    return np.array([plant.pv] + [plant.step(mv) for _ in range(samples)])


@pytest.mark.parametrize("dead_time", [0.0, 0.3, 1.0, 0.25, 0.07, 2.0499, 0.0999999])
def test_first_order_with_any_dead_time(dead_time: float) -> None:
    gain, lag, Ts = 3.0, 7.0, 0.1
    y = step_response(LinearPlant([gain], [lag, 1], dead_time, Ts), 400)
    t = np.arange(len(y)) * Ts - dead_time
    assert y == pytest.approx(np.where(t > 0, gain * (1 - np.exp(-np.maximum(t, 0) / lag)), 0), abs=1e-12)


def test_five_equal_lags() -> None:
    y = step_response(LinearPlant([1], FIVE_LAGS, 0.0, 0.1), 300)
    t = np.arange(len(y)) * 0.1
    exact = 1 - np.exp(-t) * sum(t**k / math.factorial(k) for k in range(5))
    assert y == pytest.approx(exact, abs=1e-12)


@pytest.mark.parametrize(
    ("num", "den"),
    [
        ([2, 2], [3, 4, 1]),
        ([-16, -58, 18, 36, 4], [61, 270, 361, 158, 23, 1]),
        ([24, 99, 72, 5], [144, 351, 223, 29, 1]),
        ([-1.5], [8, 1]),
        ([1], [1, 0.2, 1]),
        ([0.1], [1, 0]),
        ([1, 1], [4, 1, 0]),
    ],
)
def test_agrees_with_python_control_on_a_wandering_input(num: list[float], den: list[float]) -> None:
    Ts, n = 0.1, 500
    u = np.random.default_rng(7).normal(size=n)
    plant = LinearPlant(num, den, 0.0, Ts)
    y = np.array([plant.pv] + [plant.step(float(value)) for value in u[:-1]])
    oracle = control.sample_system(control.tf(num, den), Ts)
    _, expected = control.forced_response(oracle, np.arange(n) * Ts, u)
    assert y == pytest.approx(expected, abs=1e-8 * max(1.0, float(np.abs(expected).max())))


def test_whole_dead_time_only_delays() -> None:
    u = np.random.default_rng(3).normal(size=200)
    prompt, late = LinearPlant([1], FIVE_LAGS, 0.0, 0.1), LinearPlant([1], FIVE_LAGS, 0.3, 0.1)
    first = np.array([prompt.step(float(v)) for v in u])
    second = np.array([late.step(float(v)) for v in u])
    assert second[3:] == pytest.approx(first[:-3], abs=1e-12)
    assert not second[:3].any()


def test_a_fraction_of_a_sample_is_the_same_plant_sampled_more_finely() -> None:
    u = np.random.default_rng(5).normal(size=150)
    coarse, fine = LinearPlant([2, 3], [6, 7, 1], 0.35, 0.1), LinearPlant([2, 3], [6, 7, 1], 0.35, 0.05)
    for value in u:
        fine.step(float(value))
        assert coarse.step(float(value)) == pytest.approx(fine.step(float(value)), abs=1e-12)


@pytest.mark.parametrize("dead_time", [0.0, 2.0, 2.04])
def test_direct_feed_through_shows_a_sample_after_the_move_and_not_before(dead_time: float) -> None:
    y = step_response(LinearPlant([-2, 5], [5, 1], dead_time, 0.1), 600)
    t = np.arange(len(y)) * 0.1 - dead_time
    exact = np.where(t > 1e-9, 5 - 5.4 * np.exp(-np.maximum(t, 0) / 5), 0.0)
    assert y == pytest.approx(exact, abs=1e-12)


def test_a_pure_gain_is_a_plant_too() -> None:
    assert step_response(LinearPlant([3], [2], 0.2, 0.1), 5) == pytest.approx([0, 0, 0, 1.5, 1.5, 1.5])


def test_integrator_ramps() -> None:
    y = step_response(LinearPlant([0.1], [1, 0], 0.15, 0.1), 100)
    assert y == pytest.approx(0.1 * np.maximum(np.arange(101) * 0.1 - 0.15, 0), abs=1e-12)


def test_units_limits_and_load() -> None:
    plant = LinearPlant([2], [5, 1], 1.0, 0.1, mv_nominal=50, pv_nominal=50, mv_per_unit=100, mv_low=0, mv_high=100)
    assert [plant.step(50) for _ in range(50)] == [50.0] * 50
    assert step_response(plant, 2000, mv=1000)[-1] == pytest.approx(51.0)
    plant.disturbance = 10.0
    assert step_response(plant, 2000, mv=1000)[-1] == pytest.approx(51.2)
    plant.disturbance = 0.0
    assert step_response(plant, 2000, mv=-1000)[-1] == pytest.approx(49.0)


def test_an_output_that_is_no_number_leaves_the_actuator_where_it_was() -> None:
    plant, twin = LinearPlant([2], [5, 1], 1.0, 0.1), LinearPlant([2], [5, 1], 1.0, 0.1)
    for _ in range(20):
        plant.step(1.0), twin.step(1.0)
    assert [plant.step(math.nan) for _ in range(20)] == [twin.step(1.0) for _ in range(20)]


def test_noise_is_seeded_gaussian_and_only_measured() -> None:
    def noisy(seed: int) -> np.ndarray:
        return step_response(LinearPlant([1], [1, 1], 0.0, 0.1, noise_std=0.03, seed=seed), 20000, mv=0.0)

    first = noisy(1)
    assert (noisy(1) == first).all()
    assert (noisy(2) != first).all()
    assert first.mean() == pytest.approx(0, abs=1e-3)
    assert first.std() == pytest.approx(0.03, rel=0.02)
    assert np.corrcoef(first[1:], first[:-1])[0, 1] == pytest.approx(0, abs=0.03)


@pytest.mark.parametrize(
    ("num", "den", "dead_time", "sample_time"),
    [
        ([1, 0, 0], [1, 1], 0, 0.1),
        ([1], [0, 0], 0, 0.1),
        ([1], [1, 1], -1, 0.1),
        ([1], [1, 1], math.nan, 0.1),
        ([1], [1, 1], 0, 0.0),
        ([math.inf], [1, 1], 0, 0.1),
    ],
)
def test_refuses_what_is_no_plant(num: list[float], den: list[float], dead_time: float, sample_time: float) -> None:
    with pytest.raises(ValueError):
        LinearPlant(num, den, dead_time, sample_time)


@settings(deadline=None, max_examples=50)
@given(
    lag=st.floats(0.05, 50),
    dead_time=st.floats(0, 3),
    sample_time=st.sampled_from([0.01, 0.1, 0.25, 1.0]),
    moves=st.lists(st.floats(-10, 10), min_size=1, max_size=30),
)
def test_superposition_holds_for_any_moves(
    lag: float, dead_time: float, sample_time: float, moves: list[float]
) -> None:
    plant = LinearPlant([1], [lag, 1], dead_time, sample_time)
    y = [plant.step(u) for u in moves]

    def unit(t: float) -> float:
        return 1 - math.exp(-t / lag) if t > 0 else 0.0

    steps = np.diff([0.0, *moves])
    for n, value in enumerate(y, start=1):
        exact = sum(du * unit((n - k) * sample_time - dead_time) for k, du in enumerate(steps) if k < n)
        assert value == pytest.approx(exact, abs=1e-6)
