"""A loop in manual, tuned through HTTP by pulses of its manual output. Aborts and kills are in `test_ways_out`."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from loopwright.plantsim.catalogue import find
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import TransferFunction
from loopwright.tuning.plan import Mode
from tests.e2e.plantsite import MODEL_14, STAGES, TAG, Plantsite

PACE = 1.0
PERMITTED = {"test": {"excitations": ["setpoint", "manual"], "mv_step_max": 20.0}}


@pytest.fixture(scope="module")
def processes(bus: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plantsite]:
    with ExitStack() as stack:
        yield Plantsite(stack, tmp_path_factory.mktemp("site"), MODEL_14, bus, changes=PERMITTED)


@pytest.fixture
def here(processes: Plantsite) -> Plantsite:
    """The shared processes, the loop in manual and at rest."""
    processes.at_rest(0.0)
    processes.put_in_manual()
    return processes


def output(here: Plantsite) -> tuple[int, float]:
    """Mode and manual output, which MV has followed."""
    found = here.read("controller_manual_output")
    assert here.read("controller_mv") == pytest.approx(found)
    return int(here.read("controller_mode")), found


def restarted(here: Plantsite, module: str) -> None:
    """The controller anew, of this module, on what it has kept."""
    here.controller.kill()
    here.controller_module = module
    here.start_controller()
    here.controller.wait_ready()


def in_a_pulse(here: Plantsite, **options: Any) -> str:
    """A job whose pulse has taken MV away from home."""
    here.write("plant_pace", PACE)
    return here.in_stage(STAGES["manual-up"], **options)


def test_it_gets_gains_that_were_never_tried_and_takes_them_without_leaving_manual(here: Plantsite) -> None:
    here.write("plant_noise", 0.0005)
    home = output(here)
    shown = here.http.post(f"/loops/{TAG}/retune/preview", json={}).json()
    assert shown["would_start"], shown["obstacles"]
    assert [each["stage"] for each in shown["stages"]] == ["preflight", "manual", "design"]
    assert shown["largest_sp_move"] == 0.0 and shown["largest_mv_move_pct"] <= 20.0
    url = here.retune(propose_anyway=True)
    job = here.finished(url)
    assert job["state"] == "proposed", (job["reason"], job["detail"])
    assert job["mode_found"] == "manual"
    assert job["tested_on_loop"] is False and any("never tested" in note for note in job["notes"])
    samples = here.http.get(f"{url}/samples").json()
    assert set(samples["mode"]) == {int(Mode.MANUAL)}
    assert max(abs(mv - home[1]) for mv in samples["mv"]) <= shown["largest_mv_move_pct"] * (1.0 + 1e-5)
    assert output(here) == home
    model = find(MODEL_14.model).model
    assert model is not None
    new = job["new_gains"]
    gains = Gains(new["Kp"] / find(MODEL_14.model).facts.mv_per_unit, new["Ti"])
    sampled = TransferFunction(model.num, model.den, model.dead_time_s + 0.5 * MODEL_14.ts)
    assert margins(sampled, gains).Ms == pytest.approx(1.6, abs=0.05)

    here.http.post(f"{url}/accept").raise_for_status()
    assert output(here) == home, "new gains take effect without leaving manual and without moving MV"
    assert here.state().gains.Kp == pytest.approx(new["Kp"])
    here.http.post(f"{url}/rollback").raise_for_status()
    assert output(here) == home and here.state().gains.Kp == pytest.approx(here.case.kp)


def test_pv_at_its_limit_ends_the_test_in_the_controller(here: Plantsite) -> None:
    """A load takes PV over the limit while MV is away."""
    home = output(here)
    url = in_a_pulse(here, pv_low=49.9, pv_high=50.1, sp_deviation=0.1)
    here.write("plant_disturbance", 40.0)
    job = here.finished(url)
    assert (job["state"], job["reason"]) == ("failed", "pv_limit")
    text = r"PV left 49\.9 \.\. 50\.1 and is [\d.]+ now; the controller ended the test"
    assert re.fullmatch(text, job["detail"]), "not the service, which sees it later"
    assert output(here) == home


def test_another_hand_on_the_manual_output_has_the_last_word(here: Plantsite) -> None:
    home = output(here)
    url = in_a_pulse(here)
    here.write("controller_manual_output", home[1] + 1.0)
    job = here.finished(url)
    assert (job["state"], job["reason"]) == ("aborted", "output_changed")
    assert output(here) == (Mode.MANUAL, pytest.approx(home[1] + 1.0))


def test_a_controller_of_an_older_version_is_refused_before_anything_moves(here: Plantsite) -> None:
    """Its order WATCH is missing, with which it is to end a test by itself."""
    restarted(here, "tests.e2e.older_controller")
    try:
        # the controller before may not have stored its mode: this one begins in automatic, with another MV
        here.at_rest(0.0)
        here.put_in_manual()
        home = output(here)
        url = here.retune()
        job = here.finished(url)
        assert (job["state"], job["reason"]) == ("refused", "device_mismatch")
        assert "node 20h (32) does not know the order WATCH (object 2178h)" in job["detail"]
        assert {*here.http.get(f"{url}/samples").json()["mv"]} == {home[1]}
        assert output(here) == home
    finally:
        restarted(here, "loopwright.controller")


def test_a_loop_in_automatic_is_moved_by_its_set_point(here: Plantsite) -> None:
    here.at_rest(0.0)
    shown = here.http.post(f"/loops/{TAG}/retune/preview", json={}).json()
    assert "pulses" in [each["stage"] for each in shown["stages"]]
    url = here.retune(excitations=["manual"])
    job = here.finished(url)
    assert (job["state"], job["reason"]) == ("refused", "wrong_mode")
    assert "nothing but pulses of the manual output" in job["detail"]
    assert here.is_home()
