"""The growth fit against signals whose growth is known."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.tuning.identification.oscillation import fit_growth, harmonic


def signal(growth: float, period: float, noise: float = 0.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    t = np.arange(0, 4 * period, period / 70)
    y = 2 + 0.3 * np.exp(-t / (5 * period)) + np.exp(growth * t / period) * np.sin(2 * np.pi * t / period + 0.4)
    return t, y + noise * np.random.default_rng(seed).standard_normal(len(t))


@pytest.mark.parametrize("growth", [-0.3, -0.01, 0.0, 0.002, 0.2])
@pytest.mark.parametrize("guess", [0.9, 1.0, 1.12])
def test_growth_and_period_are_found_beside_a_slow_pole(growth: float, guess: float) -> None:
    t, y = signal(growth, 7.3)
    found = fit_growth(t, y, 7.3 * guess)
    assert found.log_per_period == pytest.approx(growth, abs=5e-4)
    assert found.period == pytest.approx(7.3, rel=2e-3)


def test_the_standard_error_tells_the_truth_under_noise() -> None:
    fits = [fit_growth(*signal(0.02, 5.0, noise=0.1, seed=seed), 5.0) for seed in range(60)]
    spread = np.std([fit.log_per_period for fit in fits])
    stated = np.mean([fit.error for fit in fits])
    assert 0.6 < stated / spread < 1.6
    assert abs(np.mean([fit.log_per_period for fit in fits]) - 0.02) < 4 * spread / np.sqrt(60)


def test_the_first_harmonic_of_a_square_wave_is_four_over_pi() -> None:
    t = np.arange(0, 3, 1e-3)
    assert abs(harmonic(t, np.sign(np.sin(2 * np.pi * t)), 1.0)) == pytest.approx(4 / np.pi, rel=2e-3)
