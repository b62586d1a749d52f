"""A step of the load that enters in the middle of a record, as the structures allow for it."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.tuning.identification.output_error import NOT_AT_REST_INITIALLY, UNDISTURBED, DisturbanceHypothesis
from loopwright.tuning.identification.problem import IdentificationProblem
from loopwright.tuning.identification.record import recorded_test
from loopwright.tuning.identification.structures import FIRST
from loopwright.tuning.models import FOPDT
from tests.unit.tuning.recordings import NEGATIVE, moves, open_loop

LOAD_AT = 300


def with_load(noise: float) -> IdentificationProblem:
    """A load at MV is a move of MV that is not recorded."""
    change = moves()
    t, u, _ = open_loop(NEGATIVE, change)
    loaded = change + np.where(np.arange(len(change)) >= LOAD_AT, 0.4, 0.0)
    return IdentificationProblem(recorded_test(t, u, open_loop(NEGATIVE, loaded, noise=noise)[2]))


def test_a_load_step_at_its_own_sample_explains_the_record() -> None:
    problem = with_load(0.0)
    arrives = LOAD_AT + 20  # dead time 2 s, sampled at 0.1 s
    without = problem.fit(FIRST, UNDISTURBED)
    found = problem.refined(
        FIRST, DisturbanceHypothesis(load_disturbances=1), [np.append(without.theta, arrives + 3.0)]
    )
    model = problem.model(found)
    assert isinstance(model, FOPDT)
    assert pytest.approx((-1.5, 8.0, 2.0), rel=1e-6) == (model.K, model.T, model.L)
    assert found.rms < 1e-9 < 1e-2 < without.rms
    assert problem.explains(found) and not problem.explains(without)
    ((seen, entered, size), _) = problem.load_disturbances(found)[0]
    assert (seen, entered, size) == pytest.approx((0.1 * arrives, 0.1 * LOAD_AT, 0.4), rel=1e-6)


def test_a_load_step_at_another_sample_explains_less() -> None:
    problem = with_load(0.005)
    theta = problem.refined(
        FIRST, DisturbanceHypothesis(load_disturbances=1), [np.append(problem.fit(FIRST, UNDISTURBED).theta, 320.0)]
    ).theta
    bic = [
        problem.fitted(FIRST, DisturbanceHypothesis(load_disturbances=1), np.append(theta[:-1], at)).bic
        for at in (310.0, 320.0, 330.0)
    ]
    assert bic[1] < min(bic[0], bic[2]) - 15.0


def test_more_parameters_gain_less_where_the_residual_is_not_white() -> None:
    problem = with_load(0.005)
    without, not_at_rest = problem.fit(FIRST, UNDISTURBED), problem.fit(FIRST, NOT_AT_REST_INITIALLY)
    assert problem.bic_gain(not_at_rest, without) < without.bic - not_at_rest.bic
