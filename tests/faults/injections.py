"""The faults. Each is a context: harm is done to a running job as it is entered, the job comes to its end inside, and
what is left of the harm is undone as it is left.

It gives how the loop must end, where that is not as it was found: an outside change has priority.
"""

from __future__ import annotations

import random
import shutil
import socket
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from dataclasses import replace

import httpx
from sqlalchemy import create_engine, text

from loopwright.protocol.bus import open_bus
from loopwright.protocol.profile import (
    CONTROLLER_NODE,
    HEARTBEAT_FRAME,
    NMT_FRAME,
    NMT_ID,
    PLANT_NODE,
    PV_FRAME,
    Cause,
    Mode,
    NmtCommand,
    NmtState,
    ParameterCommand,
    channel_ids,
    heartbeat_id,
    sdo_request_id,
    sdo_response_id,
)
from loopwright.protocol.station import Station
from loopwright.service.cli.child_process import NotReady
from loopwright.service.loops.bus_loop import BusLoop
from loopwright.service.store.backup import back_up, restore
from loopwright.tuning.reasons import Ended, Reason
from tests.e2e.plantsite import TAG
from tests.faults.ending import Home, unsafe
from tests.faults.faulty_hub import Fault, well
from tests.faults.stand import LOOP, Stand

Harm = Iterator[Home | None]
Injection = Callable[[Stand, str], AbstractContextManager[Home | None]]
"""Of the stand and the job's URL."""
LOCKED_S = 8.0
"""Longer than a request waits for the database."""
AWAY_S = 15.0
CLIENTS = 20
OTHER_TUNER = 0x7C
RECOVERING_S = 1.5
"""After its start a service is about to look for jobs that were left, or does."""
SOON_HOME_S = 3.0
SLOW_PACE = 0.5
NEXT_COMMAND_S = 2.0
"""A stage that commands nothing for so long will not do it soon: then the operator does not wait either."""
WAY_OUT_S = 0.3
OUT_OF_OPERATION_S = 2.0
OTHERS_OUTPUT = 3.0
"""Percent away from where the loop rests."""
LOAD_PCT = 90.0
"""Moves PV by far more than its limits are away."""
LEFT_NEAR = 3.0
"""Percent: a loop is opened where noise and the last test have left MV."""
_ANSWERS = (sdo_response_id(PLANT_NODE), sdo_response_id(CONTROLLER_NODE))


# people
@contextmanager
def aborted(stand: Stand, url: str) -> Harm:
    stand.site.http.post(f"{url}/abort")
    yield None


# processes
@contextmanager
def defect(stand: Stand, url: str) -> Harm:
    """An exception that nobody expects, at the next sample."""
    stand.defective.touch()
    yield None
    stand.defective.unlink()


@contextmanager
def service_killed(stand: Stand, url: str) -> Harm:
    stand.site.service.kill()
    stand.serve_again(url)
    yield None


@contextmanager
def service_stopped(stand: Stand, url: str) -> Harm:
    stand.site.service.stop()
    stand.serve_again(url)
    yield None


@contextmanager
def plant_killed(stand: Stand, url: str) -> Harm:
    stand.site.plant.kill()
    stand.site.start_plant()
    stand.site.plant.wait_ready()
    yield None


@contextmanager
def controller_killed(stand: Stand, url: str) -> Harm:
    stand.site.controller.kill()
    stand.site.start_controller()
    stand.site.controller.wait_ready()
    yield None


@contextmanager
def service_killed_twice(stand: Stand, url: str) -> Harm:
    """The second time while it looks for what the first one has left."""
    stand.site.service.kill()
    again = stand.site.launch_service()
    time.sleep(RECOVERING_S)
    again.kill()
    stand.serve_again(url)
    yield None


@contextmanager
def second_gateway(stand: Stand, url: str) -> Harm:
    """Ours is killed at a slow sample time, while another one beats on the same bus."""
    pace = stand.site.read("plant_pace")
    stand.site.write("plant_pace", LOOP.ts)  # a sample a second
    over = threading.Event()

    def beat() -> None:
        bus = open_bus(stand.hub.url)
        while not over.wait(0.1):
            bus.send(heartbeat_id(OTHER_TUNER), HEARTBEAT_FRAME.pack(NmtState.OPERATIONAL))
        bus.close()

    other = threading.Thread(target=beat)
    other.start()
    try:
        stand.site.service.kill()
        since = time.monotonic()
        while unsafe(stand.eye.glance(), stand.home):
            if time.monotonic() - since > SOON_HOME_S:
                stand.defects.append(f"not home {SOON_HOME_S:g} s after the kill")
                break
            time.sleep(0.05)
        stand.site.write("plant_pace", pace)
        stand.serve_again(url)
        yield None
    finally:
        over.set()
        other.join()


@contextmanager
def two_tuners(stand: Stand, url: str) -> Harm:
    """Another gateway wants the loop that is under test."""
    pace = stand.site.read("plant_pace")
    stand.site.write("plant_pace", SLOW_PACE)  # the job must not be over while the other one waits
    loop = BusLoop(stand.hub.url, CONTROLLER_NODE, PLANT_NODE, station=Station(OTHER_TUNER))
    try:
        loop.begin()
        stand.defects.append("a second tuner was given the loop")
    except Ended as ended:
        if ended.reason is not Reason.LOOP_IN_USE:
            stand.defects.append(f"the second tuner was told {ended}")
    finally:
        loop.close()
        stand.site.write("plant_pace", pace)
    yield None


@contextmanager
def second_service(stand: Stand, url: str) -> Harm:
    with ExitStack() as stack:
        if stand.server is None:
            second = stand.site.launch_service()
        else:  # another data folder, the same name: only the database can tell
            data, stand.site.data = stand.site.data, stand.folder / "another"
            second = stand.site.launch_service()
            stand.site.data = data
        stack.callback(second.stop)
        try:
            stand.defects.append(f"a second service was started: {second.wait_ready()}")
        except NotReady:
            status = second.stop()
            if status != 2:
                stand.defects.append(f"the second service ended with status {status}, not 2")
        yield None


def reset(node: int) -> Injection:
    def inject(stand: Stand, url: str) -> Harm:
        _send(stand, [(NMT_ID, NMT_FRAME.pack(NmtCommand.RESET_NODE, node))])
        yield None

    return contextmanager(inject)


# bus
def bus_down(seconds: float) -> Injection:
    def inject(stand: Stand, url: str) -> Harm:
        stand.hub.fault = lambda can_id: ()
        time.sleep(seconds)
        stand.hub.fault = well
        yield None

    return contextmanager(inject)


def frames(fault: Fault) -> Injection:
    """As long as the job lasts."""

    def inject(stand: Stand, url: str) -> Harm:
        stand.hub.fault = fault
        yield None
        stand.hub.fault = well

    return contextmanager(inject)


def lost(share: float, seed: int = 1) -> Fault:
    dice = random.Random(seed)
    return lambda can_id: () if dice.random() < share else (0.0,)


def late_answers(seconds: float) -> Fault:
    return lambda can_id: (seconds,) if can_id in _ANSWERS else (0.0,)


def twice(can_id: int) -> Sequence[float]:
    return (0.0, 0.0)


SENSELESS = (
    (channel_ids(1).pv, b"\x00"),
    (channel_ids(1).command, b"\x00\x00\xc0\x7f"),  # not a number
    (channel_ids(1).status, b"\x02"),
    (sdo_request_id(CONTROLLER_NODE), b"\xff" * 8),
    (sdo_request_id(PLANT_NODE), b""),
    (heartbeat_id(CONTROLLER_NODE), b""),
    (0x7FF, b""),
    (NMT_ID, b"\x99\x00"),  # no such command
)


@contextmanager
def senseless_frames(stand: Stand, url: str) -> Harm:
    for _ in range(20):
        _send(stand, SENSELESS)
        time.sleep(0.05)
    yield None


@contextmanager
def wrong_pv(stand: Stand, url: str) -> Harm:
    """A PV far out of range, then one that is no number, each in the place of the plant's next sample."""
    for value in (1e30, float("nan")):
        _send(stand, [(channel_ids(1).pv, PV_FRAME.pack(value, stand.hub.sample_number + 1))])
        time.sleep(0.2)
    yield None


@contextmanager
def foreign_gains(stand: Stand, url: str) -> Harm:
    """Tried by hand, and taken back when the job is over."""
    stand.site.write("controller_staged_kp", 999.0)
    stand.site.write("controller_parameter_command", ParameterCommand.TRY)
    stand.site.finished(url)
    stand.site.write("controller_parameter_command", ParameterCommand.GO_BACK)
    yield None


@contextmanager
def foreign_mode(stand: Stand, url: str) -> Harm:
    others = Mode.AUTOMATIC if stand.home.mode is Mode.MANUAL else Mode.MANUAL
    stand.site.write("controller_mode_command", others)
    yield replace(stand.home, mode=others, words="in their mode", mv=None)


def operators_off(samples: int) -> Injection:
    """So many samples after a command of the test."""

    def inject(stand: Stand, url: str) -> Harm:
        hub, give_up = stand.hub, time.monotonic() + NEXT_COMMAND_S
        before = hub.commanded
        while hub.commanded == before and time.monotonic() < give_up:
            time.sleep(0.001)
        while hub.sample_number < hub.commanded + samples and time.monotonic() < give_up:
            time.sleep(0.001)
        stand.site.write("controller_mode_command", Mode.OFF)
        yield replace(stand.home, mode=Mode.OFF, words="off")

    return contextmanager(inject)


@contextmanager
def off_on_the_way_out(stand: Stand, url: str) -> Harm:
    stand.site.http.post(f"{url}/abort")
    time.sleep(random.uniform(0.0, WAY_OUT_S))
    stand.site.write("controller_mode_command", Mode.OFF)
    yield replace(stand.home, mode=Mode.OFF, words="off")


@contextmanager
def pre_operational(stand: Stand, url: str) -> Harm:
    """By a third node, which starts the controller again in the end."""
    _send(stand, [(NMT_ID, NMT_FRAME.pack(NmtCommand.PRE_OPERATIONAL, CONTROLLER_NODE))])
    time.sleep(OUT_OF_OPERATION_S)
    _look_at_mv(stand)
    _send(stand, [(NMT_ID, NMT_FRAME.pack(NmtCommand.START, CONTROLLER_NODE))])
    yield None


@contextmanager
def pv_gone(stand: Stand, url: str) -> Harm:
    """No number, until the job is over."""
    stand.hub.pv_broken = True
    yield None
    _look_at_mv(stand)
    stand.hub.pv_broken = False


def pv_false(by: float | None) -> Injection:
    """PV is false within its limits from now on: it stands still, or is off by `by`."""

    def inject(stand: Stand, url: str) -> Harm:
        last, true = stand.hub.pv, stand.hub.shows or float
        stand.hub.shows = (lambda pv: last) if by is None else (lambda pv: true(pv) + by)
        yield replace(stand.home, mode=Mode.MANUAL, words="held in manual", mv=None)
        stand.hub.shows = None
        if abs(stand.eye.read("controller_manual_output") - (stand.home.mv or 0.0)) > LEFT_NEAR:
            stand.defects.append(f"held at MV {stand.eye.read('controller_manual_output')}, not near {stand.home.mv}")
        reason = stand.site.job(url)["reason"]
        if reason not in (Reason.PV_FROZEN, Reason.BAD_SAMPLE):
            stand.defects.append(f"PV was false, and the job ended as {reason}")
        answer = stand.site.http.post(f"/loops/{TAG}/retune", json={"by": "operator"})
        if (answer.status_code, answer.json().get("reason")) != (409, Reason.NOT_ACKNOWLEDGED):
            stand.defects.append(f"the next retune was answered with {answer.status_code} {answer.text}")
        if answer.status_code == 202:
            stand.site.http.post(f"{answer.headers['location']}/abort")
            stand.site.finished(answer.headers["location"])
        stand.site.http.post(f"/loops/{TAG}/acknowledge", json={"by": "operator"})

    return contextmanager(inject)


def _look_at_mv(stand: Stand) -> None:
    """Nothing controls: MV must be that of home."""
    seen = stand.eye.glance()
    mv = stand.home.mv
    if seen is None or abs(seen.plant_mv - (mv or 0.0)) > LEFT_NEAR:
        stand.defects.append(f"while nothing controls, MV is {seen and seen.plant_mv}, home's was about {mv}")


@contextmanager
def foreign_setpoint(stand: Stand, url: str) -> Harm:
    stand.site.write("controller_setpoint", 50.03)
    yield replace(stand.home, sp=50.03, words="on their set-point", mv=None)


@contextmanager
def foreign_output(stand: Stand, url: str) -> Harm:
    output = 50.0 + OTHERS_OUTPUT
    stand.site.write("controller_manual_output", output)
    yield replace(stand.home, words="with their manual output", output=output)


@contextmanager
def load(stand: Stand, url: str) -> Harm:
    """On the input of the plant, which takes PV over the limit of the job; the controller itself is to end the test."""
    stand.site.write("plant_disturbance", LOAD_PCT)
    yield None
    cause = Cause(int(stand.site.read("controller_cause")))
    if cause is not Cause.PV_LIMIT:
        stand.defects.append(f"the controller ended the session for {cause.name}, not for PV")
    stand.site.write("plant_disturbance", 0.0)


@contextmanager
def deaf_listener(stand: Stand, url: str) -> Harm:
    """Joins the bus and never reads."""
    with socket.create_connection(("127.0.0.1", stand.hub.port)) as listener:
        for word in (b"< open vcan0 >", b"< rawmode >"):
            listener.sendall(word)
            time.sleep(0.1)
        yield None


def _send(stand: Stand, each: Sequence[tuple[int, bytes]]) -> None:
    bus = open_bus(stand.hub.url)
    try:
        for can_id, data in each:
            bus.send(can_id, data)
    finally:
        bus.close()


# database, disk, clock
@contextmanager
def disk_full(stand: Stand, url: str) -> Harm:
    filler = stand.site.data / "filler"
    with filler.open("wb", buffering=0) as file:
        for size in (65536, 4096, 1):
            try:
                while True:
                    file.write(b"\0" * size)
            except OSError:
                continue
    if shutil.disk_usage(stand.site.data).free:
        raise AssertionError("the disk is not full")
    time.sleep(AWAY_S)
    filler.unlink()
    yield None


def database_locked(seconds: float) -> Injection:
    def inject(stand: Stand, url: str) -> Harm:
        with ExitStack() as stack:
            if stand.database is None:
                for name in ("loopwright.sqlite", "engine.sqlite"):
                    file = sqlite3.connect(stand.site.data / name, isolation_level=None, timeout=10.0)
                    other = stack.enter_context(closing(file))
                    other.execute("BEGIN EXCLUSIVE")
            else:
                engine = create_engine(stand.database.replace("postgresql:", "postgresql+psycopg:"))
                stack.callback(engine.dispose)
                connection = stack.enter_context(engine.begin())
                connection.execute(text("LOCK TABLE loops, jobs, events, sample_chunks IN ACCESS EXCLUSIVE MODE"))
            time.sleep(seconds)
        yield None

    return contextmanager(inject)


@contextmanager
def database_away(stand: Stand, url: str) -> Harm:
    """A server that is stopped as a power cut would; for a file, locks that last as long."""
    if stand.server is None:
        with database_locked(AWAY_S)(stand, url):
            pass
    else:
        stand.server.stop()
        time.sleep(AWAY_S)
        stand.server.start()
    yield None


@contextmanager
def restored_backup(stand: Stand, url: str) -> Harm:
    """A back-up made while the job ran is all that is left of the database."""
    copy = stand.folder / f"backup-{time.monotonic_ns()}"
    if stand.server is None:
        back_up(stand.site.data, copy)
    else:
        stand.server.tool("pg_dump", "--format=custom", f"--file={copy}", f"--dbname={stand.database}")
    stand.site.service.kill()
    if stand.server is None:
        restore(copy, stand.site.data, replace=True)
    else:
        stand.server.tool("pg_restore", "--clean", "--if-exists", f"--dbname={stand.database}", str(copy))
    stand.serve_again(url)
    yield None


@contextmanager
def clock_back(stand: Stand, url: str) -> Harm:
    stand.clock.write_text("-3600")
    yield None
    job = stand.site.job(url)
    if not job["ended_at"] < job["created_at"]:
        raise AssertionError("the clock was not set back")
    stand.clock.unlink()


# clients
@contextmanager
def random_clients(stand: Stand, url: str) -> Harm:
    """Each asks whatever comes to its mind, and at some moment wants the job to end."""
    over = threading.Event()

    def ask(dice: random.Random) -> None:
        wants_an_end = time.monotonic() + dice.uniform(0.5, 10.0)
        paths = (url, f"{url}/samples", f"{url}/events", "/jobs", "/loops", f"/loops/{TAG}", "/metrics", "/healthz")
        with stand.site.client() as client:
            while not over.is_set():
                try:
                    if time.monotonic() > wants_an_end:
                        client.post(f"{url}/abort")
                        wants_an_end += dice.uniform(0.5, 10.0)
                    else:
                        path = dice.choice(paths)
                        with client.stream("GET", path) as answer:
                            if path.endswith("/events") or dice.random() < 0.3:
                                next(answer.iter_raw(), None)  # and hangs up on the rest
                            else:
                                answer.read()
                except httpx.HTTPError as error:
                    stand.defects.append(f"{type(error).__name__}: {error}")
                time.sleep(dice.uniform(0.0, 0.2))

    threads = [threading.Thread(target=ask, args=(random.Random(seed),)) for seed in range(CLIENTS)]
    for thread in threads:
        thread.start()
    try:
        yield None
    finally:
        over.set()
        for thread in threads:
            thread.join()
