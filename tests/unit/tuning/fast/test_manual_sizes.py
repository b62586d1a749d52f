"""The sizes of pulses of the manual output, and whether a plant comes to rest: against the devices' own simulator."""

from __future__ import annotations

import math

import numpy as np
import pytest

from loopwright.plantsim.plant import LinearPlant
from loopwright.tuning.experiments.primitives import Directions, Facts, OperatingPoint
from loopwright.tuning.fast.manual.self_regulation import comes_to_rest
from loopwright.tuning.fast.manual.sizes import (
    GROWTH,
    MAY_USE,
    OF_ROOM,
    ManualRecord,
    first_pulse,
    largest_pulse,
    next_pulse,
    pv_bounds,
)
from loopwright.tuning.fast.pulses.levels import PulseBounds
from loopwright.tuning.fast.record import Excitation, ExperimentRecord
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Reals

RESTED, TS, NOISE = 130, 0.1, 0.005
LAG, INTEGRATOR = ((1.0,), (10.0, 1.0), 2.0), ((0.1,), (1.0, 0.0), 2.0)
UNSTABLE = ((1.0,), (10.0, -1.0), 2.0)
Plant = tuple[tuple[float, ...], tuple[float, ...], float]


def after_pulses(
    plant: Plant, pulses: list[tuple[int, int, float]], samples: int, load: float = 0.0, load_at: int = 0
) -> tuple[Reals, Reals]:
    """MV and PV from rest. pulses: the first sample, the length in samples and the size of each, after the rest."""
    process = LinearPlant(*plant, TS, noise_std=NOISE, seed=1)
    u = np.zeros(RESTED + samples)
    for begun, width, size in pulses:
        u[RESTED + begun : RESTED + begun + width] += size
    y = np.empty(len(u))
    for k, mv in enumerate(u):
        y[k] = process.pv
        if load and k == RESTED + load_at:
            process.disturbance = load
        process.step(float(mv))
    return u, y


def test_the_largest_pulse_keeps_off_the_limits_and_within_the_largest_jump() -> None:
    assert largest_pulse(70.0, 0.0, 100.0, math.inf, None) == OF_ROOM * 30.0
    assert largest_pulse(70.0, 0.0, 100.0, math.inf, -1.0) == OF_ROOM * 70.0
    assert largest_pulse(70.0, 0.0, 100.0, 8.0, None) == 8.0
    assert largest_pulse(100.0, 0.0, 100.0, 8.0, 1.0) == 0.0


def test_the_first_pulse_is_what_the_present_gains_make_of_the_permitted_step() -> None:
    assert first_pulse(3.0, 20.0) == 3.0
    assert first_pulse(300.0, 20.0) == 10.0
    assert 0.0 < first_pulse(0.0, 20.0) < 10.0


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_next_pulse_takes_PV_as_far_as_it_may_go(side: float) -> None:
    """The true plant under it, without noise: PV comes to 0.8 of the bounds, up to what the first pulse tells."""
    width = 35
    u, y = after_pulses(LAG, [(0, 40, 0.5)], 150)
    bounds = PulseBounds(-1.0, 1.0, NOISE)
    size = next_pulse(ManualRecord(TS, u, y, RESTED, 1.0), side, width, bounds, 2.0, 100.0)
    _, then = after_pulses(LAG, [(0, 40, 0.5), (150, width, side * size)], 400)
    assert np.max(side * then[RESTED + 150 :]) == pytest.approx(MAY_USE, abs=0.06)


def test_the_next_pulse_grows_by_a_factor_at_most_and_waits_for_PV() -> None:
    u, y = after_pulses(LAG, [(0, 40, 0.5)], 150)
    wide, narrow = PulseBounds(-1e3, 1e3, NOISE), PulseBounds(-0.05, 0.05, NOISE)
    past = ManualRecord(TS, u, y, RESTED, 1.0)
    assert next_pulse(past, 1.0, 35, wide, 0.5, 100.0) == GROWTH * 0.5
    assert next_pulse(past, 1.0, 35, wide, 0.5, 0.8) == 0.8
    assert next_pulse(past, 1.0, 35, narrow, 0.5, 100.0) == 0.0


def test_PV_may_go_to_its_limits_and_hardly_to_a_side_that_is_not_permitted() -> None:
    point = OperatingPoint(0.0, 50.0, 50.0, NOISE, 10.0)
    facts = {"sample_time_s": TS, "T95_s": 30.0, "mv_low": 0.0, "mv_high": 100.0, "sp_deviation": 2.0}
    both = Facts(**facts, previous_gains=Gains(1.0, 1.0), pv_low=49.0, pv_high=60.0)  # type: ignore[arg-type]
    up = Facts(**facts, previous_gains=Gains(1.0, 1.0), directions=Directions.UP)  # type: ignore[arg-type]
    assert pv_bounds(both, point, NOISE, 0.5) == PulseBounds(-1.0, 2.0, NOISE)
    assert pv_bounds(up, point, NOISE, 0.5) == PulseBounds(-1.0, 2.0, NOISE)


class TestComesToRest:
    def record(self, plant: Plant, load: float = 0.0, load_at: int = 0) -> ExperimentRecord:
        u, y = after_pulses(plant, [(0, 40, 0.5)], 600, load, load_at)
        return ExperimentRecord(TS, u, y, 1.0, RESTED, len(u), 1, 8.0, excitation=Excitation.MANUAL)

    @pytest.mark.parametrize("load_at", [10, 60, 200])
    @pytest.mark.parametrize("load", [0.0, 0.15, -0.15, 0.4])
    def test_a_lag_does_with_and_without_a_load(self, load: float, load_at: int) -> None:
        assert comes_to_rest(self.record(LAG, load, load_at))

    @pytest.mark.parametrize("load_at", [10, 60, 200])
    @pytest.mark.parametrize("load", [0.0, 0.05, -0.05])
    def test_an_integrator_does_not(self, load: float, load_at: int) -> None:
        assert not comes_to_rest(self.record(INTEGRATOR, load, load_at))

    def test_an_unstable_plant_does_not(self) -> None:
        assert not comes_to_rest(self.record(UNSTABLE))
