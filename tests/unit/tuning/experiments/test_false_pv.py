"""A PV that is false within its limits is told from one that is rounded, renewed seldom, without noise, with spikes,
under a load, or of a fast plant."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from loopwright.tuning.experiments.false_pv import PvWatch
from loopwright.tuning.experiments.pv_at_rest import PvAtRest, check_end_of_rest
from loopwright.tuning.reasons import FalsePv, Reason

AT, NOISE, REST = 60.0, 0.05, 100
STILL = np.zeros(400)
WAVE = 3.0 * np.sin(2.0 * np.pi * np.arange(400) / 60.0)
STEPS = np.concatenate([np.zeros(10), np.where(np.arange(390) // 40 % 2, -4.0, 8.0)])
"""A plant whose lag is far shorter than its sample time, behind a dead time of 10 samples."""
LAGGED = np.convolve(STEPS, 0.63 * 0.37 ** np.arange(30))[:400]


def sent(way: np.ndarray, seed: int, quantum: float = 0.0, renewal: int = 1, noise: float = NOISE) -> list[float]:
    """PV at rest for REST samples, then this way, through a sensor."""
    true = AT + np.concatenate([np.zeros(REST), way])
    pv = true + noise * np.random.default_rng(seed).standard_normal(len(true))
    pv = pv[(np.arange(len(pv)) // renewal) * renewal]
    if quantum:
        pv = np.round(pv / (quantum * NOISE)) * quantum * NOISE
    return [float(value) for value in pv]


def seen(pv: list[float], moved: float = 60.0) -> FalsePv | None:
    """What the watch says of a record, of which MV has moved from 40 to `moved` after the rest."""
    watch = PvWatch(PvAtRest.of(pv[:REST]), 40.0, 1.0, 0.0, 100.0)
    for n, value in enumerate(pv[REST:]):
        try:
            watch.check(value, moved if n // 40 % 2 == 0 else 30.0)
        except FalsePv as false:
            false.add_note(str(n))
            return false
    return None


def told_at(false: FalsePv | None) -> int:
    assert false is not None
    return int(false.__notes__[0])


FALSE: dict[str, Callable[[float, int], np.ndarray]] = {
    "frozen": lambda last, n: np.full(n, last),
    "zero": lambda last, n: np.zeros(n),
    "half": lambda last, n: np.full(n, 0.5 * last),
    "quiet": lambda last, n: last + 0.25 * NOISE * np.random.default_rng(9).standard_normal(n),
    "loud": lambda last, n: last + 5.0 * NOISE * np.random.default_rng(9).standard_normal(n),
}


@pytest.mark.parametrize("kind", FALSE)
@pytest.mark.parametrize("way", [STILL, WAVE], ids=["still", "wave"])
@pytest.mark.parametrize("at", [3, 47, 260])
def test_a_false_pv_is_told_within_a_few_samples(kind: str, way: np.ndarray, at: int) -> None:
    pv = sent(way, 3)
    pv[REST + at :] = [float(value) for value in FALSE[kind](pv[REST + at - 1], len(way) - at)]
    false = seen(pv)
    assert at <= told_at(false) <= at + (14 if kind in ("frozen", "zero", "half") else 32)
    assert false is not None
    if kind in ("quiet", "loud"):
        assert false.reason is Reason.PV_FROZEN and "times that at rest" in false.detail
    else:  # where PV jumps, and then stands still, either may be told first
        assert any(words in false.detail for words in ("is exactly", "within one sample", "times that at rest"))


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from([STILL, WAVE, STEPS, LAGGED]),
    st.integers(0, 10**6),
    st.one_of(st.just(0.0), st.floats(0.1, 3.0)),
    st.one_of(st.just(1), st.integers(2, 20)),
    st.sampled_from([NOISE, NOISE, 0.0]),
)
def test_a_true_pv_is_never_taken_for_false(
    way: np.ndarray, seed: int, quantum: float, renewal: int, noise: float
) -> None:
    assert seen(sent(way, seed, quantum, renewal, noise)) is None


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 3), st.integers(0, 350), st.sampled_from([0.0, 30.0, 600.0]))
def test_one_to_three_wrong_samples_are_survived(seed: int, wrong: int, at: int, value: float) -> None:
    pv = sent(WAVE, seed)
    pv[REST + at : REST + at + wrong] = [value] * wrong
    assert seen(pv) is None


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.5, 20.0), st.floats(-100.0, 100.0), st.integers(0, 100))
def test_a_load_through_a_lag_near_the_sample_time_is_no_jump(seed: int, lag: float, size: float, at: int) -> None:
    """lag: in samples."""
    load = np.where(np.arange(400) >= at, size * (1.0 - np.exp(-(np.arange(400) - at) / lag)), 0.0)
    assert seen(sent(load, seed)) is None


def test_a_coarse_pv_that_rests_at_one_value_may_rest_there_for_long() -> None:
    pv = [60.0] * REST + [60.0] * 150 + [60.5, 61.0] * 2 + [61.0] * 190
    assert PvAtRest.of(pv[:REST]).run_limit is None
    assert seen(pv) is None


def test_a_pv_without_noise_that_stops_in_the_middle_of_its_way_is_false() -> None:
    way = np.minimum(np.arange(400) * 0.1, 3.0)
    pv = [float(value) for value in AT + np.concatenate([np.zeros(REST), way])]
    false = seen(pv)
    assert false is not None and false.reason is Reason.PV_FROZEN
    assert told_at(false) < 30 + 30
    watch = PvWatch(PvAtRest.of([AT] * REST), 40.0, 1.0, 0.0, 100.0)
    for n in range(400):
        watch.check(AT + 3.0 - 3.0 * 0.8**n, 60.0)  # a lag comes to rest slowly


def test_of_a_pv_without_noise_that_has_never_moved_nothing_is_said() -> None:
    assert seen([AT] * (REST + 400)) is None


def test_a_pv_that_ends_at_rest_is_told_before_anything_moves() -> None:
    pv = sent(STILL, 5)[:REST]
    check_end_of_rest(pv)
    check_end_of_rest([AT] * REST)
    with pytest.raises(FalsePv, match="for the last 26 samples at rest"):
        check_end_of_rest([*pv, *[pv[-1]] * 25])


def test_what_is_learned_of_a_rest() -> None:
    rest = PvAtRest.of(sent(STILL, 7, quantum=0.5, renewal=4)[:REST])
    assert (rest.renewal, rest.samples) == (4, REST)
    assert rest.quantum == pytest.approx(0.5 * NOISE)
    assert 4 <= rest.longest_run <= 16
    assert 0.5 * NOISE < rest.smallest_noise <= rest.noise < 2.0 * NOISE
    nothing = PvAtRest.of([])
    assert nothing.samples == 0 and math.isnan(nothing.value) and not nothing.lively
