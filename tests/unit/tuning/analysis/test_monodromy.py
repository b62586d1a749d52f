"""Maps of one dead time against a stepwise simulation, closed forms, frequency integrals and the margins."""

from __future__ import annotations

import math

import numpy as np
import pytest

from loopwright.tuning.analysis.margins import margins, ultimate_point
from loopwright.tuning.analysis.monodromy import DeadTimeLoop
from loopwright.tuning.analysis.step_response import step_response
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, SOPDT, Integrating, Model, TransferFunction
from tests.unit.tuning.parseval import error_squares

PI_LOOPS: list[tuple[Model, Gains]] = [
    (TransferFunction((1.0,), (0.25, 1.0, 1.0), 1.0), Gains(0.508, 0.508 * 2.344)),
    (FOPDT(-2.0, 5.0, 1.0), Gains(0.8, 0.8 / 0.15)),
    (FOPDT(2.0, 0.01, 1.0), Gains(0.15, 0.5)),
    (SOPDT(1.0, 3.0, 0.3, 0.5), Gains(0.3, 3.0)),
    (TransferFunction((-0.1, 1.0), (1.0, 3.0, 3.0, 1.0), 0.05), Gains(1.0, 3.0)),
]


def one(value: float) -> np.ndarray:
    return np.array([value])


@pytest.mark.parametrize(("model", "gains"), PI_LOOPS)
def test_the_response_is_that_of_a_fine_simulation(model: Model, gains: Gains) -> None:
    loop = DeadTimeLoop(model)
    step = loop.maps(one(gains.Kp), one(gains.Kp / gains.Ti))[0]
    state = loop.start(one(gains.Kp))[0]
    at = np.linspace(0.0, 1.0, 9)
    fine = step_response(model, gains, horizon=20.0 * model.L, dt=model.L / 2000.0)
    for k in range(20):
        y = 1.0 - loop.values(at) @ state[loop.errors]
        assert y == pytest.approx(np.interp((k + at) * model.L, fine.t, fine.y), abs=1e-6)
        state = step @ state


def test_the_first_dead_times_in_closed_form() -> None:
    # P control of a lag: from L to 2L it answers a step of Kp, from 2L on also its own output, a ramped exponential
    K, T, L, Kp = 2.0, 5.0, 2.0, 0.8
    loop = DeadTimeLoop(FOPDT(K, T, L))
    step, state = loop.maps(one(Kp), one(0.0))[0], loop.start(one(Kp))[0]
    t = loop.at * L
    first = step @ state
    assert first[loop.errors] == pytest.approx(1.0 - K * Kp * (1.0 - np.exp(-t / T)), abs=1e-13)
    second = (step @ first)[loop.errors]
    rising = K * Kp * (1.0 - np.exp(-(t + L) / T))
    answer = (K * Kp) ** 2 * (1.0 - np.exp(-t / T) - t / T * np.exp(-t / T))
    assert second == pytest.approx(1.0 - rising + answer, abs=1e-13)


@pytest.mark.parametrize(("model", "gains"), PI_LOOPS)
def test_squares_by_parseval(model: Model, gains: Gains) -> None:
    loop = DeadTimeLoop(model)
    maps = loop.maps(one(gains.Kp), one(gains.Kp / gains.Ti))
    e2, rate2 = loop.squares(maps, loop.start(one(gains.Kp)))
    lag = min(abs(1.0 / p) for p in np.roots(model.den))
    expected = error_squares(model, gains, 1e-4, 3e3 / min(lag, model.L))
    assert e2[0] == pytest.approx(expected[0], rel=1e-5)
    # a first-order lag lets the rate fall as 1/w only: what is above the last frequency is left out
    assert rate2[0] == pytest.approx(expected[1], rel=1e-3)


@pytest.mark.parametrize("model", [SOPDT(2.0, 3.0, 0.7, 1.0), Integrating(-0.1, 2.0, 3.0)])
def test_a_pid_with_ideal_derivative_by_parseval(model: Model) -> None:
    Kp, Ki, Kd = (0.8, 0.15, 1.2) if isinstance(model, SOPDT) else (2.0, 0.1, 3.0)
    loop = DeadTimeLoop(model)
    maps, start = loop.maps(one(Kp), one(Ki), one(Kd)), loop.start(one(Kp), one(Kd))
    e2, rate2 = loop.squares(maps, start)
    expected = error_squares(model, Gains(Kp, Kp / Ki, Kd / Kp), 1e-4, 3e3)
    assert e2[0] == pytest.approx(expected[0], rel=1e-5)
    assert rate2[0] == pytest.approx(expected[1], rel=1e-3)


@pytest.mark.parametrize(("model", "gains"), PI_LOOPS)
def test_roots_solve_the_characteristic_equation(model: Model, gains: Gains) -> None:
    loop = DeadTimeLoop(model)
    # a root may be a whole turn (in one dead time) away from the one shown
    turns = 2j * np.pi / model.L * np.arange(-2, 3)[:, None]
    s = loop.roots(loop.maps(one(gains.Kp), one(gains.Kp / gains.Ti)))[0, :3] + turns
    sign = math.copysign(1.0, model.static_gain)
    plant = sign * np.polyval(model.num, s) / np.polyval(model.den, s) * np.exp(-model.L * s)
    missing = np.abs(1.0 + plant * gains.Kp * (1.0 + 1.0 / (gains.Ti * s)))
    assert missing.min(axis=0) == pytest.approx(np.zeros(3), abs=1e-6)


@pytest.mark.parametrize("model", [FOPDT(2.0, 5.0, 0.05), FOPDT(2.0, 5.0, 5.0), SOPDT(-1.0, 3.0, 0.3, 0.5)])
def test_the_ultimate_gain_is_where_the_loop_turns_unstable(model: Model) -> None:
    Ku, Pu = ultimate_point(model)
    loop = DeadTimeLoop(model)
    # integral action so slow that it hardly moves the oscillation
    Ki = one(1e-5 * Ku / Pu)
    rightmost = loop.roots(loop.maps(one(Ku), Ki))[0, 0]
    assert abs(rightmost.imag) == pytest.approx(2.0 * math.pi / Pu, rel=1e-4)
    assert loop.roots(loop.maps(one(0.999 * Ku), Ki))[0, 0].real < 0.0
    assert loop.roots(loop.maps(one(1.001 * Ku), Ki))[0, 0].real > 0.0


def test_stability_agrees_with_nyquist() -> None:
    model = FOPDT(1.5, 2.0, 1.0)
    rng = np.random.default_rng(3)
    Kp, Ti = rng.uniform(0.1, 4.0, 60), rng.uniform(0.3, 6.0, 60)
    loop = DeadTimeLoop(model)
    ours = loop.roots(loop.maps(Kp, Kp / Ti))[:, 0].real < 0.0
    theirs = np.array([margins(model, Gains(a, b)).stable for a, b in zip(Kp, Ti, strict=True)])
    assert 10 < theirs.sum() < 50
    assert np.array_equal(ours, theirs)


def test_many_controllers_at_once_are_each_alone() -> None:
    loop = DeadTimeLoop(FOPDT(1.5, 2.0, 1.0))
    Kp, Ki = np.array([0.2, 0.7]), np.array([0.1, 0.3])
    e2, rate2 = loop.squares(loop.maps(Kp, Ki), loop.start(Kp))
    for i in range(2):
        alone = loop.squares(loop.maps(Kp[i : i + 1], Ki[i : i + 1]), loop.start(Kp[i : i + 1]))
        assert (e2[i], rate2[i]) == pytest.approx((alone[0][0], alone[1][0]), rel=1e-12)


def test_needs_a_dead_time() -> None:
    with pytest.raises(ValueError, match="dead time"):
        DeadTimeLoop(FOPDT(1.0, 2.0, 0.0))
