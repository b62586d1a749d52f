"""Accepted gains are replaced only where the controller still holds them, however small Kp is."""

from __future__ import annotations

from dataclasses import replace

import pytest

from loopwright.service.loops.gain_change import ForeignGains, replace_accepted
from loopwright.tuning.gains import Gains
from tests.unit.service.fakes import FakeController, FakeLoop


@pytest.mark.parametrize("Kp", [100.0, 1e-6, 1e-8, 2e-9])
def test_gains_that_an_operator_has_set_stay(Kp: float) -> None:
    accepted, by_hand = Gains(1.5 * Kp, 25.0), Gains(1.5001 * Kp, 25.0)
    controller = FakeController()
    controller.state = replace(controller.state, gains=by_hand)
    with pytest.raises(ForeignGains):
        replace_accepted(FakeLoop(controller), accepted, Gains(Kp, 30.0), True, lambda: None)
    assert controller.state.gains == by_hand
    controller.state = replace(controller.state, gains=Gains(1.5 * Kp * (1.0 + 1e-7), 25.0))
    assert replace_accepted(FakeLoop(controller), accepted, Gains(Kp, 30.0), True, lambda: None).gains.Kp < Kp * 1.01
