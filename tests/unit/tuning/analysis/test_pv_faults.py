"""What a column of PV shows of its sensor, on records made here, and on none that is sound."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.tuning.analysis.pv_faults import pv_faults, without_wrong_samples
from loopwright.tuning.models import Reals

N = 900


def pv(seed: int, noise: float = 0.05, moves: bool = True) -> Reals:
    """At rest for a fifth, then swinging as under a relay, at 60 degC."""
    t = np.arange(N)
    swing = 4.0 * np.sin(2.0 * np.pi * t / 90.0) * (t > N / 5) if moves else 0.0
    return np.asarray(60.0 + swing + noise * np.random.default_rng(seed).standard_normal(N))


def held(values: Reals, every: float) -> Reals:
    t = np.arange(len(values))
    return np.asarray(values[np.minimum(np.floor(np.floor(t / every) * every + 0.999).astype(int), t)])


@pytest.mark.parametrize("every", [2.0, 3.0, 4.8, 9.0, 17.0])
@pytest.mark.parametrize("step", [0.0, 0.1])
def test_a_pv_that_is_renewed_seldom_is_told_with_its_interval(every: float, step: float) -> None:
    values = pv(1)
    values = held(np.round(values / step) * step if step else values, every)
    found = pv_faults(values)
    assert found.renewed == pytest.approx(every, rel=0.03)
    assert f"every {found.renewed * 0.5:.3g} s" in str(found.of_renewal(0.5))


@pytest.mark.parametrize("band", [0.3, 0.7])
def test_a_pv_that_is_sent_where_it_has_changed_is_told_with_the_change(band: float) -> None:
    values = pv(2)
    for k in range(1, N):
        if abs(values[k] - values[k - 1]) < band:
            values[k] = values[k - 1]
    found = pv_faults(values)
    assert found.renewed is None
    assert found.on_change == pytest.approx(band, rel=0.1)


@pytest.mark.parametrize(("one_in", "by"), [(40, 12.0), (90, 1.0)])
def test_single_wrong_samples_are_told_and_taken_out(one_in: int, by: float) -> None:
    right, random = pv(3), np.random.default_rng(4)
    wrong = np.arange(5, N - 30, one_in) + random.integers(0, one_in // 2)
    values = right.copy()
    values[wrong] += by * random.choice((-1.0, 1.0), len(wrong))
    found = pv_faults(values)
    assert set(found.wrong) == set(wrong.tolist())
    assert found.wrong_by == pytest.approx(by, abs=0.8)
    assert f"1 in {N / len(wrong):.0f}" in str(found.of_wrong_samples)
    assert np.max(np.abs(without_wrong_samples(values) - right)) < 0.6


@pytest.mark.parametrize("step", [0.05, 0.1, 0.5, 1.0])
@pytest.mark.parametrize("noise", [0.0, 0.05, 0.3])
@pytest.mark.parametrize("moves", [False, True])
def test_a_rounded_pv_is_rounded_and_nothing_else(step: float, noise: float, moves: bool) -> None:
    found = pv_faults(np.round(pv(5, noise, moves) / step) * step)
    assert (found.renewed, found.on_change, found.wrong) == (None, None, ())
    if moves:
        assert found.rounded == pytest.approx(step)


@pytest.mark.parametrize("noise", [0.0, 0.02, 0.3, 3.0])
def test_a_sound_pv_shows_nothing(noise: float) -> None:
    for seed in range(20):
        for moves in (False, True):
            found = pv_faults(pv(seed, noise, moves))
            assert (found.renewed, found.on_change, found.rounded, found.wrong) == (None, None, 0.0, ())


def test_jumps_of_a_plant_that_is_dead_time_alone_are_not_wrong_samples() -> None:
    relay = np.where(np.arange(N) // 7 % 2, 1.0, -0.5)
    assert pv_faults(60.0 + relay).wrong == ()
    assert pv_faults(60.0 + relay + 0.01 * np.random.default_rng(0).standard_normal(N)).wrong == ()
