from __future__ import annotations

import numpy as np
import pytest

from loopwright.tuning.reduction.process_parameters import parameters


def values(*model: object) -> dict[str, float]:
    return {each.name: each.value for each in parameters(*model)}  # type: ignore[arg-type]


def polynomial(*times: float) -> list[float]:
    """The product of (T s + 1), divided by its first coefficient."""
    product = np.array([1.0])
    for T in times:
        product = np.convolve(product, [T, 1.0])
    return list(product / product[0])


def test_each_structure_has_its_parameters() -> None:
    lag = polynomial(30.0)
    assert values([0.8 / 30.0], lag, 6.0, False) == pytest.approx({"K": 0.8, "T": 30.0, "L": 6.0})
    two = polynomial(30.0, 5.0)
    assert values([2.0 / 150.0], two, 1.0, False) == pytest.approx({"K": 2.0, "T1": 30.0, "T2": 5.0, "L": 1.0})
    zero = [2.0 * 4.0 / 150.0, 2.0 / 150.0]
    assert values(zero, two, 1.0, False) == pytest.approx({"K": 2.0, "T1": 30.0, "T2": 5.0, "Tz": 4.0, "L": 1.0})
    swings = [1.0, 2.0 * 0.3 / 10.0, 1.0 / 100.0]
    assert values([1.5 / 100.0], swings, 2.0, False) == pytest.approx({"K": 1.5, "T": 10.0, "zeta": 0.3, "L": 2.0})
    assert values([0.02], [1.0, 1e-9], 3.0, True) == pytest.approx({"Kv": 0.02, "L": 3.0})
    with_lag = [1.0, 0.2, 0.0]
    assert values([0.02], with_lag, 3.0, True) == pytest.approx({"Kv": 0.1, "T": 5.0, "L": 3.0})


def test_what_has_none() -> None:
    assert values([1.0], [1.0, -0.1], 0.0, False) == {}, "a pole on the right"
    assert values([1.0, 1.0, 1.0], [1.0, 1.0, 0.2], 0.0, False) == {}, "two zeros"


def test_errors_are_those_of_many_models_drawn_with_the_covariance() -> None:
    rng = np.random.default_rng(1)
    mean = np.array([0.8 / 30.0, 1.0 / 30.0, 6.0])
    cov = np.diag((1e-2 * mean) ** 2)
    cov[0, 1] = cov[1, 0] = 0.5 * np.sqrt(cov[0, 0] * cov[1, 1])
    drawn = rng.multivariate_normal(mean, cov, 20_000)
    sampled = np.std([[b / a, 1.0 / a, L] for b, a, L in drawn], axis=0)
    found = parameters([mean[0]], [1.0, mean[1]], mean[2], False, cov.tolist())
    assert [each.error for each in found] == pytest.approx(list(sampled), rel=0.03)
