"""The benchmark's plants in trouble: what is simulated and what is judged are the same plant, by closed forms."""

from __future__ import annotations

import cmath
import math

import numpy as np
import pytest

from benchmarks.plants import Plant
from benchmarks.trouble.cases import build
from benchmarks.trouble.chain import Chain, Part, Parts, Setting
from benchmarks.trouble.plants import trouble_plants
from benchmarks.trouble.processes import DriftingGain, Recirculation, SecondPath, linear
from benchmarks.trouble.response import Response, delayed, gain, judged, rational, series
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import TransferFunction

PLANT = trouble_plants()[0]


def setting(substeps: int = 1, plant: Plant = PLANT) -> Setting:
    return Setting(plant, substeps, 0.0, 1)


def steady(part: Part, given: Setting, w: float, periods: int = 60) -> complex:
    """The response of a part to a sine of this frequency, by its last ten periods."""
    per = round(2.0 * math.pi / (w * given.h))
    w = 2.0 * math.pi / (per * given.h)
    t = given.h * np.arange(periods * per)
    # what is held for a step comes half a step late on average
    out = np.array([part.step(math.sin(w * (each + 0.5 * given.h))) for each in t])[-10 * per :]
    at = t[-10 * per :] + given.h
    return complex(2.0 * np.mean(out * np.exp(-1j * w * at)) * 1j)


@pytest.mark.parametrize(
    ("gains", "stable"), [(Gains(1.0, 2.0), True), (Gains(2.5, 0.9), True), (Gains(9.0, 0.3), False)]
)
@pytest.mark.parametrize("plant", trouble_plants())
def test_ms_and_stability_are_those_of_the_exact_margins(plant: Plant, gains: Gains, stable: bool) -> None:
    given = Gains(gains.Kp * plant.Ku / trouble_plants()[0].Ku, gains.Ti * plant.Pu)
    true = margins(TransferFunction(plant.num, plant.den, plant.L), given)
    found = judged(rational(plant.num, plant.den, plant.L), given, plant.Pu)
    assert found.stable == true.stable == stable
    assert found.Ms == pytest.approx(true.Ms, rel=1e-4)


def test_a_pole_of_the_plant_in_the_right_half_plane_is_counted() -> None:
    plant = rational((2.0,), (1.0, -1.0))  # 1 + 2 Kp (1 + 1/(Ti s))/(s - 1): stable for 2 Kp > 1
    assert judged(plant, Gains(2.0, 10.0), 1.0).stable
    assert judged(plant, Gains(0.4, 10.0), 1.0).unstable == 2
    assert rational((2.0,), (1.0, -1.0)).unstable == 1


def test_a_delay_takes_its_own_phase_margin_and_no_more() -> None:
    plant, gains = rational((1.0,), (1.0, 0.0)), Gains(1.0, 4.0)
    margin = margins(TransferFunction((1.0,), (1.0, 0.0)), gains).delay_margin_s
    assert margin is not None
    assert judged(series(plant, delayed(0.99 * margin)), gains, 4.0).stable
    assert judged(series(plant, delayed(1.01 * margin)), gains, 4.0).unstable == 2


@pytest.mark.parametrize("share", [0.3, -0.3])
def test_a_second_path_is_the_sum_of_two_delays(share: float) -> None:
    part, given = SecondPath(setting(), share, 2.0), setting()
    [response] = part.linearisations()
    for w in (1.0, 3.0, 5.8):
        expected = (1.0 + share * cmath.exp(-2j * w * PLANT.Pu)) * cmath.exp(-0.3j * w) / (1.0 + 1j * w)
        assert response.at(np.array([1j * w]))[0] == pytest.approx(expected, rel=1e-12)
    per = round(2.0 * math.pi / (3.0 * given.h))
    w = 2.0 * math.pi / (per * given.h)
    assert steady(part, given, w) == pytest.approx(complex(response.at(np.array([1j * w]))[0]), abs=2e-3)


@pytest.mark.parametrize("share", [0.6, -0.5])
def test_recirculation_is_a_loop_around_the_plant(share: float) -> None:
    given = setting(4)
    part = Recirculation(given, share, 1.0)
    [response] = part.linearisations()
    G = cmath.exp(-0.3j) / (1.0 + 1j)
    expected = G / (1.0 - share * G * cmath.exp(-1j * PLANT.Pu))
    assert response.at(np.array([1j]))[0] == pytest.approx(expected, rel=1e-12)
    per = round(2.0 * math.pi / given.h)
    w = 2.0 * math.pi / (per * given.h)
    assert steady(part, given, w, 30) == pytest.approx(complex(response.at(np.array([1j * w]))[0]), abs=5e-3)
    assert Recirculation(given, share, 1.0).linearisations()[0].at(np.array([1e-9j]))[0] == pytest.approx(
        1.0 / (1.0 - share), rel=1e-6
    )


def test_a_gain_drifts_from_the_beginning_of_the_test_and_is_judged_as_it_is_afterwards() -> None:
    part = DriftingGain(setting(), 1.3, 8.0)
    assert [part.step(1.0) for _ in range(100)] == [1.0] * 100
    part.begin()
    moved = [part.step(1.0) for _ in range(800)]
    assert moved[319] == pytest.approx(1.15) and moved[639] == pytest.approx(1.3) == moved[-1]
    assert part.linearisations()[0].at(np.array([1j]))[0] == pytest.approx(1.3)


def test_gains_are_judged_on_the_worst_linearisation() -> None:
    class Steep(Part):
        def linearisations(self) -> list[Response]:
            return [gain(1.0), gain(1.4)]

    gains = Gains(0.4 * PLANT.Ku, PLANT.Pu)
    once = Chain(setting(), build()).worst(gains)
    steep = Chain(setting(), lambda given: Parts([Steep(), linear(given)], []))
    assert steep.worst(gains).Ms == pytest.approx(
        margins(TransferFunction((1.4,), PLANT.den, PLANT.L + 0.5 * PLANT.Ts), gains).Ms, rel=1e-4
    )
    assert once.Ms == pytest.approx(margins(PLANT.model(), gains).Ms, rel=1e-4)
