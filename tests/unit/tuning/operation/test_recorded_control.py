"""Who moved MV of a record: a controller, or a hand, a relay, a sequence."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from loopwright.controller.channel import Channel, Settings
from loopwright.controller.pid import Parameters
from loopwright.tuning.operation.recorded_control import RecordedControl, recorded_control
from loopwright.tuning.plan import Mode
from tests.unit.tuning import recordings
from tests.unit.tuning.recordings import FIRST_ORDER, INTEGRATES_WITH_LAG, MV, NEGATIVE, PV, TWO_LAGS, Loop, Reals

TS, SAMPLES = 0.2, 1200
LOOPS = [FIRST_ORDER, TWO_LAGS, INTEGRATES_WITH_LAG, NEGATIVE]


def operated(loop: Loop, moves: dict[int, float], Td: float = 0.0, b: float = 1.0) -> tuple[Reals, Reals, Reals]:
    """(mv, pv, sp) of a loop in automatic under noise and a load that wanders."""
    random = np.random.default_rng(3)
    load = 0.1 * lfilter([1.0], [1.0, -0.98], random.standard_normal(SAMPLES))
    plant = loop.plant(TS, 0.01, 2)
    settings = Settings(mv_low=-1e3, mv_high=1e3, reverse=loop is not NEGATIVE)
    parameters = Parameters(loop.Kp, loop.Ti, Td, Td / 10.0, b)
    channel = Channel(TS, settings, parameters, PV, int(Mode.AUTOMATIC), MV)
    mv, pv, sp = [], [], []
    for k in range(SAMPLES):
        channel.setpoint += moves.get(k, 0.0)
        plant.disturbance = float(load[k])
        pv.append(plant.pv)
        mv.append(channel.step(pv[-1]))
        sp.append(channel.setpoint)
        plant.step(mv[-1])
    return np.array(mv), np.array(pv), np.array(sp)


def certain(found: RecordedControl | None) -> bool:
    return found is not None and found.certain


@pytest.mark.parametrize("loop", LOOPS)
@pytest.mark.parametrize("b", [1.0, 0.6, 0.0])
def test_the_gains_are_those_of_the_controller(loop: Loop, b: float) -> None:
    mv, pv, sp = operated(loop, {200: 1.0, 600: -0.5}, b=b)
    found = recorded_control(TS, mv, pv, sp)
    assert found is not None and found.certain and found.setpoint_moves == 2 and found.gains is not None
    assert found.gains.Kp == pytest.approx(loop.Kp, rel=1e-3)
    assert found.gains.Ti == pytest.approx(loop.Ti, rel=1e-3)
    assert found.gains.b == pytest.approx(b, abs=1e-3) and found.part > 0.999


def test_gains_beside_a_derivative_are_not_named() -> None:
    found = recorded_control(TS, *operated(FIRST_ORDER, {200: 1.0}, Td=0.5))
    assert found is not None and found.certain and found.gains is None


@pytest.mark.parametrize("loop", LOOPS)
@pytest.mark.parametrize("moves", [{}, {200: 1.0, 600: -0.5}])
def test_a_file_without_the_set_point_shows_the_controller_as_well(loop: Loop, moves: dict[int, float]) -> None:
    mv, pv, _ = operated(loop, moves)
    found = recorded_control(TS, mv, pv, None)
    assert found is not None and found.setpoint_moves is None and found.gains is None
    assert found.certain


@pytest.mark.parametrize("every", [2, 5])
def test_a_record_of_every_other_sample_and_coarse_values_is_one_in_automatic(every: int) -> None:
    mv, pv, sp = operated(FIRST_ORDER, {200: 1.0, 600: -0.5})
    assert certain(recorded_control(every * TS, np.round(mv, 2)[::every], np.round(pv, 2)[::every], sp[::every]))


def test_values_that_are_stored_by_exception_are_a_staircase_in_automatic() -> None:
    mv, pv, sp = operated(FIRST_ORDER, {200: 1.0, 600: -0.5})
    stored = mv.copy()
    for k in range(1, len(mv)):
        stored[k] = mv[k] if abs(mv[k] - stored[k - 1]) > 0.1 else stored[k - 1]
    assert np.mean(np.diff(stored) == 0.0) > 0.5
    assert certain(recorded_control(TS, stored, pv, sp))


@pytest.mark.parametrize("loop", LOOPS)
@pytest.mark.parametrize("moved", ["steps", "sequence", "relay"])
@pytest.mark.parametrize("setpoint", ["none", "rests", "moves", "tracks"])
def test_mv_under_a_hand_a_sequence_or_a_relay(loop: Loop, moved: str, setpoint: str) -> None:
    if moved == "relay":
        _, mv, pv = recordings.closed_loop(loop, relay=True, Ts=TS, samples=SAMPLES)
    else:
        change = recordings.step(SAMPLES) if moved == "steps" else recordings.moves(SAMPLES)
        _, mv, pv = recordings.open_loop(loop, change, Ts=TS, noise=0.01)
    rests = np.full(SAMPLES, PV)
    moves = np.where(np.arange(SAMPLES) < 300, PV, PV + 1.0)
    sp = {"none": None, "rests": rests, "moves": moves, "tracks": pv}[setpoint]
    assert recorded_control(TS, mv, pv, sp) is None


def test_a_test_signal_of_many_values_is_not_certain() -> None:
    change = np.repeat(np.random.default_rng(1).normal(size=SAMPLES // 5), 5)
    _, mv, pv = recordings.open_loop(FIRST_ORDER, change, Ts=TS, noise=0.01)
    found = recorded_control(TS, mv, pv, None)
    assert found is not None and not found.certain


@pytest.mark.parametrize("samples", [2, 19])
def test_a_short_record_tells_nothing(samples: int) -> None:
    random = np.random.default_rng(1)
    assert recorded_control(TS, random.normal(size=samples), random.normal(size=samples), None) is None
    assert recorded_control(TS, np.ones(100), random.normal(size=100), None) is None
    assert recorded_control(TS, random.normal(size=100), np.ones(100), None) is None
