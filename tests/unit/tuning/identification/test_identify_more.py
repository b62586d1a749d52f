"""More than lags, and loads, in records simulated by scipy twenty times as finely as they are sampled."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import cont2discrete, lfilter

from loopwright.controller.channel import Channel, Mode, Parameters, Settings
from loopwright.plantsim.plant import LinearPlant
from loopwright.tuning.identification.feedback_test import follows_from_pv
from loopwright.tuning.identification.identify import Identified, identify
from loopwright.tuning.models import FOPDT, SOPDT, Integrating, TransferFunction
from tests.unit.tuning import recordings

Reals = NDArray[np.float64]
FINE, TS, FIRST_MOVE = 20, 0.1, 50
LOAD, LOAD_AT = 0.3, 0.6
"""MV units; part of the record."""


@dataclass(frozen=True, slots=True)
class Plant:
    """num, den end in the static gain and 1 (of an integrating plant: in its slope and 1, 0).  L: s."""

    num: tuple[float, ...]
    den: tuple[float, ...]
    L: float

    def answer(self, u: Reals, load: Reals | None = None) -> Reals:
        """PV at the samples; load: at the plant's input, on the fine grid."""
        fine = np.repeat(u, FINE) + (0.0 if load is None else load)
        num, den, _ = cont2discrete((list(self.num), list(self.den)), TS / FINE, "zoh")
        delay = round(self.L * FINE / TS)
        return np.concatenate((np.zeros(delay), lfilter(np.ravel(num), den, fine)))[: len(fine) : FINE]


ZERO = Plant((30.0, 2.0), (50.0, 15.0, 1.0), 1.045)
INVERSE = Plant((-2.0, 1.0), (20.0, 9.0, 1.0), 1.005)
OSCILLATES = Plant((-1.5, 1.0), (9.0, 1.8, 1.0), 1.77)
THREE_LAGS = Plant((1.0,), (60.0, 47.0, 12.0, 1.0), 0.52)
FED = Plant((3.0, 2.0), (10.0, 1.0), 1.005)
INTEGRATES_INVERSELY = Plant((-0.2, 0.1), (3.0, 1.0, 0.0), 1.0)
PLANTS = {
    "zero": ZERO,
    "inverse": INVERSE,
    "oscillates": OSCILLATES,
    "three lags": THREE_LAGS,
    "integrates inversely": INTEGRATES_INVERSELY,
}
FIRST = Plant((2.0,), (10.0, 1.0), 2.03)
SECOND = Plant((1.0,), (9.0, 1.8, 1.0), 1.77)
INTEGRATES = Plant((0.1,), (1.0, 0.0), 1.23)


def moves(samples: int = 600, held: int = 60, seed: int = 1) -> Reals:
    return recordings.moves(samples, held, seed)


def record(
    plant: Plant, u: Reals, noise: float = 0.0, seed: int = 1, load: float = 0.0, at: float = LOAD_AT
) -> tuple[Reals, Reals, Reals]:
    """noise: of PV's span.  load: MV units, from this part of the record on."""
    fine = np.where(np.arange(len(u) * FINE) >= at * len(u) * FINE, load, 0.0)
    y = plant.answer(u, fine)
    y = y + noise * np.ptp(y) * np.random.default_rng(seed).normal(size=len(y))
    return TS * np.arange(len(u)), u + 30.0, y + 50.0


def error_near_the_corner(found: Identified, plant: Plant) -> float:
    """The largest relative error of the frequency response between half and twice the corner of the poles (or 1/L)."""
    corner = float(np.mean([abs(p) for p in np.roots(plant.den) if p != 0.0] or [1.0 / plant.L]))
    w = corner * np.geomspace(0.5, 2.0, 15)
    true = TransferFunction(plant.num, plant.den, plant.L).frequency_response(w)
    return float(np.max(np.abs(found.model.frequency_response(w) / true - 1.0)))


@pytest.mark.parametrize("name", PLANTS)
def test_without_noise_the_plant_is_found(name: str) -> None:
    plant = PLANTS[name]
    found = identify(*record(plant, moves()))
    model = found.model
    assert isinstance(model, TransferFunction) and found.explained and not found.loads
    assert model.num == pytest.approx(plant.num, rel=1e-3)
    assert model.den == pytest.approx(plant.den, rel=1e-3)
    assert pytest.approx(plant.L, abs=1e-3) == model.L


@pytest.mark.parametrize("noise", [0.01, 0.02])
@pytest.mark.parametrize("name", ["zero", "inverse", "oscillates", "integrates inversely"])
def test_with_noise_it_is_within_its_standard_errors(name: str, noise: float) -> None:
    plant = PLANTS[name]
    found = identify(*record(plant, moves(), noise, seed=3))
    assert found.explained and not found.loads and not found.drift
    assert error_near_the_corner(found, plant) < 0.1
    true = (*plant.num, *(c for c in plant.den if c not in (0.0, 1.0)), plant.L)
    if len(true) == len(found.parameters):
        for value, expected, error in zip(found.parameters.values(), true, found.standard_errors.values(), strict=True):
            assert abs(value - expected) < 4.0 * error, found.model
    else:
        assert any("nearly as well" in note and "with zero" in note for note in found.notes)


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.02])
def test_a_part_that_passes_at_once_is_found(noise: float) -> None:
    found = identify(*record(FED, moves(), noise))
    model = found.model
    assert isinstance(model, TransferFunction)
    # where between two samples the jump comes is not to be seen
    assert abs(model.L - FED.L) < TS
    assert model.num[-1] == pytest.approx(2.0, rel=0.02)
    assert error_near_the_corner(found, FED) < 0.02
    if noise:
        # or a lag far shorter than a sample, which looks the same
        assert any("feed-through" in note for note in found.notes)
    else:
        assert model.num[0] / model.den[0] == pytest.approx(0.3, rel=0.05)


@pytest.mark.parametrize("how", ["step", "moves"])
@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("plant", [FIRST, SECOND, INTEGRATES, INVERSE])
def test_a_step_of_the_load_is_found_within_ten_percent(plant: Plant, noise: float, how: str) -> None:
    u = moves(held=50) if how == "moves" else recordings.step()
    found = identify(*record(plant, u, noise, load=LOAD))
    assert found.explained
    (load,) = found.loads
    assert load.t_s == pytest.approx(LOAD_AT * 60.0, rel=0.1)
    assert load.size == pytest.approx(LOAD, rel=0.1)
    assert any("load disturbance" in note for note in found.notes)
    assert error_near_the_corner(found, plant) < 0.1
    kind = {FIRST: FOPDT, SECOND: SOPDT, INTEGRATES: Integrating}.get(plant, TransferFunction)
    assert isinstance(found.model, kind)


def test_a_load_is_told_in_the_time_and_the_units_of_the_record() -> None:
    t, u, y = record(FIRST, recordings.step(), 0.01, load=LOAD)
    found = identify(60.0 * t + 1e3, -4.0 * u + 7.0, y)
    (load,) = found.loads
    assert load.t_s == pytest.approx(1e3 + 60.0 * 36.0, abs=60.0)
    assert load.seen_s - load.t_s == pytest.approx(60.0 * FIRST.L, rel=0.1)
    assert load.size == pytest.approx(-4.0 * LOAD, rel=0.1)


def test_standard_errors_are_the_scatter_over_many_records() -> None:
    scatter = []
    for seed in range(14):
        found = identify(*record(INVERSE, moves(400, 40), 0.01, seed))
        if len(found.parameters) == 5:
            true = np.array((*INVERSE.num, *INVERSE.den[:2], INVERSE.L))
            at = np.array(list(found.parameters.values()))
            scatter.append((at - true) / np.array(list(found.standard_errors.values())))
            assert np.sqrt(np.diag(found.covariance)) == pytest.approx(np.array(list(found.standard_errors.values())))
    assert len(scatter) >= 10
    assert np.std(scatter, axis=0) == pytest.approx(1.0, abs=0.45)
    assert np.abs(np.mean(scatter, axis=0)).max() < 0.75


def test_the_covariance_is_that_of_the_scatter() -> None:
    values, covariances = [], []
    for seed in range(30):
        found = identify(*record(FIRST, moves(300, 30), 0.01, seed))
        if isinstance(found.model, FOPDT) and not found.loads:
            values.append(list(found.parameters.values()))
            covariances.append(found.covariance)
    assert len(values) >= 27
    mean = np.mean(covariances, axis=0)
    spread = np.sqrt(np.diag(mean))
    assert np.cov(np.array(values).T) / np.outer(spread, spread) == pytest.approx(
        mean / np.outer(spread, spread), abs=0.6
    )


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("plant", [FIRST, SECOND, INTEGRATES])
def test_lags_stay_lags_and_no_load_is_told_of(plant: Plant, seed: int) -> None:
    found = identify(*record(plant, moves(seed=seed + 1), 0.02, seed))
    assert not isinstance(found.model, TransferFunction)
    assert not found.loads and not found.drift


def test_coloured_noise_is_no_load_and_no_zero() -> None:
    t, u, y = record(FIRST, recordings.step())
    for seed in range(3):
        white = np.random.default_rng(seed).normal(scale=0.012, size=len(y) + 50)
        found = identify(t, u, y + lfilter([1.0], [1.0, -0.8], white)[50:])
        assert not isinstance(found.model, TransferFunction) and not found.loads and not found.drift


def test_a_load_that_comes_with_the_only_move_is_not_told_of() -> None:
    found = identify(*record(INVERSE, recordings.step(), 0.01, load=LOAD, at=(FIRST_MOVE + 5) / 600))
    assert not found.loads


def slow_heater(how: str, rest_of: str, noise: float, seed: int) -> tuple[Reals, Reals, Reals]:
    """A heater of K 2, T 320 s and L 110 s, moved by 86 %, and a tenth of PV that comes slowly.

    how: at once, in five parts, or in two moves. rest_of: surroundings that warm up, or a slow and a quick part.
    """
    t = 45.0 * np.arange(64)
    starts = {"at once": [9], "in five parts": [9, 10, 11, 12, 13], "in two moves": [9, 36]}[how]
    u, y, span = np.zeros(64), np.zeros(64), 2.0 * 86.0
    for start in starts:
        u[start:] += 86.0 / len(starts)
        after = np.maximum(t - t[start] - 110.0, 0.0)
        y += span / len(starts) * (1.0 - np.exp(-after / 320.0))
        if rest_of == "slow and quick parts":
            slow = (1.0 - np.exp(-after / 1280.0)) + 0.5 * (1.0 - np.exp(-after / 32.0))
            y -= 0.12 * span / len(starts) * slow
    if rest_of == "surroundings":
        y += 0.12 * span * (t / t[-1]) ** 2
    return t, u, 20.0 + y + noise * span * np.random.default_rng(seed).normal(size=64)


@pytest.mark.parametrize("how", ["at once", "in five parts", "in two moves"])
@pytest.mark.parametrize(
    ("rest_of", "noise", "seed"),
    [
        ("surroundings", 0.002, 0),
        ("surroundings", 0.008, 0),
        ("slow and quick parts", 0.002, 0),
    ],
)
def test_a_load_that_undoes_a_move_is_no_answer(how: str, rest_of: str, noise: float, seed: int) -> None:
    """Moved at once, the three were explained by a load of -81 to -86 % and gains of 40 to 800,000."""
    found = identify(*slow_heater(how, rest_of, noise, seed))
    assert all(abs(load.size) < 0.25 * 86.0 for load in found.loads)
    gain = float(found.model.frequency_response(np.array([1e-9]))[0].real)
    in_the_end = 2.0 * (1.12 if rest_of == "surroundings" else 1.0 - 1.5 * 0.12)
    assert gain == pytest.approx(in_the_end, rel=0.15) or not found.explained


@pytest.mark.parametrize(("rest", "noise", "told"), [(150, 0.005, True), (10, 0.03, False)])
def test_a_drift_is_told_of_where_pv_at_rest_shows_it(rest: int, noise: float, told: bool) -> None:
    t, u, y = record(FIRST, np.where(np.arange(600) < rest, 0.0, 1.0), noise)
    assert identify(t, u, y + 0.02 * t).drift is told


def test_ten_thousand_samples_take_seconds_and_averages_do_not_decide() -> None:
    made = record(FIRST, recordings.step(10_000), 0.01, seed=4, load=LOAD)
    start = time.process_time()
    found = identify(*made)
    assert time.process_time() - start < 20.0
    assert isinstance(found.model, FOPDT)
    (load,) = found.loads
    assert load.t_s == pytest.approx(600.0, abs=1.0) and load.size == pytest.approx(LOAD, rel=0.01)


@pytest.mark.parametrize("moved", [False, True])
def test_a_loop_in_plain_operation_is_no_test_of_its_plant(moved: bool) -> None:
    """PI on a first-order plant under a coloured load; then the set-point steps, which tells them apart."""
    random = np.random.default_rng(1)
    load = lfilter([0.3], [1.0, -0.95], random.normal(size=1500))
    settings = Settings(mv_low=-1e3, mv_high=1e3, reverse=True)
    channel = Channel(TS, settings, Parameters(2.0, 3.0), 0.0, int(Mode.AUTOMATIC), 0.0)
    plant = LinearPlant([2.0], [10.0, 1.0], 0.5, TS)
    u, y = [], []
    for k in range(1500):
        channel.setpoint = 10.0 if moved and k > 300 else 0.0
        plant.disturbance = float(load[k])
        y.append(plant.pv)
        u.append(channel.step(y[-1]))
        plant.step(u[-1])
    found = identify(TS * np.arange(1500), u, y)
    assert any("follows from PV alone" in note for note in found.notes) is not moved
    assert moved or not found.explained


def test_a_short_record_whose_only_moves_come_first_is_no_feedback() -> None:
    """Few samples have many values of MV for their number."""
    u = np.array([0.0, 1.0, *18 * [2.0]])
    assert not follows_from_pv(u, np.cumsum(u))
