"""A retune on a bad bus: whatever is lost, late or doubled, the job says so and the loop is as it was.

Live processes on the loopback hub, whose faults the test switches on in the middle of a stage.
"""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass

import pytest

from protocol.bus import open_bus
from protocol.profile import FOREVER, Mode, channel_ids, sdo_response_id
from tests.e2e.plantsite import MODEL_14, Plantsite
from tests.faults.faulty_hub import Fault, FaultyHub, well

pytestmark = pytest.mark.timeout(200)

PACE = 20.0
PLANT, CONTROLLER = 0x10, 0x20
PV = channel_ids(1, PLANT, CONTROLLER).pv
HOME_WITHIN_S = 6.0
"""Heartbeat and lease run out, and the restore's own patience is 4 s."""


@dataclass
class Site:
    hub: FaultyHub
    plant: Plantsite


@pytest.fixture(scope="module")
def processes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    hub = FaultyHub()
    thread = threading.Thread(target=hub.serve, daemon=True)
    thread.start()
    with ExitStack() as stack:
        stack.callback(hub.stop)
        yield Site(hub, Plantsite(stack, tmp_path_factory.mktemp("site"), MODEL_14, bus=hub.url))


@pytest.fixture
def site(processes: Site) -> Iterator[Site]:
    plant = processes.plant
    for name, value in (("controller_setpoint", MODEL_14.sp), ("plant_pace", 0.0), ("plant_samples_to_run", FOREVER)):
        plant.write(name, value)
    deadline = time.monotonic() + 30
    near = 0
    while near < 5:
        assert time.monotonic() < deadline, plant.state()
        near = near + 1 if abs(plant.state().pv - MODEL_14.sp) < 2e-4 else 0
        time.sleep(0.05)
    plant.write("plant_pace", PACE)
    yield processes
    processes.hub.fault = well


def in_baseline(site: Site) -> str:
    """A job whose loop is no longer as it was."""
    url = site.plant.retune()
    site.plant.until(url, lambda job: job["stage"] == "baseline" and job["plant_time_s"] > 6.0)
    return url


def is_home_in_time(site: Site) -> bool:
    deadline = time.monotonic() + HOME_WITHIN_S
    while not site.plant.is_home() and time.monotonic() < deadline:
        time.sleep(0.1)
    return site.plant.is_home()


def lost(share: float, seed: int = 1) -> Fault:
    dice = random.Random(seed)
    return lambda can_id: () if dice.random() < share else (0.0,)


def late(seconds: float) -> Fault:
    answers = (sdo_response_id(PLANT), sdo_response_id(CONTROLLER))
    return lambda can_id: (seconds,) if can_id in answers else (0.0,)


def down(can_id: int) -> Sequence[float]:
    return ()


@pytest.mark.parametrize(
    ("seconds", "reasons"),
    [
        (0.1, (None, "samples_lost")),
        (1.0, ("samples_lost", "node_lost", "device_went_back")),
        (10.0, ("node_lost", "restore_unconfirmed")),
    ],
)
def test_the_bus_is_down_for_a_while(site: Site, seconds: float, reasons: tuple[str | None, ...]) -> None:
    url = in_baseline(site)
    site.hub.fault = down
    time.sleep(seconds)
    site.hub.fault = well
    job = site.plant.finished(url)
    assert job["reason"] in reasons
    assert is_home_in_time(site)
    kept = site.plant.http.get(f"{url}/samples?stage=preflight").json()["t_s"]
    assert len(kept) >= 60


@pytest.mark.parametrize("share", [0.01, 0.1])
def test_frames_are_lost_at_random(site: Site, share: float) -> None:
    """The job grinds on through retries, or ends for want of answers; an operator can end it at any time."""
    url = in_baseline(site)
    site.hub.fault = lost(share)
    time.sleep(15)
    site.plant.http.post(f"{url}/abort")
    job = site.plant.finished(url)
    site.hub.fault = well
    assert (job["state"], job["reason"]) in (
        ("proposed", None),
        ("aborted", "operator"),
        ("failed", "samples_lost"),
        ("failed", "node_lost"),
        ("failed", "device_went_back"),
        ("failed", "restore_unconfirmed"),
    ), job
    assert is_home_in_time(site)


@pytest.mark.parametrize(("seconds", "states"), [(0.1, {"proposed"}), (5.0, {"failed"})])
def test_sdo_answers_come_late(site: Site, seconds: float, states: set[str]) -> None:
    url = in_baseline(site)
    site.hub.fault = late(seconds)
    job = site.plant.finished(url)
    site.hub.fault = well
    assert job["state"] in states, job
    assert is_home_in_time(site)


def test_every_frame_comes_twice(site: Site) -> None:
    url = in_baseline(site)
    site.hub.fault = lambda can_id: (0.0, 0.0)
    job = site.plant.finished(url)
    site.hub.fault = well
    assert (job["state"], job["reason"]) == ("proposed", None), job["detail"]
    assert site.plant.is_home()


@pytest.mark.parametrize(
    "frame",
    [
        (PV, b"\x00\x00\xc0\x7f\x01\x00\x00\x00"),  # not a number
        (PV, b"\x00"),
        (channel_ids(1, PLANT, CONTROLLER).command, b"\x00\x00\xc0\x7f"),
        (0x600 + CONTROLLER, b"\xff" * 8),
        (0x7FF, b""),
        (0x000, b"\x99\x00"),  # no such NMT command
    ],
)
def test_frames_that_make_no_sense_are_passed_over(site: Site, frame: tuple[int, bytes]) -> None:
    foreign = open_bus(site.hub.url)
    try:
        for _ in range(20):
            foreign.send(*frame)
            time.sleep(0.01)
    finally:
        foreign.close()
    assert site.plant.is_home()
    before = site.plant.read("sample_number")
    assert site.plant.state().pv == pytest.approx(50.0, abs=2e-3)
    assert site.plant.read("sample_number") > before


def test_a_foreign_node_puts_its_hand_on_the_controller(site: Site) -> None:
    """Other gains staged and tried by somebody else during the job: gone afterwards."""
    url = in_baseline(site)
    site.plant.write("controller_staged_kp", 999.0)
    site.plant.write("controller_parameter_command", 1)
    site.plant.http.post(f"{url}/abort")
    assert site.plant.finished(url)["state"] == "aborted"
    state = site.plant.state()
    assert (state.mode, state.gains.Kp, state.on_trial) == (Mode.AUTOMATIC, MODEL_14.kp, False)


def test_a_listener_that_never_reads_harms_nobody(site: Site) -> None:
    slow: Callable[[], None]
    listener = open_bus(site.hub.url)
    slow = listener.close
    try:
        url = site.plant.retune()
        assert site.plant.finished(url)["state"] == "proposed"
    finally:
        slow()
    assert site.plant.is_home()
