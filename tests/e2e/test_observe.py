"""An operator (a script) moves the set-point of a live loop; the gains come from that alone."""

from __future__ import annotations

import json
import time
from contextlib import ExitStack
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import pytest

from loopwright.service.results import GainsView
from loopwright.tuning.analysis.margins import margins, ultimate_point
from loopwright.tuning.models import TransferFunction
from loopwright.tuning.plan import Mode
from tests.e2e.plantsite import MODEL_14, TAG, Plantsite

SPEED = 10.0
REST_S, BETWEEN_S = 60.0, 30.0
COMPUTED_S = 200.0
"""Longest wait for the answer, which is computed: the processors of a busy machine are late."""
MOVES = (50.1, 50.02, 50.1, 50.0)


def last_sample(here: Plantsite) -> int:
    """The number of the last sample that the listener has with known gains; 0 where there is none."""
    found = here.http.get(f"/loops/{TAG}/history", params={"from": time.time() - 5.0, "points": 5000}).json()
    known = [number for number, gains in zip(found["sample_number"], found["gains"], strict=True) if gains is not None]
    return max(known, default=0)


def operated(here: Plantsite, plant_time_s: float) -> None:
    """Waits until the loop has worked for so long, as heard."""
    deadline, first = time.monotonic() + 150.0, 0
    while not first or last_sample(here) < first + plant_time_s / here.case.ts:
        first = first or last_sample(here)
        assert time.monotonic() < deadline, "nothing is heard"
        time.sleep(0.1)  # each question costs the one processor of the guest some of what the loop needs


def only_the_step(here: Plantsite, sampled: TransferFunction) -> None:
    """fast finds what operation has shown, and moves the set-point once. sampled: the plant with its sampling."""
    told = here.http.post(f"/loops/{TAG}/retune/preview", json={}).json()
    assert [stage["stage"] for stage in told["stages"]][:3] == ["preflight", "trial", "pulses"]
    url = here.retune()
    job = here.finished(url)
    assert job["state"] == "proposed", (job["reason"], job["detail"], job["notes"])
    assert [stage["stage"] for stage in job["stages"]] == ["preflight", "design", "trial", "redesign"]
    assert "set-point changes of normal operation" in job["model_from"]
    samples = here.http.get(f"{url}/samples").json()
    assert set(samples["mode"]) == {int(Mode.AUTOMATIC)}
    assert len(set(samples["sp"])) == 2, "at rest, and one step"
    new = GainsView.model_validate(job["new_gains"]).gains()
    assert margins(sampled, new).Ms == pytest.approx(1.6, abs=0.1)
    assert here.is_home()


@pytest.mark.on_vcan()
def test_what_an_operator_does_gives_gains_that_are_right_on_the_plant(bus: str, tmp_path: Path) -> None:
    with ExitStack() as stack:
        permitted = {"test": {"excitations": ["observe", "setpoint"]}}
        here = Plantsite(stack, tmp_path, MODEL_14, bus, speed=str(SPEED), changes=permitted)
        here.write("plant_noise", 0.001)
        operated(here, REST_S)
        for sp in MOVES:
            here.write("controller_setpoint", sp)
            operated(here, BETWEEN_S)
        answer = here.http.get(f"/loops/{TAG}/observation", timeout=COMPUTED_S)
        assert answer.status_code == 200, answer.text
        found = answer.json()
        assert found["state"] == "proposal", (found["known"], found["detail"])
        assert len(found["changes_used"]) >= 2 and found["proposed"]["uncertainty"] < 0.06
        models = json.loads((files("loopwright.plantsim") / "models-50.json").read_text())["models"]
        plant = next(each for each in models if each["id"] == 14)
        num = tuple(0.01 * each for each in plant["num"])  # on the bus MV is in percent
        on_bus = TransferFunction(num, tuple(plant["den"]), plant["delay"])
        assert ultimate_point(on_bus)[0] == pytest.approx(here.case.Ku, rel=0.01)
        sampled = replace(on_bus, L=on_bus.L + 0.5 * here.case.ts)
        gains = GainsView.model_validate(found["proposed"]["gains"]).gains()
        assert margins(sampled, gains).Ms == pytest.approx(1.6, abs=0.1)
        assert here.is_home() and here.http.get("/jobs").json() == [] and not here.read("controller_session")

        known = here.http.get(f"/loops/{TAG}").json()["knowledge"]
        assert (known["Ms"], known["changes"]) == (found["present"]["Ms"], len(found["changes_used"]))
        assert known["source"] == "operation" and known["proposed"] == found["proposed"]

        only_the_step(here, sampled)

        job = here.finished(here.retune(**found["retune"]))
        assert job["state"] == "proposed", (job["reason"], job["detail"])
        assert job["new_gains"]["Kp"] == pytest.approx(gains.Kp, rel=0.01) and job["step_after"]["settled"]
        assert here.is_home()
        here.http.post(f"{job['url']}/accept").raise_for_status()
        known = here.http.get(f"/loops/{TAG}").json()["knowledge"]
        assert (known["source"], known["job"]) == ("trial", job["url"]), (known, job["model"], job["model_from"])
        assert known["uncertainty"] < 0.06
        assert known["Ms"] == pytest.approx(margins(sampled, gains).Ms, abs=0.1)
