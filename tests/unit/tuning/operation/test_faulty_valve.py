"""A valve followed through a history, with many sizes of its fault at once."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.tuning.fast.score_tests.valve_faults import Fault, backlash, stiction
from loopwright.tuning.operation.faulty_valve import followed_by


@pytest.mark.parametrize("fault", [backlash, stiction])
def test_many_sizes_at_once_are_each_size_by_itself(fault: Fault) -> None:
    u = np.cumsum(np.random.default_rng(2).normal(size=400))
    sizes = np.geomspace(0.1, 5.0, 7)
    found = followed_by(fault, u, sizes)
    assert found.shape == (7, 400)
    for position, size in zip(found, sizes.tolist(), strict=True):
        assert np.array_equal(position, fault(u, size))


@pytest.mark.parametrize("fault", [backlash, stiction])
def test_where_a_valve_stands_depends_on_how_mv_moved_before(fault: Fault) -> None:
    """The same last samples of MV, after it came from below or from above."""
    last = np.array([1.0, 1.05, 1.0])
    from_below = followed_by(fault, np.append([0.0, 0.9], last), np.array([0.3]))[0, -1]
    from_above = followed_by(fault, np.append([0.0, 1.1], last), np.array([0.3]))[0, -1]
    assert from_below < from_above
