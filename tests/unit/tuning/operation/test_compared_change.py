"""Changes of normal operation compared with the model of accepted gains: linear plants, and others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from loopwright.tuning.models import TransferFunction
from loopwright.tuning.operation.accepted_model import AcceptedModel, driven
from loopwright.tuning.operation.change_findings import ChangeState, ComparedChange, DifferenceKind
from loopwright.tuning.operation.compared_change import AFTER, compare_change
from loopwright.tuning.operation.load_changes import load_changes
from loopwright.tuning.operation.model_conclusion import Conclusion, ModelState, conclusion_of
from tests.unit.tuning.operation.simulated import GAINS, MODEL, PLANT, PU, TS, operated, periods

EVERY = periods(13.0)
MOVES = {EVERY: 1.0, 2 * EVERY: -0.7, 3 * EVERY: 1.2}
WHOLE = 4 * EVERY


def compared(model: AcceptedModel = MODEL, **changed: object) -> list[ComparedChange]:
    """The three set-point changes."""
    stretch = operated(MOVES, WHOLE, **changed)  # type: ignore[arg-type]
    return [compare_change(model, stretch, move, move + periods(AFTER)) for move in stretch.moves]


def said(**changed: object) -> Conclusion:
    return conclusion_of(compared(**changed))


@pytest.mark.parametrize("seed", range(1, 6))
def test_the_right_model_is_confirmed(seed: int) -> None:
    changes = compared(seed=seed)
    assert {each.state for each in changes} == {ChangeState.CONFIRMED}
    assert [each.size for each in changes] == pytest.approx([1.0, 0.7, 1.2])
    assert all(0.6 < each.residual < 1.25 and not each.load for each in changes)
    assert conclusion_of(changes) == Conclusion(ModelState.CONFIRMED, 3)


def test_the_model_may_be_off_by_what_is_not_known_of_it() -> None:
    assert said(gain=lambda n: 1.04).state is ModelState.CONFIRMED
    assert said(dead_time_s=0.02 * PU).state is ModelState.CONFIRMED


@pytest.mark.parametrize("share", [0.43, 1.5, -0.23])
@pytest.mark.parametrize("later", [2.7, 4.1, 8.0])
def test_a_second_path_is_found_with_its_share_and_delay(share: float, later: float) -> None:
    found = said(share=share, later_s=later * PU)
    assert found.state is ModelState.MISMATCH and found.instead is not None
    assert found.instead.kind is DifferenceKind.SECOND_PATH and found.changes >= 2
    assert found.instead.size == pytest.approx(share, rel=0.1)
    assert found.instead.delay_s == pytest.approx(later * PU, rel=0.03)
    assert found.instead.Ms == pytest.approx(MODEL.Ms(share=share, path_s=later * PU), rel=0.15)
    assert found.instead.Ms > MODEL.Ms() + 0.2


@pytest.mark.parametrize("gain", [0.6, 1.4, 2.0])
def test_another_gain_is_found(gain: float) -> None:
    found = said(gain=lambda n: gain)
    assert found.state is ModelState.MISMATCH and found.instead is not None
    assert found.instead.kind is DifferenceKind.GAIN and found.instead.size == pytest.approx(gain - 1.0, abs=0.08)
    assert found.instead.Ms == pytest.approx(MODEL.Ms(gain=gain), rel=0.15)


def test_a_gain_that_drifts_is_found() -> None:
    found = said(gain=lambda n: 1.0 + 0.9 * n / WHOLE)
    assert found.state is ModelState.MISMATCH and found.instead is not None
    assert found.instead.kind is DifferenceKind.GAIN


@pytest.mark.parametrize("later", [0.12, 0.3])
def test_a_longer_dead_time_is_found(later: float) -> None:
    found = said(dead_time_s=later * PU)
    assert found.state is ModelState.MISMATCH and found.instead is not None
    assert found.instead.kind is DifferenceKind.DEAD_TIME and found.instead.size == pytest.approx(later * PU, rel=0.25)


def test_one_change_alone_disproves_nothing() -> None:
    """A load that steps some periods after the set-point looks like a second path."""
    changes = compared(load=lambda n: 0.25 if n >= EVERY + periods(4.0) else 0.0)
    assert changes[0].state is not ChangeState.CONFIRMED and changes[0].load
    assert conclusion_of(changes[:1]) == Conclusion(ModelState.OPEN, 0)
    assert conclusion_of(changes) == Conclusion(ModelState.CONFIRMED, 2)


def test_what_differs_last_is_not_called_confirmed() -> None:
    right, other = compared()[:2], compared(gain=lambda n: 1.5)
    assert conclusion_of([*right, other[2]]) == Conclusion(ModelState.OPEN, 2)
    assert conclusion_of([*right, *other[1:]]).state is ModelState.MISMATCH
    assert conclusion_of([right[0], other[1], right[1]]) == Conclusion(ModelState.CONFIRMED, 2)


def test_a_small_change_tells_nothing() -> None:
    stretch = operated({EVERY: 0.005}, 2 * EVERY)
    change = compare_change(MODEL, stretch, EVERY, EVERY + periods(AFTER))
    assert change.state is ChangeState.NOT_ENOUGH and conclusion_of([change]) == Conclusion(ModelState.OPEN, 0)


def test_what_was_never_moved_and_never_noisy_tells_nothing() -> None:
    stretch = operated({}, 2 * EVERY, noise=0.0)
    assert compare_change(MODEL, stretch, EVERY, EVERY + periods(AFTER)).state is ChangeState.NOT_ENOUGH


def test_a_load_confirms_and_never_disproves() -> None:
    def step(n: int) -> float:
        return 0.5 if n >= EVERY else 0.0

    def of(**changed: object) -> ComparedChange:
        stretch = operated({}, 3 * EVERY, load=step, **changed)  # type: ignore[arg-type]
        at, *_ = load_changes(stretch, PU)
        assert EVERY - periods(0.5) < at < EVERY + periods(1.0)
        return compare_change(MODEL, stretch, at, at + periods(AFTER), by_load=True)

    assert (of().size, of().load, of().residual < 1.3) == (0.0, True, True)
    assert of().state in (ChangeState.CONFIRMED, ChangeState.NOT_ENOUGH)
    assert of(share=0.43, later_s=4.0 * PU).state is not ChangeState.DIFFERS


def test_loads_are_not_seen_where_the_set_point_moves_or_nothing_does() -> None:
    assert load_changes(operated({}, 3 * EVERY), PU) == []
    assert load_changes(operated({periods(10.0): 1.0}, periods(17.0)), PU) == []


def test_with_the_covariance_of_the_model_only_what_is_not_known_is_left_open() -> None:
    """A gain that is known to 20 % explains one that is larger by 30 %; the dead time and the lags are known."""
    known = np.zeros((4, 4))
    known[0, 0] = (0.2 * PLANT.num[0] / PLANT.den[0]) ** 2
    monic = TransferFunction((PLANT.num[0] / 3.0,), (1.0, 4.0 / 3.0, 1.0 / 3.0), PLANT.L)
    open_ = replace(MODEL, plant=monic, covariance=known.tolist())
    sure = replace(MODEL, plant=monic, covariance=(1e-4 * known).tolist())
    assert all(each.state is not ChangeState.DIFFERS for each in compared(open_, gain=lambda n: 1.3))
    assert conclusion_of(compared(sure, gain=lambda n: 1.3)).state is ModelState.MISMATCH
    assert conclusion_of(compared(sure)).state is ModelState.CONFIRMED


def test_the_answer_of_a_plant_is_that_of_plantsim() -> None:
    stretch = operated({20: 1.0}, 400, noise=0.0)
    assert driven(PLANT, stretch.mv, TS) == pytest.approx(stretch.pv, abs=1e-9)
    lead = TransferFunction((0.5, 1.0), (2.0, 1.0), 0.25)
    u = np.ones(200)
    t = TS * np.arange(200) - lead.L
    step = np.where(t > 1e-9, 1.0 - 0.75 * np.exp(-np.maximum(t, 0.0) / 2.0), 0.0)
    assert driven(lead, u, TS)[4:] == pytest.approx(step[4:], abs=0.02)


def test_Ms_of_the_model_is_that_of_the_margins() -> None:
    from loopwright.tuning.analysis.margins import margins

    sampled = replace(PLANT, L=PLANT.L + 0.5 * TS)
    assert MODEL.Ms() == pytest.approx(margins(sampled, GAINS).Ms, abs=0.01)
    double = replace(sampled, num=(4.0,))
    assert MODEL.Ms(gain=2.0) == pytest.approx(margins(double, GAINS).Ms, abs=0.03)
