"""Separable least squares against scipy's general one and against textbook regression."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from tuning.models import Reals
from tuning.varpro import covariance, search, solve

T = np.linspace(0.0, 5.0, 200)


def two_exponentials(theta: Reals) -> Reals:
    return np.stack((np.exp(-np.exp(theta[0]) * T), np.exp(-np.exp(theta[1]) * T)), axis=1)


def measured() -> Reals:
    noise = np.random.default_rng(2).normal(scale=0.01, size=len(T))
    return np.asarray(two_exponentials(np.log([0.4, 3.0])) @ np.array([2.0, -1.0]) + noise)


def test_the_same_minimum_as_with_all_parameters_searched() -> None:
    y = measured()
    full = least_squares(
        lambda p: two_exponentials(p[:2]) @ p[2:] - y, [-1.0, 1.5, 1.0, -0.5], xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    found, rss = search(
        lambda theta: solve(two_exponentials(theta), y).residual,
        np.array([-1.5, 2.0]),
        np.full(2, -6.0),
        np.full(2, 6.0),
        np.full(2, 1.5),
        np.full(2, 1e-6),
    )
    assert rss == pytest.approx(2.0 * full.cost, rel=1e-7)
    assert found == pytest.approx(full.x[:2], abs=1e-3)
    assert solve(two_exponentials(found), y).coefficients == pytest.approx(full.x[2:], abs=3e-3)


def test_a_minimum_on_a_bound_is_found_there() -> None:
    y = measured()
    found, _ = search(
        lambda theta: solve(two_exponentials(theta), y).residual,
        np.array([-1.5, 0.0]),
        np.full(2, -6.0),
        np.full(2, 0.5),
        np.full(2, 1.5),
        np.full(2, 1e-6),
    )
    assert max(found) == 0.5


def test_linear_fit_and_covariance_are_those_of_regression() -> None:
    columns = np.stack((np.ones_like(T), T, 1e6 * np.sin(T)), axis=1)
    y = measured()
    expected = np.linalg.lstsq(columns, y, rcond=None)[0]
    assert solve(columns, y).coefficients == pytest.approx(expected, rel=1e-9)
    assert covariance(columns, 0.3) == pytest.approx(0.3 * np.linalg.inv(columns.T @ columns), rel=1e-6)


def test_a_direction_that_is_not_seen_has_a_large_but_finite_variance() -> None:
    columns = np.stack((T, T), axis=1)
    found = covariance(columns, 1.0)
    assert np.isfinite(found).all() and found[0, 0] > 1e10
