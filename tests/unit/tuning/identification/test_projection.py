"""The projection part by part against that of all regressors at once, and against numpy's least squares."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.tuning.identification.projection import LocalRegressors, Projection
from loopwright.tuning.models import Reals

ROWS = [slice(0, 30), slice(30, 75), slice(75, 90)]
LOCAL = [LocalRegressors(rows, np.array([2 + i, 6 + 2 * i, 7 + 2 * i])) for i, rows in enumerate(ROWS)]
"""Two common regressors, a level of each part, another common one, and two more regressors of each part."""
SETS = np.arange(4)


def regressors(seed: int = 1) -> tuple[Reals, Reals]:
    random = np.random.default_rng(seed)
    columns = random.normal(size=(len(SETS), 90, 12))
    for part in LOCAL:
        own = columns[:, part.rows, part.columns].copy()
        columns[:, :, part.columns] = 0.0
        columns[:, part.rows, part.columns] = own
    columns[:, :, 0] *= 1e3
    return columns, random.normal(size=90)


def test_coefficients_and_residual_are_those_of_least_squares() -> None:
    columns, y = regressors()
    found = Projection.of(columns, y, LOCAL)
    for i in SETS:
        expected, (rss,), *_ = np.linalg.lstsq(columns[i], y, rcond=None)
        assert found.linear[i] == pytest.approx(expected, rel=1e-9, abs=1e-18)
        assert found.rest[i] == pytest.approx(y - columns[i] @ expected, abs=1e-12)
        assert found.rss[i] == pytest.approx(rss, rel=1e-12)
    assert found.fitted(SETS) == pytest.approx(y - found.rest, abs=1e-12)


def test_what_is_left_of_a_signal_is_that_of_all_regressors_at_once() -> None:
    columns, y = regressors()
    signals = np.random.default_rng(2).normal(size=(2, 90, 3))
    before = signals.copy()
    by_parts = Projection.of(columns, y, LOCAL).beyond(signals, SETS[1:3])
    assert by_parts == pytest.approx(Projection.of(columns, y).beyond(signals, SETS[1:3]), abs=1e-12)
    assert np.array_equal(signals, before)


@pytest.mark.parametrize("redundant", [7, 5])
def test_a_regressor_that_others_make_up_leaves_the_residual(redundant: int) -> None:
    columns, y = regressors()
    without = Projection.of(columns, y, LOCAL)
    columns[:, :, redundant] = 0.0
    less = Projection.of(columns, y, LOCAL)
    columns[:, :, redundant] = 2.0 * columns[:, :, 6 if redundant == 7 else 2]
    again = Projection.of(columns, y, LOCAL)
    for i in SETS:
        rss = np.linalg.lstsq(np.delete(columns[i], redundant, axis=1), y, rcond=None)[1]
        assert np.isfinite(again.linear).all() and np.isfinite(less.linear).all()
        assert [again.rss[i], less.rss[i]] == pytest.approx([rss[0]] * 2, rel=1e-9)
        assert again.columns[i] @ again.linear[i] == pytest.approx(again.fitted(SETS)[i], abs=1e-12)
        assert np.sum((y - again.fitted(SETS)[i]) ** 2) == pytest.approx(rss, rel=1e-9)
    assert (without.rss < again.rss).all()


def test_sets_are_replaced_in_all_that_is_known_of_them() -> None:
    first, y = regressors()
    second, _ = regressors(3)
    found, other = Projection.of(first, y, LOCAL), Projection.of(second, y, LOCAL)
    better = np.array([False, True, False, True])
    found.replace(SETS[better], other, better)
    expected = Projection.of(np.where(better[:, None, None], second, first), y, LOCAL)
    signals = np.random.default_rng(4).normal(size=(4, 90, 2))
    assert found.rss == pytest.approx(expected.rss, rel=1e-12)
    assert found.beyond(signals, SETS) == pytest.approx(expected.beyond(signals, SETS), abs=1e-12)
    assert found.fitted(SETS) == pytest.approx(expected.fitted(SETS), abs=1e-9)
