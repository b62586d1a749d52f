"""T95 of a model, and what is said where that of the configuration is another."""

from __future__ import annotations

import pytest

from loopwright.plantsim.plant import LinearPlant
from loopwright.service.planning.t95 import t95_mismatch, t95_of
from loopwright.tuning.models import FOPDT, Integrating, Model, TransferFunction


@pytest.mark.parametrize(
    "model", [FOPDT(2.0, 10.0, 3.0), FOPDT(-1.0, 2.0, 9.0), TransferFunction((1.0,), (40.0, 14.0, 1.0), 2.0)]
)
def test_it_is_about_the_time_of_95_percent(model: Model) -> None:
    step = 0.05
    plant = LinearPlant(list(model.num), list(model.den), model.L, step)
    k = 0
    while abs(plant.pv) < 0.95 * abs(model.static_gain):
        plant.step(1.0)
        k += 1
    assert t95_of(model) == pytest.approx(k * step, rel=0.2)


def test_what_is_wrong_by_ten_is_said() -> None:
    model = FOPDT(2.0, 10.0, 3.0)  # 33 s
    assert t95_mismatch(model, 33.0) is t95_mismatch(model, 100.0) is t95_mismatch(model, 10.0) is None
    long, short = t95_mismatch(model, 330.0), t95_mismatch(model, 3.3)
    assert long is not None and "about 10 times too long" in long and "in about 33 s" in long and "wait" in long
    assert short is not None and "about 10 times too short" in short and "ended too early" in short


def test_a_plant_that_integrates_has_none() -> None:
    assert t95_of(Integrating(0.1, 3.0)) is None and t95_mismatch(Integrating(0.1, 3.0), 1e6) is None
