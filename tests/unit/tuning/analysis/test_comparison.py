"""The verdict on new gains beside the present ones: each combination of robustness and performance."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from loopwright.tuning.analysis.comparison import (
    Comparison,
    LoopPerformance,
    RobustnessBounds,
    compare,
    loop_performance,
    weighted_IAE,
)
from loopwright.tuning.analysis.margins import margins, ultimate_point
from loopwright.tuning.analysis.step_response import step_figures
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.fast.evaluation.proposal import comparison_on
from loopwright.tuning.fast.known_plant.design_trial import designed_on
from loopwright.tuning.fast.relay.procedure import FastOptions
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, Integrating, Model
from loopwright.tuning.rules.design import comparison_of, design

PLANT = FOPDT(2.0, 6.0, 1.5)
SAMPLE_S = 0.1
Ku, Pu = ultimate_point(PLANT)


def by_fast(old: Gains, Ms: float = 1.6, plant: Model = PLANT, **options: bool) -> Comparison:
    """The design of fast on the model beside the previous gains."""
    wished = FastOptions(Ms=Ms, **options)
    facts = Facts(SAMPLE_S, 20.0, 0.0, 100.0, 2.0, old)
    best = designed_on(plant, wished.spec(), 0.0)
    return comparison_on(plant, best, facts, wished.spec(), wished.propose_anyway)


def by_rule(method: str, old: Gains) -> Comparison:
    designed = design("robust" if method == "five-stage" else method, PLANT, None)
    return comparison_of(designed, PLANT, old, SAMPLE_S, {}, False)


def own(method: str) -> Gains:
    """The gains that the method itself gives this plant."""
    return by_fast(Gains(0.1, 20.0)).new.gains if method == "fast" else by_rule(method, Gains(0.1, 20.0)).new.gains


def beside(method: str, old: Gains) -> Comparison:
    return by_fast(old) if method == "fast" else by_rule(method, old)


METHODS = ["fast", "five-stage", "simc", "amigo"]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("off", [0.99, 1.0, 1.01])
def test_its_own_gains_once_more_are_no_gain(method: str, off: float) -> None:
    gains = own(method)
    found = beside(method, replace(gains, Kp=off * gains.Kp))
    assert not found.gain
    assert found.verdict.startswith("Nothing asked for gets better by more than 5 %: the present gains are kept")


@pytest.mark.parametrize("method", METHODS)
def test_sluggish_gains_and_gains_that_swing_are_worth_a_change(method: str) -> None:
    sluggish, swings = beside(method, Gains(0.1 * Ku, 3.0 * Pu)), beside(method, Gains(0.85 * Ku, Pu))
    assert sluggish.gain and "% less integral error" in sluggish.verdict and "J falls by" in sluggish.verdict
    assert swings.gain and swings.verdict.startswith("The present gains ")
    assert swings.previous.Ms is not None and swings.new.Ms is not None and swings.previous.Ms > 2.0 * swings.new.Ms


@pytest.mark.parametrize("method", METHODS)
def test_gains_that_are_not_stable_on_the_model_are_worth_a_change(method: str) -> None:
    found = beside(method, Gains(1.3 * Ku, Pu))
    assert found.gain and not found.previous.stable and found.J_previous is None
    assert found.verdict.startswith("The present gains are not stable on the model found")


def test_robustness_that_is_asked_for_is_a_gain_whatever_it_costs() -> None:
    present = own("fast")  # Ms 1.6
    found = by_fast(present, Ms=1.3)
    assert found.J_previous is not None and found.J_new is not None
    assert found.gain and found.J_new > found.J_previous
    assert "Ms 1.60 (asked for: at most 1.30)" in found.verdict and "% more integral error" in found.verdict


def test_less_robustness_is_a_gain_where_it_makes_the_loop_faster() -> None:
    assert by_fast(own("fast"), Ms=2.0).gain
    assert not by_fast(own("fast"), Ms=1.62).gain


def test_a_present_loop_that_is_better_than_what_was_asked_for_is_kept() -> None:
    """Faster than the design and as robust, within 5 %: nothing that was asked for gets better."""
    present = by_fast(Gains(0.1, 20.0), Ms=1.66).new.gains
    found = by_fast(present, Ms=1.6)
    assert found.previous.Ms == pytest.approx(1.66, abs=0.01)
    assert found.J_previous is not None and found.J_new is not None and found.J_previous < found.J_new
    assert not found.gain


def test_a_proposal_that_was_asked_for_all_the_same_says_so() -> None:
    found = by_fast(own("fast"), propose_anyway=True)
    assert not found.gain and "proposed because that was asked for" in found.verdict


def test_a_rule_is_asked_for_the_robustness_that_it_gives() -> None:
    """AMIGO is chosen for a tame loop: it is worth having on one that fast has tuned, and fast on one of AMIGO's."""
    found = by_rule("amigo", own("fast"))
    assert found.gain and "by amigo" in found.verdict
    assert by_fast(own("amigo")).gain


def one(Ms: float, IAE: float, peak: float = 1.0) -> LoopPerformance:
    """Made-up figures."""
    some = loop_performance(PLANT, Gains(0.2 * Ku, Pu))
    assert some.setpoint is not None and some.load is not None
    step, load = replace(some.setpoint, IAE=IAE), replace(some.load, IAE=IAE, peak=peak)
    return replace(some, Ms=Ms, setpoint=step, load=load)


def test_what_is_worse_on_every_figure_is_never_proposed_whatever_the_criterion_says() -> None:
    before, after = one(1.5, 10.0), one(1.6, 11.0, 1.1)
    assert not compare(before, after, RobustnessBounds(2.0), "another", (100.0, 1.0)).gain
    assert compare(before, replace(after, Ms=1.4), RobustnessBounds(2.0), "another", (100.0, 1.0)).gain


@pytest.mark.parametrize(
    ("before", "after", "J", "gain"),
    [
        ((1.60, 10.0), (1.60, 9.6), (1.0, 0.96), False),
        ((1.60, 10.0), (1.60, 9.4), (1.0, 0.94), True),
        ((1.67, 10.0), (1.60, 11.0), (1.0, 1.1), False),
        ((1.69, 10.0), (1.60, 11.0), (1.0, 1.1), True),
        ((1.20, 10.0), (1.60, 11.0), (1.0, 1.1), False),
    ],
)
def test_five_percent_is_where_a_gain_begins(
    before: tuple[float, float], after: tuple[float, float], J: tuple[float, float], gain: bool
) -> None:
    assert compare(one(*before), one(*after), RobustnessBounds(1.6), "J", J).gain is gain


@pytest.mark.parametrize(
    ("asked", "present"),
    [
        (RobustnessBounds(2.0, Mt=1.05), "Mt"),
        (RobustnessBounds(2.0, GM=4.0), "GM"),
        (RobustnessBounds(2.0, noise_gain=0.5), "noise gain"),
    ],
)
def test_each_bound_counts(asked: RobustnessBounds, present: str) -> None:
    before, after = (loop_performance(PLANT, Gains(part * Ku, Pu)) for part in (0.5, 0.15))
    found = compare(before, after, asked, "J", (1.0, 2.0))
    assert found.gain and f"have {present}" in found.verdict


def test_the_figures_are_those_of_the_responses() -> None:
    gains = Gains(0.3 * Ku, Pu, 0.1 * Pu, 0.01 * Pu, 0.6)
    found = loop_performance(PLANT, gains)
    assert found.setpoint is not None and found.load is not None
    setpoint, load = step_figures(PLANT, gains, band=0.05), step_figures(PLANT, gains, load=True, band=0.05)
    assert (found.setpoint.IAE, found.setpoint.TV, found.load.peak) == (setpoint.IAE, setpoint.TV, load.peak)
    assert (found.overshoot_pct, found.load.settling_s) == (setpoint.overshoot_pct, load.settling_s)
    assert (found.Ms, found.GM) == (margins(PLANT, gains).Ms, margins(PLANT, gains).GM)
    assert weighted_IAE(found, 1.0, 1.0) == pytest.approx(0.5 * (setpoint.IAE + load.IAE))


def test_an_ideal_derivative_is_taken_as_the_controller_carries_it_out() -> None:
    found = loop_performance(PLANT, Gains(0.3 * Ku, Pu, 0.1 * Pu, 0.0), SAMPLE_S)
    assert found.gains.Tf == 0.0
    assert found.noise_gain == pytest.approx(0.3 * Ku * (1.0 + 0.1 * Pu / (0.5 * SAMPLE_S)))


def test_without_integral_action_an_offset_stays_and_is_no_figure() -> None:
    found = loop_performance(PLANT, Gains(0.3 * Ku))
    assert found.stable and found.setpoint is not None and found.load is not None
    assert found.setpoint.IAE is None and found.load.IAE is None and weighted_IAE(found, 1.0, 1.0) is None
    integrates = loop_performance(Integrating(0.1, 1.0), Gains(2.0))
    assert integrates.setpoint is not None and integrates.setpoint.IAE is not None
    assert math.isfinite(integrates.setpoint.IAE)
    better = by_fast(Gains(0.1 * Ku))
    assert better.gain and better.J_previous is None and "no longer a lasting integral error" in better.verdict
