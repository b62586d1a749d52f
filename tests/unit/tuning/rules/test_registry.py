"""The registry: every method is described, takes what it says, and refuses the rest in words."""

from __future__ import annotations

import inspect
import math
from typing import Any

import pytest

from loopwright.tuning.fast.known_plant.tuned import METHODS as ALL
from loopwright.tuning.models import FOPDT, SOPDT, Integrating, Model, TransferFunction
from loopwright.tuning.reasons import Reason, Refused
from loopwright.tuning.rules.registry import METHODS, Method, Option, tune
from tests.unit.tuning.tables import ROOT

NAMES = [
    "zn-ultimate", "zn-step", "tyreus-luyben", "cohen-coon", "chr", "kappa-tau", "amigo", "lambda", "simc", "imc-pi",
    "imc-pid", "direct-synthesis", "robust", "s-plane", "me-pso",
]  # fmt: skip
# a search of a second or two each: not in every loop below
QUICK = [name for name in NAMES if name != "me-pso"]

SAMPLES: dict[type[Model], Model] = {
    FOPDT: FOPDT(2.0, 10.0, 4.0),
    SOPDT: SOPDT(K=2.0, T1=10.0, T2=3.0, L=2.0),
    Integrating: Integrating(0.1, 2.0),
    TransferFunction: TransferFunction((-0.5, 1.0), (1.0, 3.0, 3.0, 1.0), 1.0),
}


def refusal(name: str, model: Model, **options: Any) -> Refused:
    with pytest.raises(Refused) as caught:
        tune(name, model, **options)
    return caught.value


def test_the_list() -> None:
    assert list(METHODS) == NAMES and list(ALL) == [*NAMES, "fast"]
    assert all(method.name == name for name, method in ALL.items())


@pytest.mark.parametrize("method", ALL.values(), ids=list(ALL))
def test_every_method_is_described(method: Method) -> None:
    assert all((method.title, method.source, method.needs, method.takes))
    assert method.for_what.endswith(".")
    assert all(option.meaning for option in method.options.values())


def test_the_documented_table() -> None:
    lines = (ROOT / "docs/methods.md").read_text(encoding="utf-8").splitlines()
    shown = [line for line in lines if line.startswith("| `")]
    assert shown == [
        f"| `{m.name}` | {m.for_what} | {m.needs} | {', '.join(f'`{name}`' for name in m.options)} |"
        for m in ALL.values()
    ]


@pytest.mark.parametrize("method", ALL.values(), ids=list(ALL))
def test_options_are_those_of_the_rule(method: Method) -> None:
    """Same names, same defaults: what is shown is what is used."""
    keywords = {
        name: p.default for name, p in inspect.signature(method.rule).parameters.items() if p.kind is p.KEYWORD_ONLY
    }
    assert {name: option.default for name, option in method.options.items()} == keywords


@pytest.mark.parametrize("method", METHODS.values(), ids=NAMES)
def test_every_kind_it_names_and_every_choice(method: Method) -> None:
    for kind in method.takes if method.name in QUICK else (FOPDT,):
        model, pid = SAMPLES[kind], {}
        if method.name == "s-plane" and kind is Integrating:
            # a PID only, and with dead time not without a lag
            model, pid = Integrating(0.1, 2.0, 3.0), {"controller": "pid"}
        plain = method.tune(model, **pid)
        assert plain.gains.Kp > 0.0
        defaults = {name: option.default for name, option in method.options.items()}
        assert method.tune(model, **defaults | pid) == plain
    for name, option in method.options.items():
        answers = []
        for choice in option.choices:
            model = SAMPLES[SOPDT if choice == "pid" and SOPDT in method.takes else method.takes[0]]
            answers.append(method.tune(model, **{name: choice}).gains)
        assert len(set(answers)) == len(answers), f"{name} changes nothing"


def test_the_sign_of_the_gain_is_the_controllers_matter() -> None:
    for name in QUICK:
        assert tune(name, FOPDT(-2.0, 10.0, 4.0)) == tune(name, FOPDT(2.0, 10.0, 4.0))


def test_reduction_is_noted() -> None:
    third = TransferFunction((1.0,), (1.0, 3.0, 3.0, 1.0), 0.5)
    found = tune("amigo", third)
    expected = tune("amigo", FOPDT(1.0, 1.5, 2.0)).gains
    assert [found.gains.Kp, found.gains.Ti] == pytest.approx([expected.Kp, expected.Ti])
    assert "half rule to first order with K = 1, T = 1.5 s, L = 2 s" in found.notes[0]
    assert "second order with K = 1, T1 = 1.5 s, T2 = 1 s, L = 1 s" in tune("direct-synthesis", third).notes[0]
    assert (
        "tangent to first order with K = 2, T = 20 s, L = 2.931 s"
        in (tune("zn-step", SOPDT(K=2.0, T1=10.0, T2=5.0, L=1.0)).notes[0])
    )
    lagged = tune("lambda", Integrating(0.1, 1.0, 1.0), lambda_s=6.0)
    assert lagged.gains == tune("lambda", Integrating(0.1, 2.0), lambda_s=6.0).gains
    assert "an integrator with K = 0.1 per s, L = 2 s" in lagged.notes[0]


def test_a_transfer_function_of_a_known_kind_needs_no_note() -> None:
    found = tune("amigo", TransferFunction((4.0,), (20.0, 2.0), 4.0))
    assert found == tune("amigo", FOPDT(2.0, 10.0, 4.0)) and not found.notes
    assert tune("zn-step", TransferFunction((0.2,), (2.0, 0.0), 2.0)) == tune("zn-step", Integrating(0.1, 2.0))


@pytest.mark.parametrize("name", [n for n in NAMES if Integrating not in METHODS[n].takes])
def test_integrating_plants_where_they_are_not_taken(name: str) -> None:
    for model in (Integrating(0.1, 2.0), TransferFunction((1.0,), (1.0, 2.0, 1.0, 0.0), 1.0)):
        refused = refusal(name, model)
        assert refused.reason is Reason.NOT_SELF_REGULATING
        assert METHODS[name].needs in refused.detail


def test_plants_without_a_sound_reduction() -> None:
    ringing = SOPDT(1.0, 1.0, 0.5, 0.5)
    for name in QUICK:
        if name in ("zn-ultimate", "tyreus-luyben", "imc-pid", "direct-synthesis", "s-plane"):
            assert tune(name, ringing).gains.Kp > 0.0
        else:
            assert refusal(name, ringing).reason is Reason.OUTSIDE_RANGE
        # the s-plane method would take an unstable plant, but finds no roots of the shape for this one
        expected = Reason.BAD_INPUT if name == "s-plane" else Reason.OUTSIDE_RANGE
        assert refusal(name, TransferFunction((1.0,), (-5.0, 1.0), 0.5)).reason is expected


def test_without_dead_time() -> None:
    """Rules that divide by L refuse; those with a lambda of their own do not."""
    plain = FOPDT(1.0, 10.0, 0.0)
    for name in QUICK:
        if name == "s-plane":
            assert tune(name, plain).gains.Kp > 0.0
        elif name in ("lambda", "imc-pi", "imc-pid"):
            assert tune(name, plain).gains.Ti == 10.0
        elif name == "simc":
            assert "tau_c_s" in refusal(name, plain).detail
            assert tune(name, plain, tau_c_s=5.0).gains.Kp == 2.0
        else:
            expected = Reason.CANNOT_OSCILLATE if name in ("zn-ultimate", "tyreus-luyben") else Reason.OUTSIDE_RANGE
            assert refusal(name, plain).reason is expected
    for name in ("zn-step", "amigo", "lambda", "imc-pi", "imc-pid", "simc"):
        assert refusal(name, Integrating(1.0, 0.0)).reason is Reason.OUTSIDE_RANGE


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        ("zn-step", 0.1, 1.0),
        ("chr", 0.1, 1.0),
        ("cohen-coon", 0.05, 1.0),
        ("kappa-tau", 0.1, 5.5),
        ("robust", 0.02, 20.0),
    ],
)
def test_ranges(name: str, low: float, high: float) -> None:
    for ratio in (low, high):
        assert tune(name, FOPDT(1.0, 7.0, 7.0 * ratio)).notes == ()
    for ratio in (0.99 * low, 1.01 * high):
        model = FOPDT(1.0, 7.0, 7.0 * ratio)
        refused = refusal(name, model)
        assert refused.reason is Reason.OUTSIDE_RANGE and refused.advice
        assert f"L/T = {ratio:.4g} is outside {low:g} to {high:g}" in refused.detail
        if "extrapolate" in METHODS[name].options:
            assert "outside" in tune(name, model, extrapolate=True).notes[0]


def test_other_ranges() -> None:
    model = FOPDT(1.0, 10.0, 4.0)
    assert "from 4 s up" in refusal("lambda", model, lambda_s=3.9).detail
    assert "below 0.5 L = 2 s" in refusal("imc-pi", model, lambda_s=1.9).detail
    assert "0 to 1.5708" in refusal("direct-synthesis", model, c=1.6).detail
    assert tune("simc", model, tau_c_s=3.0).notes[0].startswith("tau_c = 3 s is below the dead time")
    assert tune("direct-synthesis", model, c=0.5).notes[0].endswith("a set-point step overshoots.")
    assert "second lag" in refusal("simc", model, controller="pid").detail
    assert "variant tau" in refusal("cohen-coon", model, variant="tau", controller="pid").detail
    assert "psi_s is for integrating" in refusal("imc-pid", model, psi_s=50.0).detail
    assert "10 s up" in refusal("imc-pid", Integrating(1.0, 4.0), psi_s=9.0, lambda_s=8.0).detail


@pytest.mark.parametrize(
    ("name", "options", "says"),
    [
        ("nelder", {}, "method must be one of zn-ultimate, "),
        ("simc", {"lambda_s": 1.0}, "simc has no option 'lambda_s'; it has: controller, tau_c_s"),
        ("simc", {"tau_c_s": math.nan}, "tau_c_s must be a number, not nan"),
        ("simc", {"tau_c_s": math.inf}, "tau_c_s must be a number"),
        ("simc", {"tau_c_s": "2"}, "tau_c_s must be a number, not '2'"),
        ("simc", {"tau_c_s": True}, "tau_c_s must be a number, not True"),
        ("simc", {"tau_c_s": -1.0}, "tau_c_s must be 0 or more s, not -1.0"),
        ("simc", {"controller": "PID"}, "controller must be one of pi, pid, not 'PID'"),
        ("simc", {"controller": None}, "controller must be one of pi, pid, not None"),
        ("chr", {"overshoot_pct": 10}, "overshoot_pct must be one of 0.0, 20.0, not 10"),
        ("zn-step", {"extrapolate": 1}, "extrapolate must be true or false, not 1"),
        ("imc-pi", {"lambda_s": 0.0}, "lambda_s must be a number > 0 s"),
    ],
)
def test_bad_arguments(name: str, options: dict[str, Any], says: str) -> None:
    refused = refusal(name, FOPDT(1.0, 10.0, 4.0), **options)
    assert refused.reason is Reason.BAD_INPUT
    assert says in refused.detail


def test_whole_numbers_and_both_ends_of_a_range() -> None:
    seed = Option("", 0, "", range=(0, 9), kind="whole")
    assert seed.check("seed", 3) == 3 and isinstance(seed.check("seed", 3), int)
    for wrong, says in ((1.5, "a whole number"), (10, "0 to 9"), (False, "a whole number")):
        with pytest.raises(Refused, match=says):
            seed.check("seed", wrong)
    with pytest.raises(Refused, match="9 or less"):
        Option("", 0.0, "", range=(None, 9.0)).check("x", 10.0)


def test_a_plant_whose_settings_are_no_numbers() -> None:
    refused = refusal("amigo", FOPDT(1e-300, 1.0, 1e-200))
    assert refused.reason is Reason.OUTSIDE_RANGE and "units" in refused.detail
