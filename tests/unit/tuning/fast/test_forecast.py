"""The forecast of a loop against the simulated plant under the algorithm of the controller."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from loopwright.controller.channel import Channel, Mode, Settings
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant
from loopwright.tuning.fast.forecast import Past, forecast
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import TransferFunction

TS = 0.1
PLANTS = {
    "first order": TransferFunction((2.0,), (10.0, 1.0), 2.03),
    "inverse response": TransferFunction((-1.0, 1.0), (2.0, 3.0, 1.0), 0.5),
    "integrates": TransferFunction((0.1,), (1.0, 0.0), 1.0),
    "negative gain": TransferFunction((-1.5,), (8.0, 1.0), 2.0),
    "feed-through": TransferFunction((0.5, 1.0), (4.0, 1.0), 0.55),
}
PRESENT = {"PI": Gains(1.2, 8.0), "I-P": Gains(1.2, 8.0, b=0.0), "PID": Gains(1.5, 8.0, 1.0, 0.1)}
MOVES = (0.8, -0.5, 0.0)


def parameters(gains: Gains) -> Parameters:
    return Parameters(gains.Kp, gains.Ti, gains.Td, gains.Tf, gains.b, gains.c)


def simulated(
    model: TransferFunction, gains: Gains, moves: list[tuple[int, float]], samples: int, limit: float,
    then: tuple[int, Gains] | None = None, load: float = 0.0,
) -> np.ndarray:  # fmt: skip
    """sp, pv, mv of a loop whose set-point moves at these samples."""
    plant = LinearPlant(model.num, model.den, model.L, TS)
    plant.disturbance = load
    settings = Settings(mv_low=-limit, mv_high=limit, pv_low=-1e9, pv_high=1e9, reverse=model.num[-1] > 0)
    channel = Channel(TS, settings, parameters(gains), 0.0, Mode.AUTOMATIC, 0.0)
    rows, at = [], dict(moves)
    pv = plant.pv
    for k in range(samples):
        if then and k == then[0]:
            channel.try_gains(parameters(then[1]))
        channel.setpoint = at.get(k, channel.setpoint)
        mv = channel.step(pv)
        rows.append((channel.setpoint, pv, mv))
        pv = plant.step(mv)
    return np.array(rows).T


@pytest.mark.parametrize("limit", [1e6, 2.0])
@pytest.mark.parametrize("law", PRESENT)
@pytest.mark.parametrize("name", PLANTS)
def test_the_loop_goes_on_as_it_was_going(name: str, law: str, limit: float) -> None:
    model, gains = PLANTS[name], PRESENT[law]
    if name == "feed-through":
        gains = replace(gains, Kp=0.3 * gains.Kp)
    sp, pv, mv = simulated(model, gains, [(5, 1.0), (40, -0.2)], 70, limit)
    past = Past(TS, sp, pv, mv, -limit, limit, 1.0 if model.num[-1] > 0 else -1.0, gains)
    assert abs(mv[-1]) < limit, "a record that ends at a limit does not hold what was asked for"
    found = forecast(model, past, gains, np.array(MOVES), 150)
    for i, move in enumerate(MOVES):
        _, true_pv, true_mv = simulated(model, gains, [(5, 1.0), (40, -0.2), (70, move)], 220, limit)
        assert found.pv[:, i] == pytest.approx(true_pv[70:], abs=1e-6)
        assert np.clip(found.mv[:, i], -limit, limit) == pytest.approx(true_mv[70:], abs=1e-6)


@pytest.mark.parametrize("name", PLANTS)
def test_new_gains_take_over_without_a_bump(name: str) -> None:
    model, gains, new = PLANTS[name], PRESENT["I-P"], Gains(0.5, 4.0)
    sp, pv, mv = simulated(model, gains, [(5, 1.0)], 60, 1e6)
    past = Past(TS, sp, pv, mv, -1e6, 1e6, 1.0 if model.num[-1] > 0 else -1.0, gains)
    found = forecast(model, past, new, np.array([0.0]), 100)
    _, true_pv, true_mv = simulated(model, gains, [(5, 1.0), (60, 0.0)], 160, 1e6, (60, new))
    assert found.pv[:, 0] == pytest.approx(true_pv[60:], abs=1e-6)
    assert found.mv[:, 0] == pytest.approx(true_mv[60:], abs=1e-6)


def test_a_load_that_the_model_does_not_have_is_taken_to_stay() -> None:
    """Once PV has answered it the deviation from the model is constant."""
    model, gains, load = TransferFunction((2.0,), (1.0, 1.0), 0.5), Gains(0.3, 2.0), 0.4
    sp, pv, mv = simulated(model, gains, [], 200, 1e6, load=load)
    past = Past(TS, sp, pv, mv, -1e6, 1e6, 1.0, gains)
    found = forecast(model, past, gains, np.array([1.0]), 100)
    _, true_pv, _ = simulated(model, gains, [(200, 1.0)], 300, 1e6, load=load)
    assert found.pv[:, 0] == pytest.approx(true_pv[200:], abs=1e-4)
