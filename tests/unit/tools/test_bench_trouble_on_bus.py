"""Plants in trouble on a bus: the plant simulator has the plants that the rehearsals have and that proposals are judged
on."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.plants import Plant
from benchmarks.trouble.bus_cases import BUS_CASES, REST, bus_plants
from benchmarks.trouble.bus_runs import bus_run, worst_of
from benchmarks.trouble.bus_site import BusLoop
from benchmarks.trouble.chain import Chain, Setting
from benchmarks.trouble.kinds import TROUBLES
from benchmarks.trouble_on_bus import table
from loopwright.plantsim.own_plant import own_plant
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import TransferFunction

DRIFTS = "gain drifts over 8 Pu: to 1.3"
MOVES = np.repeat([10.0, -5.0, 10.0, -5.0, 4.0], 60)
"""Of MV, percent: after two of them nothing is left of where a valve with slack started."""


def loop_of(case: str, plant: Plant) -> BusLoop:
    return BusLoop("0-0", "hub", 1, plant, BUS_CASES[case], 1, 0.0)


def test_there_are_twelve_plants_of_gain_1_and_six_kinds_of_trouble_beside_none() -> None:
    assert len(bus_plants()) == 12 and len(BUS_CASES) == 1 + 6 and set(BUS_CASES) <= set(TROUBLES)
    for plant in bus_plants():
        assert plant.num[-1] / plant.den[-1] == pytest.approx(1.0)
    dead_times = sorted(plant.L / plant.Pu for plant in bus_plants())
    assert dead_times[0] == 0.0 and dead_times[-1] > 0.3


@pytest.mark.parametrize("case", [each for each in BUS_CASES if each != DRIFTS])
@pytest.mark.parametrize("name", ["lag, dead time 0.3", "P8_alpha=0.5", "model-35"])
def test_the_simulated_plant_is_that_of_the_rehearsals(case: str, name: str) -> None:
    plant = next(each for each in bus_plants() if each.name == name)
    on_bus = own_plant(BUS_CASES[case].model(plant)).build(plant.Ts)
    trouble = TROUBLES[case]
    rehearsed = Chain(Setting(plant, trouble.substeps, 0.0, 1), trouble.build)
    ours = [on_bus.step(REST + each) - REST for each in MOVES]
    theirs = [rehearsed.step(each) for each in MOVES]
    assert np.ptp(theirs) > 5.0
    assert ours[150:] == pytest.approx(theirs[150:], abs=0.02 if "backlash" in case else 1e-9)


def test_what_drifts_ends_where_it_is_judged() -> None:
    plant, gains = bus_plants()[1], Gains(0.5, 1.2)
    end, periods = BUS_CASES[DRIFTS].drift
    assert (end, periods) == (1.3, 8.0)
    faster = TransferFunction((end * plant.num[0],), plant.den, plant.L + 0.5 * plant.Ts)
    assert worst_of(loop_of(DRIFTS, plant), [REST], gains).Ms == pytest.approx(margins(faster, gains).Ms, rel=1e-4)


def test_gains_are_judged_where_the_recorded_mv_has_taken_the_plant() -> None:
    plant, gains = bus_plants()[1], Gains(0.5, 1.2)
    loop = loop_of("equal percentage valve: R 50", plant)
    once, steep = worst_of(loop, [REST], gains).Ms, worst_of(loop, [REST, REST + 10.0], gains).Ms
    slope = 50.0**0.1
    true = margins(TransferFunction((slope * plant.num[0],), plant.den, plant.L + 0.5 * plant.Ts), gains).Ms
    assert once < steep == pytest.approx(true, rel=1e-4)


def ended(**more: Any) -> dict[str, Any]:
    return {"state": "proposed", "reason": None, "detail": None, **more}


def test_a_job_is_a_run_of_the_table() -> None:
    plant = bus_plants()[0]
    samples = {"stage": ["preflight"] * 100 + ["relay"] * 120 + ["verify"] * 40, "mv": [REST] * 260}
    new = {"Kp": 1.6, "Ti": 0.91, "Td": 0.0, "Tf": 0.0}
    run = bus_run(loop_of("none: linear", plant), ended(new_gains=new), samples)
    assert run.passed == 2.0 and run.Ms == pytest.approx(1.6, abs=0.01)
    refused = bus_run(loop_of("none: linear", plant), ended(state="refused", reason="noise_too_high"), samples)
    assert refused.Ms is None and refused.reason == "noise_too_high"
    unstable = bus_run(loop_of("none: linear", plant), ended(new_gains=new | {"Kp": 20.0}), samples)
    assert unstable.reason is None and unstable.Ms is None and unstable.over == float("inf")
    text = "\n".join(table([run, refused, replace(run, method="fast")]))
    assert "| bus | none | linear | within | 1/2 |" in text and "| rehearsal | none | linear | within | 1/1 |" in text
