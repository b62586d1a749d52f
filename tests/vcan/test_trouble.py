"""Plants in trouble retuned by plant, controller and service as processes: what is wrong is not proposed silently.

`python -m benchmarks.trouble_on_bus` is the whole of it, for the table of docs/trouble.md.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import pytest

from benchmarks.cases import ASKED
from benchmarks.trouble.bus_cases import BUS_CASES, bus_plants
from benchmarks.trouble.bus_runs import CUT_OFF, bus_run, worst_of
from benchmarks.trouble.bus_site import TroubleSite
from benchmarks.trouble.report import TOO_FAR
from loopwright.tuning.gains import Gains
from tests.vcan.test_bus_loop import start, url  # noqa: F401

UNTROUBLED = "none: linear"
KINDS = ("gain below over above: 2", "equal percentage valve: R 50")
PLANTS = ("two lags, dead time 0.2", "model-18")
SAMPLE_WALL_S = 0.04


@pytest.mark.timeout(600)
@pytest.mark.on_vcan(PLANTS[0])
@pytest.mark.parametrize("name", PLANTS)
def test_gains_that_are_wrong_for_a_plant_in_trouble_are_not_proposed(name: str, url: str, tmp_path: Path) -> None:  # noqa: F811
    plant = next(each for each in bus_plants() if each.name == name)
    cases = [BUS_CASES[each] for each in (UNTROUBLED, *KINDS)]
    with ExitStack() as stack:
        site = TroubleSite(stack, tmp_path, [url], [(plant, cases)], 1, SAMPLE_WALL_S)
        ended = site.retuned()
    untroubled, *troubled = [bus_run(*each) for each in ended]
    assert untroubled.reason is None, untroubled
    assert untroubled.Ms == pytest.approx(ASKED, abs=0.1)
    assert untroubled.Kp is not None and untroubled.Ti is not None
    for run, (loop, _, samples) in zip(troubled, ended[1:], strict=True):
        # the gains of the untroubled plant would be wrong on each of these
        worst = worst_of(loop, samples["mv"], Gains(untroubled.Kp, untroubled.Ti))
        assert not worst.stable or worst.Ms > ASKED + TOO_FAR, (run.case, worst)
        assert run.reason is not None or run.over <= TOO_FAR, run
        assert run.reason not in CUT_OFF, run
