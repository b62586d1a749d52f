"""Gains, integrals and the search against margins, exact responses and brute force."""

from __future__ import annotations

import math

import numpy as np
import pytest

from loopwright.tuning.analysis.margins import margins, ultimate_point
from loopwright.tuning.analysis.stability import is_stable
from loopwright.tuning.analysis.step_response import step_figures
from loopwright.tuning.fast.design.design import DesignSpec, GainDesign, controller, frequencies
from loopwright.tuning.fast.design.gain_bounds import does_not_encircle, largest_gains
from loopwright.tuning.fast.design.iae import LoopCost
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import TransferFunction, sign
from loopwright.tuning.reasons import Reason, Refused
from tests.unit.tuning.fast.records import BENCHES, FIVE_LAGS, INTEGRATES, INVERSE, THREE_LAGS

LOOPS = [
    (THREE_LAGS.model, Gains(0.8, 4.0)),
    (THREE_LAGS.model, Gains(1.2, 4.0, 0.8, 0.08)),
    (INVERSE.model, Gains(0.3, 2.5)),
    (FIVE_LAGS.model, Gains(0.7, 4.5, 1.2, 0.12)),
    (INTEGRATES.model, Gains(0.6, 25.0)),
    (TransferFunction((1.0, 4.0), (5.0, 10.0), 1.0), Gains(0.8, 2.0)),
]


def period(model: TransferFunction) -> float:
    return ultimate_point(model)[1]


@pytest.mark.parametrize(("model", "gains"), LOOPS)
@pytest.mark.parametrize("load", [False, True])
def test_the_integrals_are_those_of_the_exact_response(model: TransferFunction, gains: Gains, load: bool) -> None:
    N = gains.Td / gains.Tf if gains.Td else 10.0
    cost = LoopCost(model, period(model))(gains.Kp, gains.Ti, gains.Td, N)
    exact = step_figures(model, gains, load=load).IAE
    # 80 steps in a period, and a controller that is sampled with them
    assert (cost.load if load else cost.setpoint) == pytest.approx(exact, rel=0.01)


@pytest.mark.parametrize("name", BENCHES)
@pytest.mark.parametrize("Ms", [1.2, 1.6, 2.0])
@pytest.mark.parametrize("ratio", [0.3, 1.0, 5.0])
def test_the_largest_gain_has_the_Ms_asked(name: str, Ms: float, ratio: float) -> None:
    model = BENCHES[name].model
    Ti = ratio * period(model)
    w = frequencies(period(model))
    g = sign(model) * model.frequency_response(w) * controller(w, Ti, 0.0, 10.0)
    stable = [Kp for Kp in largest_gains(g, Ms) if does_not_encircle(Kp * g)]
    for Kp in stable:
        found = margins(model, Gains(Kp, Ti))
        assert found.stable
        # the grid has a hundred points to a decade
        assert found.Ms == pytest.approx(Ms, abs=2e-3)
        assert margins(model, Gains(1.02 * Kp, Ti)).Ms > Ms
    # an integrator bears only so short an integral time
    assert len(stable) == 1 or (name == "integrates" and ratio < 5.0)


@pytest.mark.parametrize("Mt", [1.05, 1.3])
def test_a_bound_on_Mt_is_kept_and_met(Mt: float) -> None:
    model = INTEGRATES.model
    Ti = 3.0 * period(model)
    w = frequencies(period(model))
    g = model.frequency_response(w) * controller(w, Ti, 0.0, 10.0)
    ends = [Kp for Kp in largest_gains(g, 2.0, Mt) if does_not_encircle(Kp * g)]
    for Kp in ends:
        found = margins(model, Gains(Kp, Ti))
        assert found.Mt <= Mt + 2e-3 and found.Ms <= 2.0 + 2e-3
        assert found.Mt > Mt - 2e-3 or found.Ms > 2.0 - 2e-3
    if not ends:
        # a short integral time on an integrator peaks whatever the gain
        seen = [margins(model, Gains(float(Kp), Ti)) for Kp in np.geomspace(0.001, 2.0, 40)]
        assert all(each.Mt > Mt for each in seen if each.stable)


def test_what_the_encirclements_say_is_what_the_poles_say() -> None:
    random = np.random.default_rng(3)
    verdicts = []
    for bench in BENCHES.values():
        model = bench.model
        Ku, Pu = ultimate_point(model)
        w = frequencies(Pu)
        for _ in range(12):
            gains = Gains(Ku * random.uniform(0.2, 1.5), Pu * math.exp(random.uniform(-2.0, 2.0)))
            loop = gains.Kp * sign(model) * model.frequency_response(w) * controller(w, gains.Ti, 0.0, 10.0)
            verdicts.append((does_not_encircle(loop), is_stable(model, gains)))
    assert all(ours == exact for ours, exact in verdicts)
    assert {exact for _, exact in verdicts} == {True, False}


@pytest.mark.parametrize("name", ["first order", "three lags", "inverse response", "integrates"])
def test_no_other_integral_time_is_better(name: str) -> None:
    bench = BENCHES[name]
    model = TransferFunction(tuple(sign(bench.model) * c for c in bench.num), bench.den, bench.L)
    design = GainDesign(model, DesignSpec(1.6), period(model))
    best = design.best()
    assert margins(model, best.gains).Ms == pytest.approx(1.6, abs=2e-3)
    assert design.minimum is not None
    for Ti in best.gains.Ti * np.geomspace(0.7, 1.4, 25):
        for _, cost in design.candidates(float(Ti)):
            J = 0.5 * cost.setpoint / design.minimum.setpoint + 0.5 * cost.load / design.minimum.load
            assert J >= best.J * (1.0 - 1e-4)


def test_a_derivative_pays_on_lags_and_is_left_out_where_it_does_not() -> None:
    lags, delay = THREE_LAGS.model, TransferFunction((1.0,), (0.05, 1.0), 1.0)
    pi = GainDesign(lags, DesignSpec(1.6), period(lags)).best()
    pid = GainDesign(lags, DesignSpec(1.6, derivative=True), period(lags)).best()
    of_pi = 0.5 * pi.cost.setpoint / pid.minimum.setpoint + 0.5 * pi.cost.load / pid.minimum.load
    assert pid.gains.Td > 0.0 and pid.J / of_pi < 0.97
    assert margins(lags, pid.gains).Ms == pytest.approx(1.6, abs=2e-3)
    assert GainDesign(delay, DesignSpec(1.6, derivative=True), period(delay)).best().gains.Td == 0.0


@pytest.mark.parametrize("name", BENCHES)
@pytest.mark.parametrize("part", [0.1, 0.3, 0.6, 0.9])
def test_a_gain_held_below_the_largest_keeps_Ms(name: str, part: float) -> None:
    """With a short integral time a smaller gain may be the less robust one."""
    bench = BENCHES[name]
    model = TransferFunction(tuple(sign(bench.model) * c for c in bench.num), bench.den, bench.L)
    maximum = part * GainDesign(model, DesignSpec(1.6), period(model)).best().gains.Kp
    held = GainDesign(model, DesignSpec(1.6, noise_gain=maximum), period(model)).best().gains
    assert held.Kp <= maximum * (1.0 + 1e-9)
    assert margins(model, held).Ms <= 1.602


def test_a_bound_on_the_noise_gain_holds() -> None:
    model = THREE_LAGS.model
    free = GainDesign(model, DesignSpec(1.6, derivative=True), period(model)).best().gains
    maximum = 0.5 * free.Kp * 11.0
    held = GainDesign(model, DesignSpec(1.6, derivative=True, noise_gain=maximum), period(model)).best().gains
    assert held.Kp * (11.0 if held.Td else 1.0) <= maximum * (1.0 + 1e-9)
    assert margins(model, held).Ms <= 1.602


@pytest.mark.parametrize(
    "bad",
    [
        {"Ms": 1.0}, {"Ms": math.nan}, {"Mt": 0.9}, {"noise_gain": 0.0}, {"N": 1.0}, {"weights": (1.0, 0.5)},
        {"weights": (-0.1, 1.0)}, {"weights": (0.0, math.inf)},
    ],
)  # fmt: skip
def test_wishes_that_cannot_be_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(Refused) as refused:
        DesignSpec(**bad)  # type: ignore[arg-type]
    assert refused.value.reason is Reason.BAD_INPUT
    assert next(iter(bad)) in refused.value.detail
