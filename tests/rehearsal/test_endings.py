"""What a rehearsal answers when it cannot, or should not, propose: a reason from the closed list, with the numbers."""

from __future__ import annotations

from typing import Any

import pytest

from loopwright.tuning.models import FOPDT
from loopwright.tuning.reasons import ADVICE, Reason
from tests.rehearsed import rehearse

LAG = {"num": [2], "den": [5, 1], "dead_time_s": 1}


BOTH = ("fast", "five-stage")
FIVE = "five-stage"
ONLY_FIVE = (FIVE,)
"""What the five stages are not made for: `fast` proposes here, see test_fast.py."""


@pytest.mark.parametrize(
    ("spec", "methods", "outcome", "reason"),
    [
        ({"num": [1], "den": [5, 1]}, ONLY_FIVE, "refused", "cannot_oscillate"),
        ({"num": [1], "den": [25, 10, 1]}, ONLY_FIVE, "refused", "cannot_oscillate"),
        ({"num": [1], "den": [10, 0], "dead_time_s": 1}, ONLY_FIVE, "refused", "not_self_regulating"),
        ({"num": [0.2], "den": [10, 1, 0], "dead_time_s": 3}, ONLY_FIVE, "refused", "not_self_regulating"),
        (LAG | {"sample_time_s": 1.0}, ONLY_FIVE, "refused", "cannot_oscillate"),
        ({"num": [1], "den": [-5, 1], "dead_time_s": 1}, ("fast",), "refused", "wrong_sign"),
        ({"num": [1], "den": [-5, 1], "dead_time_s": 1}, ONLY_FIVE, "failed", "pv_limit"),
        (LAG | {"noise_std": 0.1}, BOTH, "refused", "noise_too_high"),
        (LAG | {"mv_limits": [-0.001, 0.5]}, BOTH, "refused", "saturated"),
        (LAG | {"mv_limits": [5, 1]}, BOTH, "refused", "bad_input"),
        (LAG | {"num": [float("nan")]}, BOTH, "refused", "bad_input"),
        (LAG | {"den": [0, 1]}, BOTH, "refused", "bad_input"),
        (LAG | {"num": [1, 2, 3]}, BOTH, "refused", "bad_input"),
        (LAG | {"dead_time_s": -1}, BOTH, "refused", "bad_input"),
        (LAG | {"colour": 3}, BOTH, "refused", "bad_input"),
        (LAG | {"num": [1, 0], "den": [30, 13, 1]}, BOTH, "refused", "bad_input"),
        (LAG | {"gains": {"Kp": 0.0, "Ti": 1.0}}, BOTH, "refused", "bad_input"),
        (LAG | {"gains": {"Ti": 1.0}}, BOTH, "refused", "bad_input"),
        (LAG | {"sample_time_s": 1e-6}, BOTH, "refused", "bad_input"),
        ({}, BOTH, "refused", "bad_input"),
    ],
)
def test_it_ends_with_a_reason(spec: dict[str, Any], methods: tuple[str, ...], outcome: str, reason: str) -> None:
    for method in methods:
        answer = rehearse(spec, method)
        assert (answer["outcome"], answer["reason"]) == (outcome, reason), (method, answer["detail"])
        assert answer["detail"]
        assert answer["advice"]
        assert answer["new_gains"] is None


def test_every_reason_has_its_advice() -> None:
    assert set(ADVICE) == set(Reason)


def numbers(gains: dict[str, Any]) -> dict[str, float]:
    return {name: value for name, value in gains.items() if name != "form"}


@pytest.mark.parametrize("method", BOTH)
def test_a_negative_gain_gives_the_mirror_image(method: str) -> None:
    up, down = rehearse(LAG, method), rehearse(LAG | {"num": [-2]}, method)
    # the relay starts high in both
    assert numbers(down["new_gains"]) == pytest.approx(numbers(up["new_gains"]), rel=1e-3)
    gain = (lambda model: model["num"][-1]) if method == "fast" else (lambda model: model["K"])
    assert gain(down["model"]) == pytest.approx(-gain(up["model"]), rel=1e-3)


@pytest.mark.parametrize("method", BOTH)
@pytest.mark.parametrize("factor", [1e-3, 60.0])
def test_scaling_time_scales_the_times_and_nothing_else(factor: float, method: str) -> None:
    slow = {"num": [2], "den": [500, 1], "dead_time_s": 150, "sample_time_s": 2.0, "t95_s": 1800}
    base = rehearse(slow, method)
    scaled = rehearse(
        slow | {k: v * factor for k, v in slow.items() if k.endswith("_s")} | {"den": [500 * factor, 1]},  # type: ignore[operator]
        method,
    )
    assert scaled["ultimate"]["Ku"] == pytest.approx(base["ultimate"]["Ku"], rel=2e-3)
    assert scaled["ultimate"]["Pu_s"] == pytest.approx(factor * base["ultimate"]["Pu_s"], rel=2e-3)


def test_the_procedure_can_be_entered_at_each_stage_by_hand() -> None:
    whole = rehearse(LAG, FIVE)
    stages = whole["stages"]
    from_ultimate = rehearse(LAG, FIVE, start="zn_pi", Ku=whole["ultimate"]["Ku"], Pu_s=whole["ultimate"]["Pu_s"])
    zn = stages["zn_pi"]
    from_overshoot = rehearse(
        LAG, FIVE, start="estimate", Kp=zn["Kp"], Ti_s=zn["Ti_s"], overshoot_pct=zn["overshoot_pct"]
    )
    model = whole["model"]
    from_model = rehearse(LAG, FIVE, start="optimise", model=FOPDT(model["K"], model["T_s"], model["L_s"]))
    for entered in (from_ultimate, from_overshoot, from_model):
        assert entered["outcome"] == "proposed", entered["detail"]
        assert numbers(entered["new_gains"]) == pytest.approx(numbers(whole["new_gains"]), rel=0.02)
        assert entered["plant_time_s"]["total"] < whole["plant_time_s"]["total"]


def test_values_typed_in_are_checked() -> None:
    assert rehearse(LAG, FIVE, start="zn_pi", Ku=4.0)["reason"] == "bad_input"
    assert rehearse(LAG, FIVE, start="optimise", model=FOPDT(-2.0, 5.0, 1.0))["reason"] == "wrong_sign"
    assert rehearse(LAG, "fast", model=FOPDT(-2.0, 5.0, 1.0))["reason"] == "wrong_sign"
    assert rehearse(LAG, "fast", Ms=0.9)["reason"] == "bad_input"
