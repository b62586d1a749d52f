"""The sums of the regressors with given coefficients, against the regressors themselves."""

from __future__ import annotations

import math

import numpy as np
import pytest

from loopwright.tuning.identification.output_error import DisturbanceHypothesis, Fit
from loopwright.tuning.identification.structures import (
    FIRST,
    LAGGED_INTEGRATOR,
    SECOND,
    SECOND_WITH_FEED_THROUGH,
    THIRD_WITH_ZERO,
    Structure,
)
from tests.unit.tuning.recordings import SampledPieces, moves

STRUCTURES = [FIRST, LAGGED_INTEGRATOR, SECOND_WITH_FEED_THROUGH, THIRD_WITH_ZERO]
HYPOTHESES = [
    DisturbanceHypothesis(),
    DisturbanceHypothesis(load_disturbances=2),
    DisturbanceHypothesis(drift=True),
    DisturbanceHypothesis(not_at_rest_initially=True),
    DisturbanceHypothesis(load_disturbances=1, drift=True, not_at_rest_initially=True),
]


@pytest.mark.parametrize("hypothesis", HYPOTHESES, ids=str)
@pytest.mark.parametrize("structure", STRUCTURES, ids=lambda s: s.name)
@pytest.mark.parametrize("pieces", [(300,), (100, 100, 100), (90, 61, 149), (150, 2, 148)], ids=str)
@pytest.mark.parametrize("block", [1, 3])
def test_the_sums_of_the_regressors_are_those_of_all_their_columns(
    pieces: tuple[int, ...], block: int, structure: Structure, hypothesis: DisturbanceHypothesis
) -> None:
    rng = np.random.default_rng(7)
    u = moves(300)
    before = tuple(rng.normal(size=20) for _ in pieces)
    fit = Fit(SampledPieces(u, rng.normal(size=300), block, pieces, before, input_range=2.0, output_range=3.0))
    logs = rng.uniform(-4.0, -2.0, (4, structure.lags))
    # the dead time, then the times of the load disturbances, one of them where pieces of 100 samples meet
    times = np.column_stack((rng.uniform(0.0, 30.0, 4), np.full(4, 100.0), rng.uniform(150.0, 280.0, 4)))
    thetas = np.hstack((logs, times[:, : 1 + hypothesis.load_disturbances]))
    columns = fit.regressors(structure, hypothesis, thetas).dense()
    linear = rng.normal(size=columns.shape[::2]) / np.maximum(np.abs(columns).max(axis=1), 1.0)
    found = fit.sums(structure, hypothesis, thetas, linear)
    assert found == pytest.approx((columns @ linear[..., None])[..., 0], rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_a_time_that_the_record_does_not_show_is_not_searched(seed: int) -> None:
    """A load disturbance at the last sample of a piece ends with it, before PV has moved. A slope that is a rounding
    error, of a plant with slow lags, would move its time as far as a step may go."""
    drifting = np.cumsum(np.random.default_rng(seed).normal(size=300))
    fit = Fit(SampledPieces(moves(300), drifting, 1, (100, 100, 100)))
    theta = np.array([math.log(1e-4), math.log(1e-6), 5.0, 199.0])
    (found,) = fit.descended(SECOND, DisturbanceHypothesis(load_disturbances=1, drift=True), [theta], 8)
    assert found.theta[-1] == 199.0 and np.all(found.theta[:2] != theta[:2])
