"""A test jumps MV no further than its loop permits, by any method; what the controller's feedback adds is gradual."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from loopwright.tuning.fast import excitation_choice
from loopwright.tuning.fast.record import Excitation
from loopwright.tuning.fast.relay.relay_test import BIAS
from loopwright.tuning.plan import Sample
from tests.rehearsal.test_fast import true_Ms
from tests.rehearsal.test_setpoint import under
from tests.rehearsed import rehearse

MAX_JUMP = 0.1


def jumps(method: str, plant: dict[str, Any], **more: Any) -> tuple[dict[str, Any], float]:
    """The answer, and the largest jump of MV from one sample to the next."""
    taken: list[Sample] = []
    answer = rehearse(plant, method=method, on_samples=taken.extend, propose_anyway=True, **more)
    return answer, float(np.max(np.abs(np.diff([sample.mv for sample in taken]))))


@pytest.mark.parametrize("method", ["fast", "setpoint", "five-stage"])
@pytest.mark.parametrize("name", ["first order", "three lags"])
def test_mv_jumps_no_further_than_is_permitted(method: str, name: str) -> None:
    plant = under(name, 0.15, noise_std=0.0, mv_limits=[-1.0, 1.0])
    free, without = jumps(method, plant)
    assert free["outcome"] == "proposed" and without > 2.0 * MAX_JUMP, "the limit binds"
    answer, largest = jumps(method, plant | {"mv_step_max": MAX_JUMP})
    assert answer["outcome"] == "proposed", answer["detail"]
    assert largest <= 1.02 * MAX_JUMP
    if method != "five-stage":  # which asks for no Ms
        assert abs(true_Ms(plant, answer["new_gains"]) - 1.6) < 0.05


def relay_after_pulses() -> tuple[dict[str, Any], float]:
    """A run whose integral has moved MV far from rest during the pulses."""
    plant = under("inverse response", 0.01, noise_std=0.0, mv_limits=[-1.0, 1.0], mv_step_max=0.5 * MAX_JUMP)
    plant["gains"]["Ti"] *= 0.1
    both = (Excitation.SETPOINT, Excitation.RELAY)
    return jumps("fast", plant, derivative=True, excitations=both, amplitude=0.5 * MAX_JUMP / (1.0 + BIAS))


def test_a_relay_that_follows_pulses_begins_within_the_permitted_jump() -> None:
    answer, largest = relay_after_pulses()
    assert "relay" in answer["stages"] and largest <= 1.02 * 0.5 * MAX_JUMP


def test_where_mv_stays_far_from_rest_the_relay_does_not_follow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(excitation_choice, "MAX_NEAR_T95", 0.0)
    answer, largest = relay_after_pulses()
    assert answer["outcome"] == "refused" and "the relay cannot follow: MV stays" in answer["detail"]
    assert "relay" not in answer["stages"] and largest <= 1.02 * 0.5 * MAX_JUMP
