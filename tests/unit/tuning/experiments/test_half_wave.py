"""When a half wave of the relay ends because PV goes the wrong way, and what counts as a move of PV."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from loopwright.tuning.experiments.half_wave import HalfWaves, has_moved
from loopwright.tuning.experiments.primitives import Facts, OperatingPoint
from loopwright.tuning.gains import Gains
from loopwright.tuning.reasons import Reason

TS, NOISE, T95 = 0.5, 0.05, 100.0
POINT = OperatingPoint(60.0, 60.0, 40.0, NOISE, 30.0)


def ended_after(pv: np.ndarray, T95_s: float = T95, up: bool = True, noise: float = NOISE) -> int | None:
    """The number of samples after which the first half wave has ended."""
    facts = Facts(TS, T95_s, 0.0, 100.0, 2.0, Gains(1.0, 30.0))
    waves = HalfWaves(facts, POINT, noise, 2.2 * noise)
    for n, value in enumerate(pv):
        if waves.goes_wrong(float(value), up):
            assert waves.wrong_sign().reason is Reason.WRONG_SIGN
            return n + 1
    return None


def response(gain: float, T: float, L: float, seed: int = 1, seconds: float = 300.0) -> np.ndarray:
    t = np.arange(0.0, seconds, TS)
    moved = np.where(t > L, gain * (1.0 - np.exp(-np.maximum(t - L, 0.0) / T)), 0.0)
    return 60.0 + moved + NOISE * np.random.default_rng(seed).standard_normal(len(t))


@pytest.mark.parametrize("stated", [1.0, 10.0])
@pytest.mark.parametrize("up", [True, False])
def test_the_wrong_action_is_seen_within_about_a_dead_time(stated: float, up: bool) -> None:
    """K 0.8, T 30 s, L 6 s, MV moved by 30 %: 6 s after PV has left its band it is 4.3 away."""
    pv = response(-24.0 if up else 24.0, 30.0, 6.0)
    n = ended_after(pv, stated * T95, up)
    assert n is not None and n * TS <= 6.0 + 1.8 * 6.0
    assert ended_after(response(24.0 if up else -24.0, 30.0, 6.0), stated * T95, up) is None


@settings(max_examples=50, deadline=None)
@given(st.floats(0.1, 1.0), st.floats(2.0, 30.0), st.floats(0.5, 10.0), st.integers(0, 10**6))
def test_an_inverse_response_is_waited_for(slow: float, T: float, L: float, seed: int) -> None:
    """(1 - b s) / (T s + 1)^2, b up to T; MV's move is worth six permitted steps."""
    t = np.arange(0.0, 8.0 * T + L, TS)
    since = np.maximum(t - L, 0.0) / T
    moved = 1.0 - np.exp(-since) * (1.0 + since + slow * since)
    pv = 60.0 + 12.0 * moved + NOISE * np.random.default_rng(seed).standard_normal(len(t))
    assert ended_after(pv, 5.0 * T + L) is None


def test_a_creep_of_a_pv_without_noise_is_no_way_that_it_goes() -> None:
    """During a dead time of 0.3 T95, which an inverse response of 0.17 T95 follows."""
    creep = 60.0 - 1e-6 * np.arange(round(0.3 * T95 / TS))
    t = np.arange(0.0, 0.17 * T95, TS)
    inverse = 60.0 - np.sin(np.pi * t / t[-1])
    assert ended_after(np.concatenate([creep, inverse, 60.0 + t / t[-1]]), noise=0.0) is None


def test_noise_is_no_move_and_a_slow_answer_within_it_is() -> None:
    noise = NOISE * np.random.default_rng(3).standard_normal(300)
    ramp = np.linspace(0.0, 2.0 * NOISE, 300)
    assert not has_moved(list(noise), NOISE, 0.0)
    assert has_moved(list(noise + ramp), NOISE, 0.0)
    assert not has_moved([60.0] * 300, 0.0, 1e-3)
    assert has_moved([60.0, 60.0, 60.1, 60.1], 0.0, 1e-3)
    assert not has_moved([], NOISE, 0.0)
