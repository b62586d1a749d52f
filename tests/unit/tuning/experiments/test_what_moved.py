"""What has moved PV in a record, against records that are computed by the closed form of a first-order plant."""

import pickle

import numpy as np
import pytest

from loopwright.tuning.experiments.primitives import Facts, OperatingPoint, Trace, explained, held
from loopwright.tuning.experiments.what_moved import WhatMoved, what_moved
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Plan, Work
from loopwright.tuning.reasons import Reason, Refused

T95_S, NOISE = 100.0, 0.05
K, T, L = 0.7, 25.0, 5.0
t = np.arange(0.0, 300.0, 0.5)


def step_at(at: float, size: float) -> np.ndarray:
    return np.where(t >= at, -size * np.expm1(-(t - at).clip(0.0) / T), 0.0)


def found(mv: np.ndarray, pv: np.ndarray) -> WhatMoved:
    return what_moved(t, mv, pv + NOISE * np.random.default_rng(3).standard_normal(len(t)), T95_S, NOISE)


HALF_WAVES = np.where(t < 12.0, 30.0, -15.0)
ANSWER = step_at(L, 30.0 * K) - step_at(12.0 + L, 45.0 * K)


@pytest.mark.parametrize("size", [15.0, 20.0])
def test_a_load_that_holds_pv_is_named_with_its_size(size: float) -> None:
    seen = found(HALF_WAVES, ANSWER + step_at(20.0, K * size))
    assert seen.answered and not seen.drift
    assert seen.load_in_mv == pytest.approx(size, rel=0.15)


@pytest.mark.parametrize("rate", [0.02, -0.01])
def test_a_drift_without_an_answer_is_a_drift(rate: float) -> None:
    seen = found(np.full(len(t), -15.0), rate * t)
    assert not seen.answered and seen.drift == pytest.approx(rate, rel=0.05)


def test_a_drift_beside_an_answer_is_both() -> None:
    seen = found(HALF_WAVES, ANSWER + 0.05 * t)
    assert seen.gain == pytest.approx(K, rel=0.1) and seen.drift == pytest.approx(0.05, rel=0.1)


def test_an_answer_to_one_move_is_no_load() -> None:
    seen = found(np.full(len(t), 30.0), step_at(L, -30.0 * K))
    assert seen.gain < 0.0 and not seen.load and not seen.drift


def test_a_pv_that_rests_has_not_answered() -> None:
    assert not found(HALF_WAVES, np.zeros(len(t))).answered


def test_it_is_looked_for_beside_the_loop() -> None:
    """A plan that computed it itself would keep the heartbeat from being sent meanwhile."""
    facts, point = Facts(0.5, T95_S, 0.0, 100.0, 2.0, Gains(1.0, 30.0)), OperatingPoint(60.0, 60.0, 40.0, NOISE, 30.0)
    pv = 60.0 - ANSWER + NOISE * np.random.default_rng(3).standard_normal(len(t))
    trace = Trace(list(t), [60.0] * len(t), list(pv), list(40.0 + HALF_WAVES))

    def plan() -> Plan[None]:
        raise held(facts, point, trace, "it does not oscillate", Reason.STALLED)
        yield ()

    (work,) = next(explained(plan()))
    assert isinstance(work, Work)
    refused = pickle.loads(pickle.dumps(work.compute))()
    assert type(refused) is Refused and refused.reason is Reason.WRONG_SIGN
    assert "it does not oscillate" in refused.detail
