"""State space, units and matrix exponentials."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.tuning.analysis.exponential import exponentials
from loopwright.tuning.analysis.state_space import gain_unit, normalised, state_space, time_sum
from loopwright.tuning.models import FOPDT, SOPDT, Integrating, Model, TransferFunction

MODELS: list[Model] = [
    FOPDT(-2.0, 5.0, 1.0),
    SOPDT(0.3, 3.0, 0.2, 0.0),
    Integrating(-0.1, 2.0, 3.0),
    TransferFunction((1.0, 4.0), (3.0, 1.0)),
    TransferFunction((-0.1, 1.0), (1e-6, 0.001111, 0.11211, 1.111, 1.0)),
]


@pytest.mark.parametrize("model", MODELS)
def test_state_space_has_the_model_s_frequency_response(model: Model) -> None:
    g, w = state_space(model), np.array([0.01, 1.0, 300.0])
    inverse = np.linalg.inv(1j * w[:, None, None] * np.eye(len(g.b)) - g.a)
    found = np.einsum("i,wij,j->w", g.c, inverse, g.b) + g.d
    assert found * np.exp(-1j * w * model.L) == pytest.approx(model.frequency_response(w), rel=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_rest_is_rest(model: Model) -> None:
    g = state_space(model)
    x, u = g.rest()
    assert g.a @ x + g.b * u == pytest.approx(np.zeros(len(x)), abs=1e-9)
    assert float(g.c @ x) + g.d * u == pytest.approx(1.0)


@pytest.mark.parametrize("model", MODELS)
def test_normalised_is_the_same_plant_in_other_units(model: Model) -> None:
    unit = 7.0
    other, w = normalised(model, unit), np.array([0.01, 1.0, 30.0])
    expected = model.frequency_response(w) / gain_unit(model, unit) * (1.0 if model.num[-1] > 0.0 else -1.0)
    assert other.frequency_response(w * unit) == pytest.approx(expected, rel=1e-9)


def test_time_sum() -> None:
    assert time_sum(SOPDT(K=1.0, T1=3.0, T2=2.0, L=0.5)) == pytest.approx(5.5)
    assert time_sum(Integrating(1.0, 0.0)) == 0.0


@pytest.mark.parametrize("size", [1e-9, 0.1, 3.0, 40.0])
def test_exponentials_are_scipy_s(size: float) -> None:
    many = size * np.random.default_rng(1).standard_normal((20, 4, 4))
    many = many - 2.0 * size * np.eye(4)
    for ours, theirs in zip(exponentials(many), expm(many), strict=True):
        assert ours == pytest.approx(theirs, abs=1e-12 * np.abs(theirs).max() * (1.0 + size))
