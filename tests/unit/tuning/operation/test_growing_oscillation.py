"""An oscillation that grows over three periods is seen; what dies out, keeps its size or is noise is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from loopwright.tuning.operation.growing_oscillation import Growing, growing
from loopwright.tuning.operation.history import Stretch
from tests.unit.tuning.operation.simulated import GAINS, PU, TS, operated, periods


def looked_at(stretch: Stretch) -> list[tuple[int, Growing]]:
    """What is seen, looked at four times in a period."""
    found = []
    for end in range(periods(4.0), len(stretch.pv), periods(0.25)):
        part = replace(stretch, mv=stretch.mv[:end], pv=stretch.pv[:end], sp=stretch.sp[:end])
        if (seen := growing(part, PU)) is not None:
            found.append((end, seen))
    return found


@pytest.mark.parametrize("gain", [4.0, 5.0])
def test_a_loop_that_has_become_unstable_is_seen_within_eight_periods_of_its_oscillation(gain: float) -> None:
    at = periods(5.0)
    stretch = operated({at: 0.5}, periods(20.0), gain=lambda n: gain)
    (end, seen), *_ = looked_at(stretch)
    assert end <= at + periods(8.0)
    assert 0.6 * PU < seen.period_s < 1.5 * PU and seen.per_period > 1.1 and seen.peak_to_peak > 0.05


@pytest.mark.parametrize("gain", [1.0, 1.6, 2.4])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_stable_loop_is_not(gain: float, seed: int) -> None:
    moves = {periods(5.0): 1.0, periods(20.0): -1.0, periods(21.5): 0.4}
    load = {periods(32.0): 0.5, periods(33.0): -0.5, periods(34.5): 0.8}
    steps = np.cumsum([load.get(n, 0.0) for n in range(periods(45.0))])
    stretch = operated(moves, periods(45.0), gain=lambda n: gain, load=lambda n: float(steps[n]), seed=seed)
    assert looked_at(stretch) == []


def _signal(pv: np.ndarray[tuple[int], np.dtype[np.float64]]) -> Stretch:
    zero = np.zeros(len(pv))
    return Stretch(0.0, TS, zero, pv, zero, GAINS)


def test_noise_a_steady_sine_and_a_dying_one_are_none() -> None:
    random, n = np.random.default_rng(1), periods(40.0)
    t = np.arange(n) * TS / PU
    noise = 0.01 * random.standard_normal(n)
    sine = np.sin(2.0 * np.pi * t / 1.2)
    for pv in (noise, 0.3 * sine + noise, np.exp(-0.2 * t) * sine + noise, np.cumsum(noise)):
        assert looked_at(_signal(pv)) == []
    assert looked_at(_signal(1e-3 * np.exp(0.25 * t) * sine + noise)) != []


def test_an_oscillation_that_grows_far_from_the_crossover_is_none() -> None:
    t = np.arange(periods(60.0)) * TS / PU
    for period in (0.3, 6.0):
        assert looked_at(_signal(0.1 * np.exp(0.3 * t / period) * np.sin(2.0 * np.pi * t / period))) == []
