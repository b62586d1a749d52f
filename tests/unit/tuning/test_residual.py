from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from tuning.residual import colour, whiteness


def test_white_noise_is_called_coloured_as_rarely_as_promised() -> None:
    random = np.random.default_rng(4)
    values = np.array([whiteness(random.normal(size=400), 0) for _ in range(1000)])
    assert np.mean(values < 0.05) == pytest.approx(0.05, abs=0.02)
    assert np.mean(values < 0.5) == pytest.approx(0.5, abs=0.06)


def test_correlated_noise_is_seen() -> None:
    random = np.random.default_rng(4)
    for _ in range(20):
        assert whiteness(lfilter([1.0], [1.0, -0.5], random.normal(size=400)), 2) < 1e-3


def test_colour_is_the_ratio_of_variances_that_the_correlation_of_neighbours_gives() -> None:
    white = np.random.default_rng(4).normal(size=20000)
    assert colour(white) == pytest.approx(1.0, abs=0.03)
    # of an autoregressive process with pole a: 1/(1 - a)
    assert colour(lfilter([1.0], [1.0, -0.8], white)) == pytest.approx(5.0, rel=0.05)
    assert colour(np.zeros(10)) == 1.0 and whiteness(np.zeros(30), 1) == 1.0
