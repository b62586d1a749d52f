"""The Cramer-Rao bound of Ms against what the best estimate from the same MV comes to over many draws of the noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.bound import bound
from benchmarks.plants import Plant, plant_of
from loopwright.plantsim.plant import LinearPlant
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.fast.record import Excitation, ExperimentRecord
from loopwright.tuning.gains import Gains
from loopwright.tuning.identification.output_error import UNDISTURBED, Fit
from loopwright.tuning.identification.structures import FIRST
from loopwright.tuning.models import TransferFunction

NOISE, DRAWS, RESTED = 0.02, 60, 120
GAINS = Gains(1.6, 1.1)


@pytest.fixture(scope="module")
def plant() -> Plant:
    return plant_of("lag", TransferFunction((1.0,), (1.0, 1.0), 0.3))


@pytest.fixture(scope="module")
def record(plant: Plant) -> ExperimentRecord:
    """MV up and down each half period, PV without noise."""
    simulated = LinearPlant(plant.num, plant.den, plant.L, plant.Ts)
    u = np.concatenate((np.zeros(RESTED), np.repeat([1.0, -0.5, 1.0, -0.5, 1.0], 40)))
    y = []
    for mv in u:
        y.append(simulated.pv)
        simulated.step(mv)
    return ExperimentRecord(plant.Ts, u, np.array(y), 1.0, RESTED, len(u), 5, 80.0, (), Excitation.RELAY)


def test_the_best_estimate_reaches_the_bound(plant: Plant, record: ExperimentRecord) -> None:
    random = np.random.default_rng(1)
    true = np.array([np.log(plant.Ts), plant.L / plant.Ts])
    found = []
    for _ in range(DRAWS):
        fit = Fit(replace(record, y=record.y + NOISE * random.standard_normal(len(record.y))))
        model = fit.model(fit.search(FIRST, UNDISTURBED, [true]))
        found.append(margins(replace(model, L=model.L + 0.5 * plant.Ts), GAINS).Ms)
    assert np.std(found) == pytest.approx(bound(record, plant, GAINS, NOISE), rel=0.3)


def test_the_bound_is_proportional_to_the_noise(plant: Plant, record: ExperimentRecord) -> None:
    assert bound(record, plant, GAINS, 2.0 * NOISE) == pytest.approx(2.0 * bound(record, plant, GAINS, NOISE))
