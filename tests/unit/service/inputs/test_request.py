"""Requests of a retune: one kind by method, each with its own options alone."""

from __future__ import annotations

import math
import pickle
from typing import Any

import pytest
from pydantic import ValidationError

from loopwright.service.inputs.request import FastRetune, FiveStageRetune, RuleRetune, retune_request
from loopwright.service.inputs.validation import lines, place
from loopwright.service.jobs.fleet import FastRetunes, FiveStageRetunes, RuleRetunes, fleet_request
from loopwright.tuning.fast.design.design import Aim, DesignSpec
from loopwright.tuning.fast.design.options import DesignOptions
from loopwright.tuning.fast.relay.procedure import FastOptions
from loopwright.tuning.five_stage.procedure import Options
from loopwright.tuning.models import FOPDT, SOPDT, Integrating
from loopwright.tuning.rules.registry import METHODS

MODEL = {"K": 2.0, "T_s": 10.0, "L_s": 3.0}


@pytest.mark.parametrize(
    ("method", "kind", "fleet"),
    [
        (None, FastRetune, FastRetunes),
        ("fast", FastRetune, FastRetunes),
        ("five-stage", FiveStageRetune, FiveStageRetunes),
        *((name, RuleRetune, RuleRetunes) for name in METHODS),
    ],
)
def test_the_method_chooses_the_kind(method: str | None, kind: type, fleet: type) -> None:
    named = {} if method is None else {"method": method}
    request = retune_request(**named, verify=False, by="me")
    assert type(request) is kind and request.method == (method or "fast")
    assert retune_request(**request.asked()) == request == pickle.loads(pickle.dumps(request))
    many = fleet_request(**named, pattern="TIC-*", verify=False, by="me")
    assert type(many) is fleet and many.each() == request


def test_the_options_of_the_procedures_are_made_of_it() -> None:
    fast = retune_request(
        Ms=1.4, derivative=True, aim="load", amplitude_pct=5, min_switches=6, verify=False, propose_anyway=True
    )
    assert fast.options == FastOptions(
        1.4, True, amplitude=5.0, min_switches=6, verify=False, propose_anyway=True, aim=Aim.LOAD
    )
    pulses = retune_request(method="setpoint", aim="no_overshoot")
    assert pulses.options == DesignOptions(aim=Aim.NO_OVERSHOOT)
    assert retune_request().options.spec() == DesignSpec(aim=Aim.BALANCED)
    asked = {"settling_s": 300.0, "mv_peak": 4.0, "noise_gain": 2.0}
    for method in ("fast", "setpoint"):
        spec = retune_request(method=method, **asked).options.spec()
        assert spec == DesignSpec(noise_gain=2.0, settling_s=300.0, mv_peak=4.0) and spec.requirements == asked
    rule = retune_request(
        method="simc", start="zn_pi", Ku=2, Pu_s=3, method_options={"tau_c_s": 4}, baseline=False, k_source="ke",
        kp_step_factor=1.5, overshoot_window_pct=[8, 40], model_from="record",
    )  # fmt: skip
    assert rule.options == Options(
        "zn_pi", 2.0, 3.0, k_source="ke", kp_step_factor=1.5, overshoot_window_pct=(8.0, 40.0), baseline=False,
        method="simc", method_options={"tau_c_s": 4.0}, model_from="record",
    )  # fmt: skip
    five = retune_request(method="five-stage", start="estimate", Kp=1, Ti_s=2, overshoot_pct=25, propose_anyway=True)
    assert five.options == Options("estimate", Kp=1.0, Ti_s=2.0, overshoot_pct=25.0, propose_anyway=True)


@pytest.mark.parametrize(
    ("method", "aim"), [("fast", "comfort"), ("fast", None), ("setpoint", 1), ("five-stage", "load")]
)
def test_an_aim_that_does_not_exist_or_is_not_of_the_method(method: str, aim: object) -> None:
    with pytest.raises(ValidationError) as refused:
        retune_request(method=method, aim=aim)
    assert "aim" in str(refused.value)


@pytest.mark.parametrize("name", ["settling_s", "mv_peak", "noise_gain"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, 1e300, "soon"])
@pytest.mark.parametrize("method", ["fast", "setpoint"])
def test_a_requirement_that_no_loop_can_have(method: str, name: str, value: object) -> None:
    with pytest.raises(ValidationError) as refused:
        retune_request(method=method, **{name: value})
    assert name in str(refused.value)


def test_a_requirement_is_not_of_the_five_stages() -> None:
    with pytest.raises(ValidationError) as refused:
        retune_request(method="five-stage", settling_s=300.0)
    assert "settling_s" in str(refused.value)


@pytest.mark.parametrize(
    ("model", "plant"),
    [
        (MODEL, FOPDT(2.0, 10.0, 3.0)),
        (MODEL | {"zeta": 0.5}, SOPDT(2.0, 10.0, 0.5, 3.0)),
        ({"K": 2, "T1_s": 10, "T2_s": 4, "L_s": 3}, SOPDT(K=2.0, T1=10.0, T2=4.0, L=3.0)),
    ],
)
def test_a_model_to_enter_with(model: dict[str, Any], plant: FOPDT | SOPDT) -> None:
    rule = retune_request(method="amigo", start="optimise", model=model)
    assert isinstance(rule, RuleRetune) and rule.options.model == plant
    assert retune_request(**rule.asked()) == rule


def test_fast_designs_for_every_form() -> None:
    request = retune_request(start="design", model={"K": 0.1, "L_s": 3, "integrating": True})
    assert request.model is not None and request.model.plant() == Integrating(0.1, 3.0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"method": "magic"}, "method must be one of fast, setpoint, five-stage, zn-ultimate"),
        ({"method": "magic"}, "not 'magic'"),
        ({"method": None}, "not None"),
        ({"method": ["fast"]}, "not ['fast']"),
        # an option that a method does not have, at its default and as null too, with those that it has
        ({"k_source": "k5"}, "k_source: of the five-stage experiment, not of fast, which is used unless"),
        ({"Ku": None}, "its options are sp_deviation, mv_low"),
        ({"method": "fast", "method_options": {}}, "min_switches"),
        ({"method": "five-stage", "Ms": 1.6}, 'Ms: of "method": "fast", not of five-stage; its options are'),
        ({"method": "simc", "min_switches": 4}, "method_options"),
        ({"method": "simc", "pattern": "*"}, "pattern: no option of simc; its options are"),
        ({"ms": 1.4}, "ms: no option of fast; did you mean Ms?; its options are"),
        ({"careful": True}, "careful: no option of fast; did you mean min_switches?"),
        ({"requested_by": "me"}, "requested_by: no option of fast; did you mean by?"),
        ({"ms_aim": 1.4}, "ms_aim: no option of fast; did you mean aim?; its options are"),
        # of the rule
        ({"method": "simc", "method_options": {"lambda_s": 1}}, "simc has no option 'lambda_s'; it has: controller"),
        ({"method": "five-stage", "method_options": {"tau_c_s": 1}}, "robust has no option 'tau_c_s'"),
        ({"method": "simc", "method_options": {"tau_c_s": -1}}, "tau_c_s must be 0 or more s, not -1"),
        # what does not go together
        ({"method": "simc", "start": "estimate", "Kp": 1, "Ti_s": 2}, "entering at estimate needs overshoot_pct"),
        ({"method": "simc", "start": "optimise"}, "entering at optimise needs a model"),
        ({"method": "simc", "start": "zn_pi", "Ku": 1, "Pu_s": 2, "overshoot_window_pct": [50, 8]}, "low < high"),
        (
            {"method": "simc", "start": "optimise", "model": MODEL, "model_from": "record"},
            'model_from "record" needs Stage 3; the start is optimise',
        ),
        (
            {"method": "simc", "start": "optimise", "model": {"K": 1, "L_s": 1, "integrating": True}},
            "simc takes a model of the form K, T_s, L_s",
        ),
        ({"start": "design", "model": {"K": 2, "tau": 10, "theta": 3}}, "tau, theta: not a quantity of the form"),
    ],
)
def test_what_is_refused_and_how(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError) as caught:
        retune_request(**options)
    assert words in lines(caught.value)
    with pytest.raises(ValidationError):
        fleet_request(**{"pattern": "*"} | options, loops=["TIC-101"])


def test_a_place_names_what_was_sent_alone() -> None:
    with pytest.raises(ValidationError) as caught:
        retune_request(start="design", model={"K": 1, "T_s": -3, "L_s": 1})
    (error,) = caught.value.errors()
    assert place(error["loc"]) == "model.T_s" and error["loc"] != ("model", "T_s")
