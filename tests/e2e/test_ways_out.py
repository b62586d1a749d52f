"""Every way a retune can end early, on live processes: its reason, and the loop as it was, read by SDO.

The processes are shared; each test finds the loop at rest and the plant at PACE times real time, slow enough that
"in the middle of a stage" is no race.
"""

from __future__ import annotations

import math
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from loopwright.protocol.profile import Mode
from loopwright.protocol.tuner import FailureKind, TunerError
from tests.e2e.plantsite import MANUAL_PERMITTED, MODEL_14, ON_VCAN, STAGES, TAG, Plantsite, Stage

PACE = 5.0
BACK_WITHIN_S = 2.5
"""1.5 s of heartbeat time, and what the device's tick and reading it all back by SDO take on a slow machine."""
OUTAGE_S = 2.0
"""Of wall time: longer than the heartbeat time, shorter than the patience of who restores."""
EARLY = {"fast": STAGES["fast-relay"], "five-stage": STAGES["baseline"]}
"""The first stage of each procedure that moves the loop."""
MORE_LOOPS = (
    {"tag": "NO-BUS", "bus": "socketcan:vcan9"},
    {"tag": "ABSENT", "controller_node": 0x55},
    {"tag": "OTHER-TIME", "controller_node": 0x21, "channel": 2},
    {"tag": "DIRECT", "controller_node": 0x21, "plant_node": 0x11},
    {"tag": "INNER", "controller_node": 0x22, "plant_node": 0x12, "setpoint_from": "remote", "outer_loop": TAG},
)


@pytest.fixture(scope="module")
def processes(bus: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plantsite]:
    with ExitStack() as stack:
        yield Plantsite(stack, tmp_path_factory.mktemp("site"), MODEL_14, bus, MORE_LOOPS, changes=MANUAL_PERMITTED)


@pytest.fixture(params=EARLY)
def early(request: pytest.FixtureRequest) -> Stage:
    """A stage and the options of a retune that comes to it, of either procedure."""
    return EARLY[request.param]


@pytest.fixture
def here(processes: Plantsite) -> Plantsite:
    """The shared processes, at rest."""
    processes.at_rest(PACE)
    return processes


def brought_into(here: Plantsite, stage: str) -> str:
    """A job in that stage, at the pace that the stage needs."""
    here.write("plant_pace", PACE * STAGES[stage].pace)
    return here.in_stage(STAGES[stage])


def ended(here: Plantsite, url: str) -> tuple[str, str]:
    job = here.finished(url)
    assert job["advice"] and job["detail"]
    return job["state"], job["reason"]


@pytest.mark.on_vcan("fast")
def test_a_foreign_setpoint_stays(here: Plantsite, early: Stage) -> None:
    url = here.in_stage(early)
    here.write("controller_setpoint", 50.03)
    assert ended(here, url) == ("aborted", "setpoint_changed")
    assert here.is_home(sp=50.03)


@pytest.mark.on_vcan("fast")
def test_a_mode_changed_by_another(here: Plantsite, early: Stage) -> None:
    url = here.in_stage(early)
    here.write("controller_mode_command", Mode.MANUAL)
    assert ended(here, url) == ("aborted", "mode_changed")
    state = here.state()
    assert (state.mode, state.sp, state.on_trial) == (Mode.MANUAL, here.case.sp, False)
    assert state.gains.Kp == here.case.kp
    assert here.read("controller_mv") == here.read("controller_manual_output") == state.mv
    here.write("controller_mode_command", Mode.AUTOMATIC)
    assert here.is_home()


@pytest.mark.on_vcan("fast")
def test_pv_at_its_limit(here: Plantsite, early: Stage) -> None:
    narrow = {"pv_high": 50.05, "sp_deviation": 0.04}  # the step itself stays within them
    assert ended(here, here.retune(**narrow, **early.options)) == ("failed", "pv_limit")
    assert here.is_home()


@pytest.mark.on_vcan("fast")
def test_noise_too_high(here: Plantsite, early: Stage) -> None:
    here.write("plant_noise", 0.05)
    assert ended(here, here.retune(**early.options)) == ("refused", "noise_too_high")
    assert here.is_home()


@pytest.mark.on_vcan("fast")
def test_not_at_rest(here: Plantsite, early: Stage) -> None:
    """One load would die away, and the loop would be looked at again: this one comes again and again."""
    url = here.retune(**early.options)
    here.until(url, lambda job: job["state"] == "running" and job["stage"] == "preflight")
    load, again_at = -10.0, 0.0

    def over(job: dict[str, Any]) -> bool:
        nonlocal load, again_at
        if time.monotonic() > again_at:
            load, again_at = -load, time.monotonic() + 0.3
            here.write("plant_disturbance", load)
        return job["state"] != "running"

    job = here.until(url, over)
    assert (job["state"], job["reason"]) == ("refused", "not_at_rest")
    assert here.is_home()


@pytest.mark.on_vcan("fast")
def test_mv_without_room(here: Plantsite, early: Stage) -> None:
    assert ended(here, here.retune(mv_low=49.9, mv_high=60, **early.options)) == ("refused", "saturated")
    assert here.is_home()


def test_mv_at_its_limit_in_mid_pulse(here: Plantsite) -> None:
    url = brought_into(here, "setpoint-pulses")
    here.write("plant_disturbance", -60.0)  # of MV's range, half of which is left
    here.until(url, lambda job: here.read("controller_mv") > 99.9 or job["state"] != "running")
    outcome = ended(here, url)
    assert here.read("controller_mv") > 99.9
    assert outcome == ("refused", "mv_limit")
    assert here.is_home()


def test_the_set_point_of_an_inner_loop_is_not_pulsed(here: Plantsite) -> None:
    answer = here.http.post("/loops/INNER/retune", json={"by": "me", "method": "setpoint"})
    assert (answer.status_code, answer.json()["reason"]) == (409, "setpoint_is_driven")
    assert f"comes from {TAG}" in answer.json()["detail"] and "to local set-point" in answer.json()["detail"]
    assert here.http.get("/loops/INNER/jobs").json() == []


def test_what_is_refused_at_once(here: Plantsite) -> None:
    unknown = here.http.post("/loops/NOBODY/retune", json={"by": "me"})
    contradicting = here.http.post(f"/loops/{TAG}/retune", json={"by": "me", "mv_low": 60, "mv_high": 40})
    nan = here.http.post(
        f"/loops/{TAG}/retune", content='{"sp_deviation": NaN}', headers={"content-type": "application/json"}
    )
    assert [answer.status_code for answer in (unknown, contradicting, nan)] == [404, 422, 422]
    assert contradicting.json()["reason"] == "bad_limits" and nan.json()["reason"] == "bad_input"
    assert {a.headers["content-type"] for a in (unknown, contradicting, nan)} == {"application/problem+json"}
    assert here.is_home()


def test_no_such_bus_and_no_such_node(here: Plantsite) -> None:
    jobs = here.retune("NO-BUS"), here.retune("ABSENT")
    assert [ended(here, url) for url in jobs] == [("failed", "bus_lost"), ("failed", "node_lost")]
    assert here.is_home()


def test_nan_by_sdo_is_refused_and_the_loop_goes_on(here: Plantsite) -> None:
    for name in ("controller_setpoint", "controller_staged_kp"):
        with pytest.raises(TunerError) as refused:
            here.write(name, math.nan)
        assert refused.value.kind is FailureKind.ABORT and refused.value.code == 0x06090030
    assert here.is_home()
    before = here.read("sample_number")
    time.sleep(0.5)
    assert here.read("sample_number") > before and here.state().pv == pytest.approx(50.0, abs=1e-3)


@pytest.mark.on_vcan("fast")
def test_a_plant_that_falls_silent(here: Plantsite, early: Stage) -> None:
    url = here.in_stage(early)
    os.kill(here.plant.pid, signal.SIGSTOP)
    try:
        assert ended(here, url) == ("failed", "node_lost")
        assert here.is_home()
    finally:
        os.kill(here.plant.pid, signal.SIGCONT)


@pytest.mark.on_vcan("ultimate", "fast-verify", "setpoint-pulses", "manual-up")
@pytest.mark.parametrize("stage", STAGES)
def test_aborted_by_the_operator_in_each_stage(here: Plantsite, stage: str) -> None:
    url = brought_into(here, stage)
    assert here.http.post(f"{url}/abort").status_code == 202
    assert ended(here, url) == ("aborted", "operator")
    assert here.is_home()


def test_busy_then_aborted_by_the_operator(here: Plantsite) -> None:
    url = here.in_stage(EARLY["fast"])
    busy = here.http.post(f"/loops/{TAG}/retune", json={"by": "me"})
    assert busy.status_code == 409 and busy.json()["job"] == url
    assert here.http.post(f"{url}/abort").status_code == 202
    assert ended(here, url) == ("aborted", "operator")
    assert here.is_home()


@pytest.mark.parametrize("bus", [ON_VCAN], indirect=True)
@pytest.mark.parametrize("stage", ["baseline", "fast-preflight", "fast-relay", "fast-verify"])
def test_a_bus_that_goes_down(here: Plantsite, stage: str) -> None:
    def link(state: str) -> None:
        subprocess.run(["ip", "link", "set", "vcan0", state], check=True)

    url = here.in_stage(STAGES[stage])
    link("down")
    try:
        time.sleep(OUTAGE_S)
    finally:
        link("up")
    # what is noticed first depends on where the outage meets us: the bus, the silence, a controller that has gone back
    state, reason = ended(here, url)
    assert state == "failed" and reason in ("bus_lost", "node_lost", "samples_lost", "session_ended_by_device")
    assert here.is_home()


@pytest.mark.on_vcan("fast-relay")
@pytest.mark.parametrize("stage", ["relay", "fast-relay"])
def test_sigterm_of_the_service(here: Plantsite, stage: str) -> None:
    url = here.in_stage(STAGES[stage])
    here.service.stop()
    assert here.is_home()
    here.serve()
    assert ended(here, url) == ("aborted", "service_stopped")


@pytest.mark.on_vcan("zn_pi", "fast-relay", "setpoint-verify", "manual-up", "manual-back", "manual-rest")
@pytest.mark.parametrize(
    "stage", [*(name for name, stage in STAGES.items() if not stage.untouched), "setpoint-preflight"]
)
def test_kill_9_of_the_service_leaves_the_controller_to_itself_and_the_job_resumes(here: Plantsite, stage: str) -> None:
    url = brought_into(here, stage)
    here.service.kill()
    deadline = time.monotonic() + BACK_WITHIN_S
    while not here.is_home() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert here.is_home()
    here.serve()
    job = here.until(url, lambda job: job["attempts"] == 2)
    assert job["state"] == "running" and here.http.get(f"/loops/{TAG}").json()["active_job"] == url
    assert here.http.post(f"{url}/abort").status_code == 202
    assert ended(here, url) == ("aborted", "operator")
    assert here.is_home()


@pytest.mark.on_vcan("fast-relay")
@pytest.mark.parametrize("stage", ["relay", "fast-relay"])
def test_sample_times_that_differ_and_a_wrong_action(here: Plantsite, stage: str) -> None:
    """A second pair beside the first, whose plant is held."""
    here.write("plant_samples_to_run", 0)
    own = ("--bus", here.bus, "--ts", "0.02", "--node")
    controller = here.launch(
        "direct", "loopwright.controller", *own, "0x21", "--plant-node", "0x11", "--channels", "2",
        "--kp", "80", "--ti", "1.2", "--direct",
    )  # fmt: skip
    controller.wait_ready()
    plant = here.launch(
        "plant2",
        "loopwright.plantsim",
        *own,
        "0x11",
        "--controller-node",
        "0x21",
        "--model",
        MODEL_14.model,
        "--speed",
        "max",
    )
    plant.wait_ready()
    try:
        url = here.retune("OTHER-TIME")
        assert ended(here, url) == ("refused", "device_mismatch")
        detail = here.job(url)["detail"]
        assert "0.02 s" in detail and "0.05 s" in detail
        assert here.is_home()
        # a loop that acts the wrong way runs away from rest: each procedure finds one just started
        url = here.retune("DIRECT", **STAGES[stage].options)
        assert ended(here, url) == ("refused", "wrong_sign")
    finally:
        plant.stop()
        controller.stop()


def test_a_controller_that_dies(here: Plantsite) -> None:
    """The last one: there is no controller after it."""
    url = here.in_stage(EARLY["fast"])
    here.controller.kill()
    state, reason = ended(here, url)
    assert state == "failed" and reason in ("node_lost", "samples_lost")
