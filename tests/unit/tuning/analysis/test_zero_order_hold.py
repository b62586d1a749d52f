"""The recursions of the fit against the simulator, which integrates with matrices of its own."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.plantsim.plant import LinearPlant
from loopwright.tuning.analysis.zero_order_hold import states

Ts = 0.1
DENOMINATORS = [
    [1.0, 0.1],
    [1.0, 40.0],
    [1.0, 0.0],
    [1.0, 0.3, 0.02],
    [1.0, 0.2, 0.01],
    [1.0, 0.2, 0.11],
    [1.0, 60.0, 20.0],
    [1.0, 0.33, 0.0],
    [1.0, 1e-3, 2.5e-7],
    [1.0, 3.0, 3.0, 1.0],
    [1.0, 12.0, 21.0, 10.0],
]


@pytest.mark.parametrize("den", DENOMINATORS, ids=str)
@pytest.mark.parametrize("L", [0.0, 0.04, 0.1, 1.0, 1.77])
def test_every_state_follows_the_simulator(den: list[float], L: float) -> None:
    u = np.random.default_rng(5).normal(size=400)
    order = len(den) - 1
    in_samples = np.array([c * Ts**k for k, c in enumerate(den)])[1:]
    found = states(in_samples, L / Ts, u, order)
    for i in range(order):
        plant = LinearPlant([1.0] + [0.0] * i, den, L, Ts)
        expected = np.array([0.0, *(plant.step(float(v)) for v in u[:-1])])
        # s counts samples here: s^i/den is Ts^(i - order) times that in seconds
        assert found[:, i] * Ts ** (order - i) == pytest.approx(expected, abs=1e-8 * float(np.abs(expected).max()))


def test_a_dead_time_longer_than_the_record_leaves_nothing() -> None:
    assert not states(np.array([0.1]), 50.3, np.ones(40), 1).any()
