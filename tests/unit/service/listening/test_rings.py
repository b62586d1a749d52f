"""The history of one loop in bounded memory: levels, thinning, gaps, and what it takes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from loopwright.service.listening.bins import (
    GAP_BEFORE,
    GAP_INSIDE,
    UNKNOWN_MODE,
    Bins,
    GainSet,
    Rows,
    gaps,
    joined,
    packed,
    unpacked,
)
from loopwright.service.listening.rings import LEVELS, MAX_SETS, Rings

T0 = 1_769_860_800.0
AUTO = 2
ONE: GainSet = (1.5, 20.0, 0.0, 0.0, 1.0, 0.0)
OTHER: GainSet = (0.1, 5.0, 0.0, 0.0, 0.8, 0.0)


def filled(rings: Rings, count: int, step_s: float = 0.1, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Puts noise, all of it known; returns the times and PVs."""
    at_s = T0 + step_s * np.arange(count)
    pv = np.random.default_rng(seed).normal(50.0, 1.0, count).astype(np.float32)
    gains = rings.number_of(ONE)
    for n in range(count):
        gap = 0 if n else GAP_BEFORE
        rings.put(float(at_s[n]), n + 1, float(pv[n]), 100.0 - float(pv[n]), 50.0, gains, AUTO, gap)
    return at_s, pv


def test_8_hours_at_ten_samples_a_second_take_less_than_1_MB_and_are_all_there() -> None:
    rings = Rings()
    assert rings.nbytes < 1_000_000
    width_s, bins = LEVELS[0]
    assert width_s * bins >= 8 * 3600
    step_s, count = 2.0, 20 * 3600 // 2  # slower than ten a second, for longer: bins of two samples
    at_s, _ = filled(rings, count, step_s)
    end_s = float(at_s[-1])
    found = rings.rows(end_s - 8 * 3600, end_s, 5000)
    assert int(found.bins["count"].sum()) == pytest.approx(8 * 3600 / step_s, abs=3)
    assert rings.rows(end_s - 19.9 * 3600, end_s, 100).bins["count"].sum() > 19.8 * 3600 / step_s
    assert rings.nbytes < 1_000_000


@pytest.mark.parametrize("points", [1, 7, 60, 5000])
@pytest.mark.parametrize("back_s", [20.0, 900.0, 3500.0])
def test_thinning_keeps_extremes_means_and_counts(points: int, back_s: float) -> None:
    rings = Rings(samples=3000, levels=((4.0, 300), (32.0, 300)))
    at_s, pv = filled(rings, 36_000)
    end_s = float(at_s[-1])
    found = rings.rows(end_s - back_s, end_s, points).bins
    assert 0 < len(found) <= points
    begin = int(np.searchsorted(at_s, found["at_s"][0]))  # the first bin may begin before the time asked for
    assert at_s[begin] == found["at_s"][0] and at_s[begin] <= end_s - back_s + 0.1
    starts = np.append(begin, begin + np.cumsum(found["count"].astype(int))).tolist()
    assert starts[-1] == len(pv), "no sample is missing, and none is there twice"
    for each, first, last in zip(found, starts[:-1], starts[1:], strict=True):
        part = pv[first:last]
        assert (each["pv_min"], each["pv_max"]) == (part.min(), part.max())
        assert each["pv_mean"] == pytest.approx(part.mean(dtype=np.float64), abs=1e-4)
        assert each["mv_max"] == pytest.approx(100.0 - float(part.min()), abs=1e-5)
        assert each["n"] == first + 1 and each["until_s"] == at_s[last - 1]
        assert (each["sp"], each["mode"], each["gap"]) == (50.0, AUTO, 0 if first else GAP_BEFORE)


def test_the_finest_level_that_goes_back_far_enough_answers() -> None:
    rings = Rings(samples=3000, levels=((4.0, 300), (32.0, 300)))
    at_s, _ = filled(rings, 36_000)
    end_s = float(at_s[-1])
    assert rings.rows(end_s - 200.0, end_s, 5000).bins["count"].max() == 1
    assert 30 < rings.rows(end_s - 1000.0, end_s, 5000).bins["count"].max() <= 41
    assert 300 < rings.rows(end_s - 3000.0, end_s, 5000).bins["count"].max() <= 321
    for back_s in (1000.0, 3000.0):  # the newest samples are on the finest level only, and are there
        assert rings.rows(end_s - back_s, end_s, 5000).bins["until_s"][-1] == end_s


@pytest.mark.parametrize("back_s", [100.0, 1000.0])
def test_a_gap_is_told_on_each_level_and_through_thinning(back_s: float) -> None:
    rings = Rings(samples=3000, levels=((4.0, 1000), (32.0, 300)))
    gains = rings.number_of(ONE)
    for n in range(10_000):
        if 9500 <= n < 9700:  # 20 s of a minute ago
            continue
        gap = GAP_BEFORE if n in (0, 9700) else 0
        rings.put(T0 + 0.1 * n, n + 1, 50.0, 40.0, 50.0, gains, AUTO, gap)
    end_s = T0 + 999.9
    found = rings.rows(end_s - back_s, end_s, 400)
    inner = [gap for gap in found.gaps if gap[0] > -math.inf]
    assert len(inner) == 1
    assert inner[0][0] == pytest.approx(T0 + 949.9, abs=0.01) and inner[0][1] == pytest.approx(T0 + 970.0, abs=0.01)
    for each in found.bins:
        assert not (each["until_s"] < T0 + 960.0 < each["at_s"]), "no bin lies in the gap"
    for points in (1, 3, 200):
        thin = rings.rows(end_s - back_s, end_s, points)
        assert thin.bins["gap"].any()
        told = [gap for gap in thin.gaps if gap[1] < T0 + 971.0 and gap[0] > T0]
        assert told == (inner if back_s / points <= 20.0 else []), "shorter ones are told by the flag alone"


def test_a_short_gap_in_a_bin_is_told_as_a_gap_in_its_time() -> None:
    samples = Rings(samples=100, levels=((4.0, 10),))
    for n in (0, 1, 2, 5, 6, 40):
        samples.put(T0 + 0.1 * n, n + 1, 50.0, 40.0, 50.0, 0, AUTO, GAP_BEFORE if n in (0, 5, 40) else 0)
    level = samples.unsaved()
    assert level is not None and level.bins["gap"].tolist() == [GAP_BEFORE | GAP_INSIDE]
    found = gaps(level.bins, T0, T0 + 10)
    assert found == ((-math.inf, T0), (T0, pytest.approx(T0 + 0.6)))


def test_what_is_unknown_for_a_sample_is_unknown_for_its_bin() -> None:
    rings = Rings()
    known = rings.number_of(ONE)
    for n in range(8):
        unknown = n == 1
        sp, mode = (math.nan, UNKNOWN_MODE) if unknown else (50.0 + n, AUTO)
        rings.put(T0 + n, n + 1, 50.0, 40.0, sp, 0 if unknown else known, mode, 0)
    two = rings.rows(T0, T0 + 8, 2)
    assert np.isnan(two.bins["sp"][0]) and two.bins["sp"][1] == 57.0
    assert two.bins["mode"].tolist() == [UNKNOWN_MODE, AUTO]
    assert two.bins["gains"].tolist() == [0, 1] and two.sets == (ONE,)


def test_a_pv_that_is_no_number_does_not_hide_the_extremes() -> None:
    rings = Rings()
    for n, pv in enumerate((49.0, math.nan, 51.0)):
        rings.put(T0 + n, n + 1, pv, 40.0, 50.0, 0, AUTO, 0)
    (one,) = rings.rows(T0, T0 + 3, 1).bins
    assert (one["pv_min"], one["pv_max"]) == (49.0, 51.0) and np.isnan(one["pv_mean"])


def test_sets_of_gains_are_counted_and_forgotten_beyond_a_number() -> None:
    rings = Rings()
    for n in range(2 * MAX_SETS):
        rings.put(T0 + n, n + 1, 50.0, 40.0, 50.0, rings.number_of((float(n + 1), *ONE[1:])), AUTO, 0)
    found = rings.rows(T0, T0 + 1000, 5000)
    assert len(found.sets) == MAX_SETS
    assert found.bins["gains"].tolist() == [0] * MAX_SETS + list(range(1, MAX_SETS + 1))
    assert found.sets[-1][0] == 2 * MAX_SETS


def bins_of(*numbers: int) -> Bins:
    rings = Rings()
    for number in numbers:
        rings.put(T0 + number, number + 1, float(number), 40.0, 50.0, 0, AUTO, 0)
    return rings.rows(T0, T0 + 1000, 1000).bins


def test_a_block_holds_what_was_put_into_it() -> None:
    rings = Rings()
    filled(rings, 400)
    rows = rings.unsaved(all_of_it=True)
    assert rows is not None and rings.unsaved(all_of_it=True) is None
    again = unpacked(packed(rows), len(rows.bins))
    assert (again.bins == rows.bins).all() and again.sets == rows.sets == (ONE,)
    assert len(packed(rows)) < rows.bins.nbytes


def test_unsaved_bins_are_handed_over_once() -> None:
    rings = Rings()
    filled(rings, 100)
    first, rest = rings.unsaved(), rings.unsaved(all_of_it=True)
    assert first is not None and rest is not None
    assert first.bins["count"].sum() + rest.bins["count"].sum() == 100
    assert first.bins["until_s"][-1] < rest.bins["at_s"][0]


def test_parts_with_sets_of_their_own_are_joined() -> None:
    parts = []
    for at, sets in ((0, (ONE, OTHER)), (10, (OTHER,))):
        bins = bins_of(at, at + 1)
        bins["gains"] = [1, len(sets)]
        parts.append(Rows(bins, sets))
    whole = joined(parts)
    assert whole.sets == (ONE, OTHER) and whole.bins["gains"].tolist() == [1, 2, 2, 2]
    assert not len(joined([]).bins)


def test_more_samples_than_a_ring_holds_within_a_bin_are_all_counted() -> None:
    """A simulated plant at full speed."""
    rings = Rings(samples=100, levels=((4.0, 1000),))
    filled(rings, 1050, step_s=0.001)
    rows = rings.unsaved(all_of_it=True)
    assert rows is not None and rows.bins["count"].sum() == 1050


def test_a_ring_that_has_gone_round_is_in_order() -> None:
    rings = Rings(samples=10, levels=((4.0, 5),))
    for n in range(27):
        rings.put(T0 + n, n + 1, float(n), 40.0, 50.0, 0, AUTO, 0)
    assert rings.rows(T0 + 20, T0 + 30, 100).bins["n"].tolist() == list(range(21, 28))
