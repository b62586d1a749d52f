"""Separable least squares against scipy's general one and against textbook regression."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from loopwright.tuning.identification.regressors import Regressors
from loopwright.tuning.identification.variable_projection import SearchBounds, covariance, descend, solve
from loopwright.tuning.models import Reals

T = np.linspace(0.0, 5.0, 200)


def two_exponentials(theta: Reals) -> Reals:
    return np.stack((np.exp(-np.exp(theta[0]) * T), np.exp(-np.exp(theta[1]) * T)), axis=1)


def measured() -> Reals:
    noise = np.random.default_rng(2).normal(scale=0.01, size=len(T))
    return np.asarray(two_exponentials(np.log([0.4, 3.0])) @ np.array([2.0, -1.0]) + noise)


def descended(y: Reals, starts: list[list[float]], high: float, steps: int = 60) -> tuple[Reals, Reals]:
    bounded = SearchBounds(np.full(2, -6.0), np.full(2, high), np.full(2, 1.5), np.full(2, 1e-6))

    def regressors(thetas: Reals) -> Regressors:
        return Regressors(np.array([two_exponentials(theta) for theta in thetas]))

    return descend(regressors, y, np.array(starts), bounded, steps, 1e-7)


def test_the_same_minimum_as_with_all_parameters_searched() -> None:
    y = measured()
    full = least_squares(
        lambda p: two_exponentials(p[:2]) @ p[2:] - y, [-1.0, 1.5, 1.0, -0.5], xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    found, rss = descended(y, [[-1.5, 2.0], [-0.5, 0.5]], 6.0)
    for theta, left in zip(found, rss, strict=True):
        assert left == pytest.approx(2.0 * full.cost, rel=1e-7)
        assert np.sort(theta) == pytest.approx(full.x[:2], abs=1e-3)
        assert np.sort(solve(two_exponentials(theta), y).coefficients) == pytest.approx(np.sort(full.x[2:]), abs=3e-3)


def test_a_minimum_on_a_bound_is_found_there() -> None:
    y = measured()
    ((found,), _) = descended(y, [[-1.0, 0.4]], 0.5)
    assert max(found) == 0.5


def test_starts_side_by_side_go_where_each_goes_alone() -> None:
    y = measured()
    starts = np.random.default_rng(4).uniform(-3.0, 3.0, (12, 2)).tolist()
    together, _ = descended(y, starts, 6.0, steps=7)
    alone = [descended(y, [start], 6.0, steps=7)[0][0] for start in starts]
    assert together == pytest.approx(np.array(alone), abs=1e-9)


def test_a_parameter_that_does_nothing_stays() -> None:
    y = measured()

    def regressors(thetas: Reals) -> Regressors:
        return Regressors(np.array([two_exponentials(theta[:2]) for theta in thetas]))

    bounded = SearchBounds(np.full(3, -6.0), np.full(3, 6.0), np.full(3, 1.5), np.full(3, 1e-6))
    found, rss = descend(regressors, y, np.array([[-1.5, 2.0, 0.7]]), bounded, 60, 1e-7)
    expected, minimum = descended(y, [[-1.5, 2.0]], 6.0)
    assert found[0, 2] == 0.7
    assert found[0, :2] == pytest.approx(expected[0], abs=1e-6) and rss == pytest.approx(minimum, rel=1e-9)


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
