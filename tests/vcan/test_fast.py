"""The fast procedure over the bus: plant and controller as processes, the relay in the controller device."""

from __future__ import annotations

import threading
from dataclasses import replace

import pytest

from benchmarks.cases import ASKED
from benchmarks.plants import Plant, plants
from benchmarks.tuning import cost_over_best, loop_of, span_of
from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.runner import run
from loopwright.service.loops.bus_loop import BusLoop
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.fast.relay.procedure import FastOptions, fast
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode
from tests.vcan.test_bus_loop import CONTROLLER, PLANT, Start, start, url  # noqa: F401

MODELS = (1, 2, 4, 6, 10, 12, 14, 16, 18, 20, 22, 24)
PERCENT = 100.0
"""MV on the bus for one unit of the model's input."""
AMPLITUDE, NOISE = 0.2, 0.01
WALL_S = 0.01
"""Of a sample: a command over the bus takes a few milliseconds."""


def benched(number: int) -> Plant:
    """Its sample time in whole microseconds, as the bus has it."""
    return next(plant for plant in plants() if plant.name == f"model-{number}")


@pytest.mark.timeout(240)
@pytest.mark.on_vcan(1, 12, 24)
@pytest.mark.parametrize("number", MODELS)
def test_the_bus_gives_what_the_rehearsal_gives(start: Start, url: str, number: int) -> None:  # noqa: F811
    plant = benched(number)
    Ts = round(plant.Ts, 4)
    span = AMPLITUDE * span_of(plant)
    present = Gains(15.0 * plant.Ku, round(2.0 * plant.Pu, 3))
    kp, ti = f"{present.Kp:.6g}", f"{present.Ti:.6g}"
    start(
        "loopwright.controller", "--bus", url, "--channels", "1", "--kp", kp, "--ti", ti, "--sp", "50", "--ts", str(Ts)
    )
    noise, speed = f"{NOISE * span:.6g}", f"{Ts / WALL_S:.6g}"
    start(
        "loopwright.plantsim", "--bus", url, "--model", plant.name, "--ts", str(Ts), "--speed", speed, "--noise", noise
    )

    facts = Facts(Ts, 3.0 * plant.Pu, 0.0, 100.0, 0.5 * span, present)
    loop = BusLoop(url, CONTROLLER, PLANT)
    before = loop.read()
    found = run(
        fast(facts, FastOptions(Ms=ASKED, amplitude=AMPLITUDE * PERCENT, propose_anyway=True)),
        loop,
        limits=RunLimits(0.0, 100.0, 0.0, 100.0),
        start_work=lambda work: threading.Thread(target=work.run, daemon=True).start(),
    )
    loop.close()
    assert found.value is not None, found.ended
    assert found.restored is not None
    assert (found.restored.mode, found.restored.sp) == (Mode.AUTOMATIC, 50.0)
    assert found.restored.gains == before.gains and not found.restored.on_trial

    in_model_units = replace(found.value.gains, Kp=found.value.gains.Kp / PERCENT)
    assert margins(plant.model(), in_model_units).Ms == pytest.approx(ASKED, abs=0.05)

    rehearsed, facts = loop_of(plant, AMPLITUDE, 0.5 * span, NOISE * span, seed=5)
    options = FastOptions(Ms=ASKED, amplitude=AMPLITUDE, propose_anyway=True)
    expected = run(fast(facts, options), rehearsed, limits=RunLimits()).value
    assert expected is not None
    # gains of the same robustness trade Kp for Ti where the criterion is flat: what counts is the loop they give
    assert cost_over_best(plant, in_model_units) == pytest.approx(cost_over_best(plant, expected.gains), abs=0.03)
