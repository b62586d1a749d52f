"""What a plant can have besides its transfer function: valves, a sine on PV, a gain that changes."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any

import pytest

from loopwright.plantsim.catalogue import find
from loopwright.plantsim.own_plant import own_plant
from loopwright.plantsim.plant import Plant
from loopwright.plantsim.valves import Backlash, EqualPercentage, Stiction, TwoGains

QUICK = {"num": [2.0], "den": [1e-6, 1.0], "mv": 40.0, "pv": 20.0}
"""Its PV follows within the sample, so that it shows what the valve does."""
LATER, SINE = {"share": 0.4, "later_s": 5}, {"amplitude": 0.5, "period_s": 4.0}


def built(**more: Any) -> Plant:
    return own_plant(json.dumps(QUICK | more)).build(0.1)


def shown(plant: Plant, moves: Sequence[float]) -> list[float]:
    """What the valve makes of these deviations of MV."""
    return [(plant.step(40.0 + each) - 20.0) / 2.0 for each in moves]


def test_a_valve_follows_half_of_its_slack_behind() -> None:
    valve = Backlash(1.0)
    assert [valve.step(each) for each in (5.0, 4.5, 4.0, 3.0)] == pytest.approx([4.5, 4.5, 4.5, 3.5])
    assert shown(built(valve={"backlash_pct": 2.0}), (10.0, 9.0, 8.0, 0.0)) == pytest.approx([9.0, 9.0, 9.0, 1.0])


def test_it_starts_anywhere_in_its_slack_by_the_seed() -> None:
    entry = own_plant(json.dumps(QUICK | {"valve": {"backlash_pct": 2.0}}))
    starts = [shown(entry.build(0.1, seed=seed), (0.0,))[0] for seed in range(20)]
    assert starts[3] == shown(entry.build(0.1, seed=3), (0.0,))[0]
    assert -1.0 <= min(starts) < -0.3 and 0.3 < max(starts) <= 1.0


def test_a_valve_sticks_until_mv_is_off_by_its_band() -> None:
    valve = Stiction(0.5)
    assert [valve.step(each) for each in (0.4, 0.6, 0.9, 1.2)] == [0.0, 0.6, 0.6, 1.2]
    assert shown(built(valve={"stiction_pct": 1.0}), (0.9, 1.5, 2.4, 2.6)) == pytest.approx([0.0, 1.5, 1.5, 2.6])


def test_an_equal_percentage_valve_has_gain_1_at_rest_and_the_flows_of_its_rangeability() -> None:
    valve = EqualPercentage(50.0)
    assert valve.slope(0.0) == 1.0 and valve.step(1e-6) == pytest.approx(1e-6)
    # of two openings so far apart the slopes are as the flows: R^(1/10)
    assert valve.slope(10.0) / valve.slope(0.0) == pytest.approx(50.0**0.1)
    assert (valve.step(6.01) - valve.step(5.99)) / 0.02 == pytest.approx(valve.slope(6.0), rel=1e-6)
    assert shown(built(valve={"equal_percentage": 50.0}), (6.0,)) == pytest.approx([valve.step(6.0)])


def test_the_gain_below_rest_is_another_one() -> None:
    assert [TwoGains(2.0).step(each) for each in (-1.0, 0.0, 1.0)] == [-2.0, 0.0, 1.0]
    assert shown(built(valve={"gain_below": 2.0}), (-3.0, 3.0)) == pytest.approx([-6.0, 3.0])


def test_mv_ends_at_0_and_100_percent_before_the_valve_and_no_number_leaves_it_where_it_is() -> None:
    plant = built(valve={"gain_below": 2.0})
    assert shown(plant, (-50.0, 70.0, math.nan)) == pytest.approx([-80.0, 60.0, 60.0])


def test_a_load_acts_behind_the_valve() -> None:
    plant = built(valve={"stiction_pct": 5.0})
    plant.disturbance = 1.0
    assert shown(plant, (4.0,)) == pytest.approx([1.0])


def test_a_sine_is_added_to_pv() -> None:
    plant = built(sine={"amplitude": 0.5, "period_s": 4.0})
    seen = [plant.pv, *(plant.step(40.0) for _ in range(40))]
    expected = [20.0 + 0.5 * math.sin(2.0 * math.pi * n / 40) for n in range(41)]
    assert seen == pytest.approx(expected) and plant.pv == seen[-1]


@pytest.mark.parametrize("name", ["model-1", "reactor", "own"])
def test_a_gain_that_changes_multiplies_what_mv_and_the_load_do(name: str) -> None:
    def moved(gain: float, mv: float, load: float) -> float:
        entry = find(name) if name != "own" else own_plant(json.dumps(QUICK | {"second_path": LATER, "sine": SINE}))
        plant, rest = entry.build(0.1), entry.facts.mv_nominal_pct
        plant.gain, plant.disturbance = gain, load
        for _ in range(600):
            pv = plant.step(rest + mv)
        return pv

    assert moved(2.0, 0.5, 0.25) == pytest.approx(moved(1.0, 1.0, 0.5), rel=1e-9)
    assert moved(2.0, 0.5, 0.0) != pytest.approx(moved(1.0, 0.5, 0.0), rel=1e-6)


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ({"valve": {"backlash_pct": 0}}, "backlash_pct of the valve is 0: it must be above 0 %"),
        ({"valve": {"stiction_pct": -1}}, "stiction_pct of the valve is -1"),
        ({"valve": {"equal_percentage": 1}}, "it must be a rangeability, above 1"),
        ({"valve": {"gain_below": 2, "backlash_pct": 1}}, "valve is a JSON object with one of backlash_pct"),
        ({"valve": {"colour": 2}}, "valve is a JSON object with one of"),
        ({"valve": 3}, "valve is a JSON object with one of"),
        ({"sine": {"amplitude": 1}}, "sine is a JSON object with amplitude and period_s"),
        ({"sine": {"amplitude": 1, "period_s": 0}}, "the period of the sine is 0 s"),
    ],
)
def test_what_is_no_valve_and_no_sine_is_refused_with_the_numbers(more: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        built(**more)
