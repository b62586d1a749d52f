from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from loopwright.tuning.identification.residuals import variance_inflation, whiteness


def test_white_noise_is_called_coloured_as_rarely_as_promised() -> None:
    random = np.random.default_rng(4)
    values = np.array([whiteness(random.normal(size=400), 0) for _ in range(1000)])
    assert np.mean(values < 0.05) == pytest.approx(0.05, abs=0.02)
    assert np.mean(values < 0.5) == pytest.approx(0.5, abs=0.06)


def test_correlated_noise_is_seen() -> None:
    random = np.random.default_rng(4)
    for _ in range(20):
        assert whiteness(lfilter([1.0], [1.0, -0.5], random.normal(size=400)), 2) < 1e-3


def test_colour_is_the_variance_of_long_averages_against_that_of_white_noise() -> None:
    white = np.random.default_rng(4).normal(size=40000)
    coloured = lfilter([1.0], [1.0, -0.8], white)
    averages = coloured.reshape(-1, 200).mean(axis=1)
    assert variance_inflation(coloured) == pytest.approx((1.0 + 0.8) / (1.0 - 0.8), rel=0.06)
    assert variance_inflation(coloured) == pytest.approx(200.0 * averages.var() / coloured.var(), rel=0.25)
    assert variance_inflation(white) == pytest.approx(1.0, abs=0.03)


def test_no_residual_is_white() -> None:
    assert variance_inflation(np.zeros(10)) == 1.0 and whiteness(np.zeros(30), 1) == 1.0
