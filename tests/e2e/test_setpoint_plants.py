"""Method setpoint through HTTP on eleven plants, one of which is in test_retune_http.py too: dead time, many lags,
inverse responses, a slow lag beside fast ones, a negative gain. One service has them all; each has a plant and a
controller.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import pytest

from loopwright.plantsim.catalogue import PlantFacts, find
from loopwright.service.loops.bus_loop import BusLoop
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import TransferFunction
from loopwright.tuning.plan import Mode
from tests.e2e.plantsite import MODEL_14, Plantsite

PLANTS = ("model-1", "model-7", "model-18", "model-28", "model-33", "model-41", "model-45", "five-lags", "sopdt",
          "inverse-response", "negative-gain")  # fmt: skip
SAMPLES_PER_PERIOD = 60
PART_OF_KU, NOISE = 0.3, 0.005
"""Present gain, and noise as a part of the permitted step."""
MV_SWING_PCT = 30.0
"""Of a swing of the set-point, by the present gain alone."""
FIRST_CONTROLLER, FIRST_PLANT = 0x21, 0x11
RELAY_NEEDED = "five-lags"
"""The plant whose loop permits the relay after the pulses."""
STAGES_OF_BOTH = ["preflight", "pulses", "relay", "design", "verify", "redesign"]


def known(name: str) -> tuple[PlantFacts, float, float, float]:
    """Facts, ultimate gain on the bus, ultimate period, s, and sample time, s."""
    facts = find(name).facts
    assert facts.Ku_on_bus is not None and facts.Pu_s is not None
    return facts, facts.Ku_on_bus, facts.Pu_s, round(facts.Pu_s / SAMPLES_PER_PERIOD, 3)


def step_of(name: str) -> float:
    """The permitted set-point step, PV units."""
    _, Ku, _, _ = known(name)
    return float(f"{MV_SWING_PCT / (2.0 * PART_OF_KU * Ku):.3g}")


def entry(number: int, name: str) -> dict[str, Any]:
    """The loop in loops.yaml."""
    facts, step = known(name)[0], step_of(name)
    around = {"low": facts.pv_nominal - 10.0 * step, "high": facts.pv_nominal + 10.0 * step}
    nodes = {"controller_node": FIRST_CONTROLLER + number, "plant_node": FIRST_PLANT + number}
    more = {"test": {"excitations": ["setpoint", "relay"]}} if name == RELAY_NEEDED else {}
    return {"tag": name, "pv_limits": around, "t95_s": facts.T95_s, "sp_deviation": step, **nodes, **more}


@pytest.fixture(scope="module")
def site(bus: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plantsite]:
    with ExitStack() as stack:
        folder = tmp_path_factory.mktemp("site")
        site = Plantsite(stack, folder, MODEL_14, bus, tuple(entry(*each) for each in enumerate(PLANTS)))
        site.write("plant_samples_to_run", 0)
        yield site


@contextmanager
def running(site: Plantsite, name: str, part_of_Ku: float) -> Iterator[Gains]:
    """The plant and its controller, with present gains of this part of the ultimate gain."""
    facts, Ku, Pu, Ts = known(name)
    number = PLANTS.index(name)
    controller, plant = FIRST_CONTROLLER + number, FIRST_PLANT + number
    present = Gains(float(f"{part_of_Ku * Ku:.4g}"), float(f"{Pu:.4g}"))
    sp, ts = str(facts.pv_nominal), str(Ts)
    gains = ("--kp", str(present.Kp), "--ti", str(present.Ti), *([] if facts.reverse else ["--direct"]))
    at = ("--bus", site.bus, "--ts", ts, "--node")
    law = site.launch(
        f"controller-{name}-{part_of_Ku:g}", "loopwright.controller", *at, str(controller), "--plant-node", str(plant),
        "--sp", sp, *gains,
    )  # fmt: skip
    noise = f"{NOISE * step_of(name):.4g}"
    process = site.launch(
        f"plant-{name}-{part_of_Ku:g}", "loopwright.plantsim", *at, str(plant), "--controller-node", str(controller),
        "--model", name, "--speed", "max", "--noise", noise,
    )  # fmt: skip
    for each in (law, process):
        each.wait_ready()
    try:
        yield present
    finally:
        process.stop()
        law.stop()


def true_Ms(name: str, proposed: dict[str, Any]) -> float:
    """Ms of the proposed gains on the plant itself, with the delay of the sampling."""
    facts, _, _, Ts = known(name)
    model = find(name).model
    assert model is not None
    new = Gains(proposed["Kp"] / facts.mv_per_unit, proposed["Ti"], proposed["Td"], proposed["Tf"])
    return margins(TransferFunction(model.num, model.den, model.dead_time_s + 0.5 * Ts), new).Ms


def is_home(site: Plantsite, name: str, present: Gains) -> None:
    number = PLANTS.index(name)
    loop = BusLoop(site.bus, FIRST_CONTROLLER + number, FIRST_PLANT + number)
    state = loop.read()
    loop.close()
    assert (state.mode, state.sp, state.on_trial) == (Mode.AUTOMATIC, find(name).facts.pv_nominal, False)
    assert (state.gains.Kp, state.gains.Ti) == pytest.approx((present.Kp, present.Ti), rel=1e-6)


@pytest.mark.on_vcan("model-7", "inverse-response", "negative-gain")
@pytest.mark.parametrize("name", PLANTS)
def test_it_gets_the_Ms_asked_and_never_leaves_automatic(site: Plantsite, name: str) -> None:
    with running(site, name, PART_OF_KU) as present:
        url = site.retune(name, method="setpoint", propose_anyway=True)
        job = site.finished(url)
        assert job["state"] == "proposed", (job["reason"], job["detail"])
        samples = site.http.get(f"{url}/samples").json()
        assert set(samples["mode"]) == {int(Mode.AUTOMATIC)}
        step, home = step_of(name), find(name).facts.pv_nominal
        assert max(abs(each - home) for each in samples["sp"]) <= step * (1.0 + 1e-5)
        assert [stage["stage"] for stage in job["stages"]][-4:] == ["pulses", "design", "verify", "redesign"]
        assert true_Ms(name, job["new_gains"]) == pytest.approx(1.6, abs=0.05)
        is_home(site, name, present)


def test_fast_lets_the_relay_follow_where_sluggish_gains_excite_too_little(site: Plantsite) -> None:
    """The loop permits both excitations. A PID needs the plant above the crossover, where a fiftieth of Ku excites
    nothing."""
    name = RELAY_NEEDED
    with running(site, name, 0.02) as present:
        url = site.retune(name, derivative=True, propose_anyway=True)
        job = site.finished(url)
        assert job["state"] == "proposed", (job["reason"], job["detail"])
        assert [stage["stage"] for stage in job["stages"]] == STAGES_OF_BOTH
        samples = site.http.get(f"{url}/samples").json()
        modes = [mode for mode, stage in zip(samples["mode"], samples["stage"], strict=True) if stage == "pulses"]
        assert set(modes) == {int(Mode.AUTOMATIC)}
        assert true_Ms(name, job["new_gains"]) == pytest.approx(1.6, abs=0.1)
        is_home(site, name, present)
