"""T95 of a model, and what is said where that of the configuration is another."""

from __future__ import annotations

import pytest

from loopwright.plantsim.plant import LinearPlant
from loopwright.service.planning.t95 import t95_mismatch, t95_of
from loopwright.service.results import TransferModelView
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


def test_the_lag_of_a_level_is_not_held_against_the_configuration() -> None:
    """Its fit has a pole near zero: by three times that lag t95_s would be 705 times too short."""
    level = TransferFunction((0.0037,), (1.0, 7.09e-5), 4.0)
    assert t95_mismatch(level, 60.0) is not None
    assert t95_mismatch(level, 60.0, record_s=400.0) is None
    heater = FOPDT(3.0, 2400.0, 90.0)
    assert t95_mismatch(heater, 600.0, record_s=1800.0) is not None


@pytest.mark.parametrize(
    ("den", "errors", "integrating"),
    [
        ([1.0, 7.09e-5], [0.0, 8.4e-5], True),
        ([1.0, -2e-5], [0.0, 4e-5], True),
        ([1.0, 0.2, 3e-4], [0.0, 0.01, 2e-4], True),
        ([1.0, 0.2, 0.0], None, True),
        ([1.0, 2474.0, 0.0023], [0.0, 193.0, 0.0008], True),  # of a record without noise
        ([1.0, 0.1], [0.0, 0.01], False),
        ([1.0, 7.09e-5], None, True),
        ([1.0, 0.01], None, False),
        ([1.0], None, False),
    ],
)
def test_a_model_is_called_integrating_where_its_pole_cannot_be_told_from_zero(
    den: list[float], errors: list[float] | None, integrating: bool
) -> None:
    model = TransferModelView(structure="fopdt", num=[1.0], den=den, dead_time_s=1.0, den_errors=errors)
    assert model.model_dump()["integrating"] is integrating and ("integrating" in model.named) is integrating
    assert TransferModelView.model_validate(model.model_dump()) == model, "as stored"
