"""What a rehearsal answers when it cannot, or should not, propose: a reason from the closed list, with the numbers."""

from __future__ import annotations

from typing import Any

import pytest

from service.rehearsal import rehearse
from tuning.models import FOPDT
from tuning.reasons import ADVICE, Reason

LAG = {"num": [2], "den": [5, 1], "dead_time_s": 1}


@pytest.mark.parametrize(
    ("spec", "outcome", "reasons"),
    [
        ({"num": [1], "den": [5, 1]}, "refused", {"cannot_oscillate"}),
        ({"num": [1], "den": [25, 10, 1]}, "refused", {"cannot_oscillate"}),
        ({"num": [1], "den": [10, 0], "dead_time_s": 1}, "refused", {"not_self_regulating"}),
        ({"num": [0.2], "den": [10, 1, 0], "dead_time_s": 3}, "refused", {"not_self_regulating"}),
        ({"num": [1], "den": [-5, 1], "dead_time_s": 1}, "failed", {"pv_limit"}),
        (LAG | {"noise_std": 0.1}, "refused", {"noise_too_high"}),
        (LAG | {"mv_limits": [-0.001, 0.5]}, "refused", {"saturated"}),
        (LAG | {"sample_time_s": 1.0}, "refused", {"cannot_oscillate"}),
        (LAG | {"mv_limits": [5, 1]}, "refused", {"bad_input"}),
        (LAG | {"num": [float("nan")]}, "refused", {"bad_input"}),
        (LAG | {"den": [0, 1]}, "refused", {"bad_input"}),
        (LAG | {"num": [1, 2, 3]}, "refused", {"bad_input"}),
        (LAG | {"dead_time_s": -1}, "refused", {"bad_input"}),
        (LAG | {"colour": 3}, "refused", {"bad_input"}),
        ({}, "refused", {"bad_input"}),
    ],
)
def test_it_ends_with_a_reason(spec: dict[str, Any], outcome: str, reasons: set[str]) -> None:
    answer = rehearse(spec)
    assert (answer["outcome"], answer["reason"] in reasons) == (outcome, True), answer["detail"]
    assert answer["detail"]
    assert answer["advice"]
    assert answer["gains"] is None


def test_every_reason_has_its_advice() -> None:
    assert set(ADVICE) == set(Reason)


def test_a_negative_gain_gives_the_mirror_image() -> None:
    up, down = rehearse(LAG), rehearse(LAG | {"num": [-2]})
    assert down["gains"] == pytest.approx(up["gains"], rel=1e-3)  # the relay starts high in both
    assert down["model"]["K"] == pytest.approx(-up["model"]["K"], rel=1e-3)


@pytest.mark.parametrize("factor", [1e-3, 60.0])
def test_scaling_time_scales_the_times_and_nothing_else(factor: float) -> None:
    slow = {"num": [2], "den": [500, 1], "dead_time_s": 150, "sample_time_s": 2.0, "t95_s": 1800}
    base = rehearse(slow)
    scaled = rehearse(
        slow | {k: v * factor for k, v in slow.items() if k.endswith("_s")} | {"den": [500 * factor, 1]}  # type: ignore[operator]
    )
    assert scaled["ultimate"]["Ku"] == pytest.approx(base["ultimate"]["Ku"], rel=2e-3)
    assert scaled["ultimate"]["Pu"] == pytest.approx(factor * base["ultimate"]["Pu"], rel=2e-3)


def test_the_procedure_can_be_entered_at_each_stage_by_hand() -> None:
    whole = rehearse(LAG)
    stages = whole["stages"]
    from_ultimate = rehearse(LAG, start="zn_pi", Ku=whole["ultimate"]["Ku"], Pu_s=whole["ultimate"]["Pu"])
    zn = stages["zn_pi"]
    from_overshoot = rehearse(LAG, start="estimate", Kp=zn["Kp"], Ti_s=zn["Ti_s"], overshoot_pct=zn["overshoot_pct"])
    model = whole["model"]
    from_model = rehearse(LAG, start="optimise", model=FOPDT(model["K"], model["T"], model["L"]))
    for entered in (from_ultimate, from_overshoot, from_model):
        assert entered["outcome"] == "proposed", entered["detail"]
        assert entered["gains"] == pytest.approx(whole["gains"], rel=0.02)
        assert entered["plant_time_s"]["total"] < whole["plant_time_s"]["total"]


def test_values_typed_in_are_checked() -> None:
    assert rehearse(LAG, start="zn_pi", Ku=4.0)["reason"] == "bad_input"
    assert rehearse(LAG, start="optimise", model=FOPDT(-2.0, 5.0, 1.0))["reason"] == "wrong_sign"
