"""Rows of the history become stretches: what is left out, where they end, and what means over bins leave as it was."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.service.listening.bins import GAP_BEFORE, SAMPLE, Bins, Rows, merged, of_samples
from loopwright.service.observing.resolution import FIRST_S, resolution, wall_period_s
from loopwright.service.observing.stretches import heard_stretches
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.gains import Gains
from loopwright.tuning.operation.observation import observe
from tests.unit.service.observing.operated import Operated

ONE, OTHER = (1.5, 6.0, 0.0, 0.0, 1.0, 0.0), (2.0, 6.0, 0.0, 0.0, 1.0, 0.0)


def rows(count: int) -> Bins:
    samples = np.zeros(count, SAMPLE)
    samples["at_s"] = 1000.0 + 0.1 * np.arange(count)
    samples["n"] = 1 + np.arange(count)
    samples["pv"], samples["mv"], samples["sp"] = 50.0, 40.0, 50.0
    samples["gains"], samples["mode"] = 1, 2
    return samples


def lengths(samples: Bins, together: int = 1, tests: tuple[tuple[float, float], ...] = ()) -> list[int]:
    found = heard_stretches(Rows(of_samples(samples), (ONE, OTHER)), 0.1, together, tests)
    return [len(each.stretch.sp) for each in found]


def test_a_stretch_ends_where_what_is_needed_is_not_known() -> None:
    assert lengths(rows(100)) == [100]
    assert lengths(rows(0)) == []
    for name, value in (("mode", 1), ("mode", -1), ("mode", 3), ("gains", 0), ("sp", np.nan), ("pv", np.nan)):
        samples = rows(100)
        samples[name][40:45] = value
        assert lengths(samples) == [40, 55], (name, value)


def test_a_stretch_ends_at_a_gap_at_other_gains_and_at_a_test() -> None:
    samples = rows(100)
    samples["n"][60:] += 1
    assert lengths(samples) == [60, 40], "a sample is missing"
    samples = rows(100)
    samples["gap"][30] = GAP_BEFORE
    assert lengths(samples) == [30, 70]
    samples = rows(100)
    samples["gains"][70:] = 2
    found = heard_stretches(Rows(of_samples(samples), (ONE, OTHER)), 0.1)
    assert [each.stretch.gains for each in found] == [Gains(*ONE), Gains(*OTHER)]
    assert lengths(rows(100), tests=((1002.0, 1003.0),)) == [20, 69]
    assert lengths(rows(100)[[0, 2, 4]]) == [], "a single sample is no stretch"


def test_numbers_that_begin_again_are_no_gap() -> None:
    samples = rows(10)
    samples["n"] = [0xFFFFFFFC, 0xFFFFFFFD, 0xFFFFFFFE, 0xFFFFFFFF, 1, 2, 3, 4, 5, 6]
    assert lengths(samples) == [10]


def test_a_set_point_change_stands_where_it_was_in_bins_too() -> None:
    samples = rows(400)
    samples["sp"][217:] = 51.0
    bins = merged(of_samples(samples), range(0, 400, 10))
    found = heard_stretches(Rows(bins, (ONE,)), 0.1, 10)
    (move,) = found[0].stretch.moves
    assert found[0].at_s[move] == pytest.approx(1000.0 + 21.0) and found[0].stretch.Ts == pytest.approx(1.0)
    raw = heard_stretches(Rows(of_samples(samples), (ONE,)), 0.1)
    assert raw[0].at_s[raw[0].stretch.moves[0]] == pytest.approx(1000.0 + 21.7)


@pytest.mark.parametrize("together", [1, 4, 10])
def test_the_dead_time_is_found_from_samples_and_from_bins(together: int) -> None:
    """Bins of wall time have a sample more or less now and then; MV of a bin that was held late would take half a bin
    away from the dead time, 0.5 s of 1 s for ten samples."""
    loop = Operated()
    moves = {800: 1.0, 1600: -1.0, 2400: 0.7, 3200: 0.6}
    rings = loop.heard(moves, 4000, 1000.0, noise=0.01)
    bins = rings.rows(600.0, 1000.0, 10_000).bins
    cut = np.arange(0, len(bins), together)
    cut[1:] += np.random.default_rng(1).integers(-1, 2, len(cut) - 1) if together > 4 else 0
    found = heard_stretches(Rows(merged(bins, cut), (ONE,)), loop.Ts, together)
    observation = observe([each.stretch for each in found], True, DesignSpec())
    assert observation.evaluation is not None and len(observation.used) == 4, observation.detail
    model = observation.evaluation.model
    late = np.angle(model.frequency_response(np.array([0.7]))) - np.angle(
        Operated(Ts=0.0).plant.frequency_response(np.array([0.7]))
    )
    assert float(np.abs(late / 0.7)[0]) < 0.06, "the delay around the ultimate period is right to 0.06 s"


def test_what_is_read_reaches_back_far_enough_and_is_fine_enough() -> None:
    assert wall_period_s(of_samples(rows(50))) == pytest.approx(0.1)
    assert wall_period_s(of_samples(rows(1))) is None

    def back_s(period_s: float, samples_in_t95: float) -> tuple[float, int]:
        samples = rows(20_000)
        samples["at_s"] = period_s * np.arange(20_000)
        found = resolution(of_samples(samples), samples_in_t95)
        assert found is not None
        return float(samples["at_s"][-1]) - found.from_s, found.together

    assert back_s(0.1, 90.0) == (pytest.approx(1140.0, abs=0.2), 1)  # T95 9 s: samples
    assert back_s(0.1, 2_000.0) == (pytest.approx(7.6 * 3600.0, rel=0.01), 40)  # T95 200 s: bins of 4 s, a fiftieth
    assert back_s(0.1, 20_000.0) == (pytest.approx(22.8 * 3600.0, rel=0.01), 320)  # 8 h are 14 T95: bins of 32 s
    assert back_s(5.0, 400.0) == (pytest.approx(22.8 * 3600.0, rel=0.01), 6), "a bin of 32 s has 6 samples or 7"
    assert back_s(5.0, 100.0)[1] == 1
    assert resolution(of_samples(rows(0)), 90.0) is None


@pytest.mark.parametrize(("period_s", "back_h"), [(0.1, 0.3167), (1.0, 3.167), (5.0, 15.83), (30.0, 95.0)])
def test_slow_samples_are_looked_at_beyond_the_time_that_is_read_first(period_s: float, back_h: float) -> None:
    samples = rows(20_000)
    samples["at_s"] = period_s * np.arange(20_000)
    now_s = float(samples["at_s"][-1])
    found = resolution(of_samples(samples[samples["at_s"] >= now_s - FIRST_S]), 90.0)
    assert found is not None and found.together == 1
    assert now_s - found.from_s == pytest.approx(3600.0 * back_h, rel=0.01)


def test_samples_that_came_more_slowly_for_a_while_are_read_all() -> None:
    samples = rows(20_000)
    samples["at_s"] = np.cumsum(np.where(np.arange(20_000) < 12_000, 0.4, 0.1))
    found = resolution(of_samples(samples), 90.0)
    assert found is not None and int(np.sum(samples["at_s"] >= found.from_s)) == 11_400
