"""What the plant gets in place of MV, on records whose actuator runs in steps of a tenth of a sample."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from loopwright.plantsim.plant import LinearPlant
from loopwright.plantsim.valves import Backlash, EqualPercentage
from loopwright.tuning.analysis.window import oscillation_at_rest
from loopwright.tuning.fast.record import Excitation, ExperimentRecord
from loopwright.tuning.fast.score_tests.mv_faults import find_mv_fault
from loopwright.tuning.fast.structure_choice import choose_structure
from loopwright.tuning.identification.output_error import Fit
from loopwright.tuning.models import Reals

TS, FINE, LISTENED, REST, NOISE = 0.5, 10, 160, 40.0, 0.05
Actuator = Callable[[float], float]


def mv() -> Reals:
    """Rest, a biased relay, then what a PI makes of a step: MV in percent."""
    relay = np.repeat((10.0, -5.0, 10.0, -5.0, 10.0, -5.0), (20, 38, 26, 38, 26, 38))
    t = np.arange(170)
    return REST + np.concatenate((np.zeros(LISTENED), relay, 9.0 * np.exp(-t / 50.0) * np.cos(t / 11.0)))


def moved(actuator: Actuator, seed: int = 0) -> tuple[ExperimentRecord, Reals]:
    """The record of a plant of gain 0.8, 30 s and 6 s, and its PV."""
    plant = LinearPlant((0.8,), (30.0, 1.0), 6.0, TS / FINE, noise_std=NOISE, seed=seed)
    given, pv = mv(), []
    for _ in range(4000):  # a window swings PV at rest as well
        plant.step(actuator(REST) - REST)
    for value in given:
        pv.append(plant.pv)
        for _ in range(FINE):
            plant.step(actuator(float(value)) - REST)
    y = np.array(pv)
    rest = slice(LISTENED)
    excited = LISTENED + 186
    return ExperimentRecord(
        TS, given - REST, y - y[rest].mean(), 1.0, LISTENED, excited, 6, 64.0, (excited,), Excitation.RELAY
    ), y


class Rate:
    def __init__(self, a_second: float) -> None:
        self.most, self.at = a_second * TS / FINE, REST

    def __call__(self, value: float) -> float:
        self.at += min(max(value - self.at, -self.most), self.most)
        return self.at


class Window:
    def __init__(self, seconds: float) -> None:
        self.length, self.n, self.on = round(seconds * FINE / TS), 3, 0.0

    def __call__(self, value: float) -> float:
        into = self.n % self.length
        if into == 0:
            self.on = value
        self.n += 1
        return 100.0 if into < self.on / 100.0 * self.length else 0.0


def found(actuator: Actuator, seed: int = 0) -> str | None:
    record, _ = moved(actuator, seed)
    fit = Fit(record)
    fault = find_mv_fault(fit, choose_structure(fit).best, REST)
    return None if fault is None else fault.what


@pytest.mark.parametrize("rate", [2.0])
def test_an_mv_that_moves_no_faster_is_told_with_its_rate(rate: float) -> None:
    what = found(Rate(rate))
    assert what is not None and "faster" in what
    assert float(what.split("about ")[1].split(" ")[0]) == pytest.approx(rate, rel=0.1)


@pytest.mark.parametrize("window", [5.5])
def test_an_mv_that_is_switched_is_told_with_its_window(window: float) -> None:
    what = found(Window(window))
    assert what is not None and "switched on and off in a window" in what
    assert float(what.split("window of ")[1].split(" ")[0]) == pytest.approx(window, rel=0.01)


@pytest.mark.parametrize("step", [2.0])
def test_an_mv_in_steps_is_told_with_its_step(step: float) -> None:
    what = found(lambda value: step * round(value / step))
    assert what is not None and "in steps" in what
    assert float(what.split("about ")[1]) == pytest.approx(step, rel=0.1)


@pytest.mark.parametrize(
    "actuator",
    [
        Backlash(1.0, 0.0).step,
        EqualPercentage(30.0).step,
    ],
    ids=["backlash", "equal percentage"],
)
def test_other_plants_and_valves_are_not_told_to_be_one_of_these(actuator: Actuator) -> None:
    what = found(lambda value: REST + actuator(value - REST))
    assert what is None


@pytest.mark.parametrize("window", [4.0, 9.0])
def test_a_window_that_swings_pv_at_rest_is_told_there(window: float) -> None:
    _, pv = moved(Window(window))
    rest = slice(LISTENED)
    oscillation = oscillation_at_rest(pv[rest], mv()[rest], TS)
    assert oscillation is not None and oscillation.by_window
    assert float(oscillation.in_words.split("window of ")[1].split(" ")[0]) == pytest.approx(window, rel=0.02)


def test_another_oscillation_at_rest_is_no_window_and_noise_is_none() -> None:
    t, random = TS * np.arange(200), np.random.default_rng(3)
    noise = NOISE * random.standard_normal(200)
    oscillation = oscillation_at_rest(0.5 * np.sin(2.0 * np.pi * t / 9.0) + noise, np.full(200, REST), TS)
    assert oscillation is not None and not oscillation.by_window and "9" in oscillation.in_words
    assert oscillation_at_rest(noise, np.full(200, REST), TS) is None


@pytest.mark.parametrize("on_for", [0.2, 0.25])
def test_a_load_that_goes_on_and_off_by_itself_is_no_window(on_for: float) -> None:
    plant = LinearPlant((0.8,), (30.0, 1.0), 6.0, TS, noise_std=NOISE, seed=1)
    pv = []
    for k in range(1200):
        pv.append(plant.pv)
        plant.step(12.0 * (k / 34.0 % 1.0 < on_for))
    oscillation = oscillation_at_rest(np.array(pv[-300:]), np.full(300, REST), TS)
    assert oscillation is not None and not oscillation.by_window and "17" in oscillation.in_words
