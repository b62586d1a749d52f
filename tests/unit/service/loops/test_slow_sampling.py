"""A loop whose samples are half a minute apart: its nodes answer at once, and so must an abort."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial

from fastapi.testclient import TestClient

from loopwright.controller.channel import Mode, Settings
from loopwright.controller.device import ControllerChannel, ControllerDevice
from loopwright.plantsim.catalogue import find
from loopwright.plantsim.device import PlantChannel, PlantDevice
from loopwright.protocol.bus import open_bus
from loopwright.protocol.station import Station
from loopwright.service.execution.procedures import tune
from loopwright.service.server.assembly import make_jobs
from loopwright.service.server.serving import open_bus_loop
from tests.unit.service.apps import app_of
from tests.unit.service.bus_site import FOUND
from tests.unit.service.fakes import TAG, Service, ThreadEngine, fake_rehearse

TS_S = 30.0
PATIENCE_S = 60.0


@contextmanager
def devices(url: str) -> Iterator[ControllerDevice]:
    """Plant and controller of one loop, in a thread, by the wall clock."""
    buses = [open_bus(url) for _ in range(2)]
    plant = PlantDevice(buses[0], [PlantChannel(find("fopdt").build)], TS_S)
    laws = [ControllerChannel(FOUND, 50.0, Settings(pv_low=40.0, pv_high=60.0), Mode.AUTOMATIC)]
    controller = ControllerDevice(buses[1], laws, TS_S)
    over = threading.Event()

    def work() -> None:
        controller.start()
        plant.start()
        while not over.is_set():
            plant.runtime.poll(0.001)
            controller.runtime.poll(0.001)

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield controller
    finally:
        over.set()
        thread.join()
        for bus in buses:
            bus.close()


def until(wanted: Callable[[], object]) -> None:
    give_up = time.monotonic() + PATIENCE_S
    while not wanted():
        assert time.monotonic() < give_up
        time.sleep(0.01)


def test_an_abort_does_not_wait_for_the_next_sample(service: Service) -> None:
    station = Station(listen_s=0.0)
    service.jobs.stop()  # one of them at a time hears what is wanted of this host's jobs
    loops = {TAG: service.loops[TAG].model_copy(update={"t95_s": 30 * TS_S})}
    with devices("virtual:test") as controller, ExitStack() as stack:
        open_loop = partial(open_bus_loop, station)
        jobs = make_jobs(loops, service.store, open_loop, tune, fake_rehearse, engine=ThreadEngine())
        stack.callback(jobs.stop)
        jobs.boot()
        client = TestClient(app_of(jobs, checks={}), base_url="http://127.0.0.1")
        url = client.post(f"/loops/{TAG}/retune", json={"by": "me"}).json()["url"]
        until(lambda: controller.sessions[0].is_open)
        until(lambda: client.get(url).json()["stage"] is not None)
        began = time.monotonic()
        assert client.post(f"{url}/abort").status_code == 202
        until(lambda: not controller.sessions[0].is_open)
        took = time.monotonic() - began
        until(lambda: client.get(url).json()["state"] != "running")
        job = client.get(url).json()
    print(f"in effect after {took:.2f} s at a sample time of {TS_S:g} s")
    assert (job["state"], job["reason"]) == ("aborted", "operator") and job["restored"]
    assert took < TS_S / 3  # 1 s is wanted; a busy machine takes its time, a wait for the sample takes longer
