"""What goes wrong, each drawn from the seed of the history."""

from __future__ import annotations

import math
import struct
from typing import Any

from loopwright.protocol.profile import (
    CONTROLLER_NODE,
    PLANT_NODE,
    NmtCommand,
    OnMissingAnswer,
    channel_ids,
    sdo_request_id,
)
from loopwright.service.inputs.config import Limits
from loopwright.service.inputs.model_json import FirstOrderModel
from loopwright.service.inputs.request import RetuneRequest, retune_request
from tests.simulation import manual_pulses, plans, watched
from tests.simulation.gateway import Gateway
from tests.simulation.history import World
from tests.simulation.people import Operator, Plc, Stranger
from tests.simulation.scheduler import Process
from tests.simulation.wire import Faults, State

RESTARTS_S = (0.05, 0.3, 0.5, 2.0, 6.0)
PV_ID = channel_ids(1, PLANT_NODE, CONTROLLER_NODE).pv


def one_job(world: World, **more: Any) -> Gateway:
    gateway = world.gateway()
    world.person(gateway, 0.5 + 0.3 * world.random.random(), **more)
    return gateway


def moment(world: World) -> float:
    """A time while the job is at work, most likely; s after the start."""
    return 0.8 + world.listen_s + world.random.random() * (world.plan_s + 1.0)


# -- of the services


def killed(world: World, gateway: Gateway, times: int | None = None, never: float = 0.06) -> None:
    """Before a step of a drawn number, counted from each start; then started again, or never."""
    random = world.random
    times = times or random.choices((1, 2, 3), (40, 40, 20))[0]
    at = [random.randint(1, random.choice((60, 400, 400, 1500))) for _ in range(times)]
    back = [None if random.random() < never else random.choice(RESTARTS_S) for _ in range(times)]
    deaths = iter(back)
    before = gateway.on_start

    def start(process: Process) -> None:
        before(process)
        if gateway.starts <= times:
            process.kill_at = at[gateway.starts - 1]

    gateway.on_start = start
    gateway.restart_after = lambda: next(deaths, 0.5)


def killed_at(world: World, gateway: Gateway, at_s: float, back_s: float | None) -> None:
    """From outside, at a time, also while it waits."""
    world.trouble(at_s)
    world.simulation.after(at_s, _kill, gateway, back_s)


def _kill(gateway: Gateway, back_s: float | None) -> None:
    if gateway.process is not None and gateway.process.alive:
        gateway.restart_after = lambda: back_s
        gateway.process.kill()


def told_to_end(world: World, gateway: Gateway, at_s: float) -> None:
    """SIGTERM: every job brings its loop home, then the process ends; started again."""
    simulation = world.simulation

    def over() -> None:
        process, jobs = gateway.process, gateway.jobs
        if process is None or jobs is None or not process.alive:
            return
        if jobs.under_test():
            simulation.after(0.1, over)
        else:
            gateway.restart_after = lambda: 1.0
            process.kill()

    def now() -> None:
        if gateway.jobs is not None:
            simulation.note(gateway.name, "is told to end")
            gateway.jobs.request_stop()
            over()

    world.trouble(at_s)
    simulation.after(at_s, now)


def maybe_killed(world: World, gateway: Gateway, chance: float = 0.5) -> None:
    if world.random.random() < chance:
        killed(world, gateway, world.random.choice((1, 1, 2)))


def stalls(world: World, gateway: Gateway) -> None:
    """Of the service before a step, of the controller, of the plant."""
    world.quiet = False
    random = world.random
    for _ in range(random.randint(1, 3)):
        seconds = random.choice((0.3, 0.8, 1.2, 3.0, 8.0)) * random.uniform(0.8, 1.2)
        who = random.choice(("service", "service", "controller", "plant"))
        if who == "service":
            step = random.randint(1, 900)
            before = gateway.on_start

            def start(process: Process, before: Any = before, step: int = step, seconds: float = seconds) -> None:
                before(process)
                process.stalls[step] = seconds

            gateway.on_start = start
        else:
            node = world.controller if who == "controller" else world.plant
            at = moment(world)
            world.trouble(at + seconds + 0.5)
            world.simulation.after(at, node.freeze, seconds)


# -- of the bus


def frames(world: World) -> None:
    world.quiet = False
    random = world.random
    bad = Faults(
        lost=random.choice((0.0, 0.01, 0.1)),
        doubled=random.choice((0.0, 0.1)),
        late=random.choice((0.0, 0.02)),
        late_s=random.choice((0.05, 0.3, 1.0)),
    )
    until = world.plan_s + random.uniform(1.0, 6.0)

    def over() -> None:
        world.wire.faults = None
        world.clean_since = world.simulation.now

    world.wire.faults = bad
    world.trouble(until + 1.0)
    world.simulation.after(until, over)


def away(world: World, states: tuple[State, ...] = (State.AWAY, State.HELD, State.DOWN), times: int = 0) -> None:
    world.quiet = False
    random = world.random
    at = 0.0
    for _ in range(times or random.randint(1, 3)):
        at = max(at, moment(world)) if not at else at + random.uniform(0.1, 4.0)
        seconds = random.choice((0.05, 0.3, 1.0, 2.0, 5.0, 12.0)) * random.uniform(0.7, 1.3)
        world.simulation.after(at, world.wire.set_state, random.choice(states))
        world.simulation.after(at + seconds, world.wire.set_state, State.UP)
        world.trouble(at + seconds)
        at += seconds


def held_while_dead(world: World, gateway: Gateway) -> None:
    """The service dies while the bus holds its frames back; they come when it is dead, or has been started again."""
    world.quiet = False
    random = world.random
    at = moment(world)
    dies = at + random.uniform(0.001, 0.4)
    world.simulation.after(at, world.wire.set_state, State.HELD)
    killed_at(world, gateway, dies, random.choice((None, 0.3, 1.5)))
    lets_go = dies + random.choice((0.05, 0.5, 1.2, 2.5, 8.0))
    world.simulation.after(lets_go, world.wire.set_state, State.UP)
    world.trouble(lets_go + 0.2)


# -- of the devices


def restarts(world: World) -> None:
    """Switched off and on again; with keep, the disk is what is left."""
    world.quiet = False
    random = world.random
    for _ in range(random.randint(1, 2)):
        at, seconds = moment(world), random.choice((0.05, 0.5, 2.0, 5.0))
        if random.random() < 0.65:
            world.simulation.after(at, world.power_off_controller)
            world.simulation.after(at + seconds, world.power_on_controller)
        else:
            world.simulation.after(at, world.plant.power_off)
            world.simulation.after(at + seconds, world.plant.power_on)
        world.trouble(at + seconds + 0.1)


def nmt(world: World) -> None:
    world.quiet = False
    random = world.random
    third = Stranger(world)
    for _ in range(random.randint(1, 2)):
        at = moment(world)
        command = random.choice(
            (
                NmtCommand.STOP, NmtCommand.PRE_OPERATIONAL, NmtCommand.PRE_OPERATIONAL, NmtCommand.RESET_NODE,
                NmtCommand.RESET_COMMUNICATION,
            )
        )  # fmt: skip
        node = random.choice((CONTROLLER_NODE, CONTROLLER_NODE, PLANT_NODE, 0))
        third.nmt(at, command, node)
        if command in (NmtCommand.STOP, NmtCommand.PRE_OPERATIONAL) and random.random() < 0.8:
            third.nmt(at + random.choice((0.2, 1.0, 3.0, 8.0)), NmtCommand.START, node)


def pv_gone(world: World) -> None:
    """No number, far off, standing still, or silent; for a while or for good."""
    world.quiet = False
    random = world.random
    at, seconds = moment(world), random.choice((0.3, 1.5, 4.0, 8.0)) * random.uniform(0.7, 1.3)
    how = random.choice(("no number", "far", "still", "silent", "silent", "lost"))
    for_good = random.random() < 0.3
    simulation = world.simulation

    def begin() -> None:
        simulation.note("sensor", f"PV is {how}")
        if how == "no number":
            world.plant.sensor.shows = math.nan
        elif how == "far":
            world.plant.sensor.shows = 1e4
        elif how == "still":
            world.plant.sensor.shows = struct.unpack("<f", struct.pack("<f", world.plant.device.plants[0].pv))[0]
        elif how == "silent":
            world.wire.blocked = frozenset({PV_ID})
        else:
            world.wire.cut.add(("controller", PV_ID))

    def over() -> None:
        simulation.note("sensor", "PV is back")
        world.plant.sensor.shows = None
        world.wire.blocked = frozenset()
        world.wire.cut.clear()

    simulation.after(at, begin)
    world.trouble(at + 3.0 * max(1.0, world.loop.wall_s) + 1.0)
    if not for_good:
        simulation.after(at + seconds, over)
        world.trouble(at + seconds)
    if random.random() < 0.3:
        world.plant.on_missing = random.choice((OnMissingAnswer.STOP_RUN, OnMissingAnswer.SAFE_OUTPUT))


def power(world: World) -> None:
    """The power of the controller fails, in the middle of a write of its disk as well."""
    world.quiet = False
    random = world.random
    world.loop.keep = world.controller.keep = True
    disk = world.controller.disk
    if random.random() < 0.7:
        disk.cut_at = random.randint(1, 3)
        seconds = random.choice((0.2, 2.0, 5.0))

        def again() -> None:
            if not world.controller.is_on:
                world.invariants.off_at = min(world.invariants.off_at or world.simulation.now, world.simulation.now)
                world.power_on_controller()

        off = world.controller.power_off

        def power_off() -> None:
            was_on = world.controller.is_on
            off()
            if was_on:
                world.invariants.off_at = world.simulation.now
                world.clean_since = world.simulation.now + seconds
                world.simulation.after(seconds, again)

        world.controller.power_off = power_off  # type: ignore[method-assign]
    if random.random() < 0.3:
        at = moment(world)
        world.simulation.after(at, setattr, disk, "full", True)
        world.simulation.after(at + 3.0, setattr, disk, "full", False)
        world.trouble(at + 3.0)
    if random.random() < 0.5:
        restarts(world)


# -- of others


def operator(world: World, times: int = 0) -> None:
    random = world.random
    Operator(world, sorted(moment(world) for _ in range(times or random.randint(1, 3))), random)


def plc(world: World) -> None:
    random = world.random
    changes = [moment(world) for _ in range(random.choice((0, 0, 1, 3)))]
    Plc(world, random.choice((0.1, 0.5, 1.0)), world.plan_s + 4.0, changes, random)


def stranger(world: World) -> None:
    """Orders, stagings and renewals that are not its own, and the tuner's frames once more."""
    random = world.random
    third = Stranger(world)
    third.listens(sdo_request_id(CONTROLLER_NODE))
    for _ in range(random.randint(1, 12)):
        third.repeats(moment(world), random)
    for _ in range(random.randint(0, 4)):
        index = random.choice((0x2132, 0x2136, *range(0x2139, 0x213E), *range(0x2148, 0x2158), *range(0x2160, 0x2178)))
        data = struct.pack("<BHB", 0x23, index, 1) + random.choice(
            (struct.pack("<f", random.uniform(0.0, 60.0)), struct.pack("<I", random.getrandbits(32)))
        )
        third.send(moment(world), sdo_request_id(CONTROLLER_NODE), data, f"writes {index:04X}h")


def person_aborts(world: World) -> float | None:
    return world.random.uniform(0.1, world.plan_s + 1.0) if world.random.random() < 0.15 else None


# -- whole histories


def calm(world: World) -> None:
    gateway = one_job(world, abort_s=person_aborts(world))
    if world.random.random() < 0.3:
        told_to_end(world, gateway, moment(world))


def kills(world: World) -> None:
    killed(world, one_job(world, abort_s=person_aborts(world)))


def bad_frames(world: World) -> None:
    frames(world)
    maybe_killed(world, one_job(world))


def bus_away(world: World) -> None:
    gateway = one_job(world)
    away(world)
    maybe_killed(world, gateway, 0.4)


def held(world: World) -> None:
    held_while_dead(world, one_job(world))


def stalling(world: World) -> None:
    gateway = one_job(world)
    stalls(world, gateway)
    maybe_killed(world, gateway, 0.3)


def restarting(world: World) -> None:
    gateway = one_job(world)
    restarts(world)
    maybe_killed(world, gateway, 0.3)


def third_node(world: World) -> None:
    gateway = one_job(world)
    nmt(world)
    maybe_killed(world, gateway, 0.3)


def two_tuners(world: World) -> None:
    """Two gateways of their own node-IDs on one loop; one of them may be killed."""
    random = world.random
    first, second = world.gateway(), world.gateway(0x7B)
    world.person(first, 0.5 + random.random() * 0.2)
    world.person(second, 0.5 + random.random() * random.choice((0.2, 1.0, world.plan_s + 4.0)))
    if random.random() < 0.6:
        killed(world, random.choice((first, second)), random.choice((1, 1, 2)), never=0.4)


def operators(world: World) -> None:
    gateway = one_job(world, abort_s=person_aborts(world))
    operator(world)
    if world.random.random() < 0.3:
        plc(world)
    maybe_killed(world, gateway, 0.2)


def cascade(world: World) -> None:
    """A PLC that sends the set-point by RPDO, with or without moving it."""
    gateway = one_job(world)
    plc(world)
    if world.random.random() < 0.4:
        operator(world, 1)
    maybe_killed(world, gateway, 0.2)


def no_pv(world: World) -> None:
    gateway = one_job(world)
    pv_gone(world)
    if world.random.random() < 0.4:
        frames(world)
    maybe_killed(world, gateway, 0.2)


def false_pv(world: World) -> None:
    """PV becomes false within its limits, the job finds that out, and one of all that happens about then."""
    random, simulation, sensor = world.random, world.simulation, world.plant.sensor
    at = moment(world)
    stays_s = random.choice((math.inf, math.inf, math.inf, 3.0, 12.0 * world.loop.wall_s))
    shown = random.choice((None, 35.0, 62.5))

    def begin() -> None:
        simulation.note("sensor", "PV is false")
        present = world.plant.device.plants[0].pv if shown is None and world.plant.is_on else shown or 50.0
        sensor.shows = struct.unpack("<f", struct.pack("<f", min(max(present, 25.0), 75.0)))[0]

    def over() -> None:
        simulation.note("sensor", "PV is true")
        sensor.shows = None

    world.tune = plans.tunes(world.actions, lambda: sensor.shows is not None)
    simulation.after(at, begin)
    found = at + (plans.FALSE_SAMPLES + 2) * world.loop.wall_s
    world.trouble(found)
    if math.isfinite(stays_s):
        simulation.after(at + stays_s, over)
        world.trouble(at + stays_s)
    gateway = one_job(world, abort_s=person_aborts(world))
    what = random.choice(
        (None, "kills", "kills", "killed", "killed held", "killed held", "frames", "away", "stalls", "restarts",
         "power", "nmt", "operator", "operator", "operator", "stranger", "pv", "term")
    )  # fmt: skip
    match what:
        case "kills":
            killed(world, gateway)
        case "killed":
            killed_at(world, gateway, random.uniform(at, found + 0.3), random.choice((None, *RESTARTS_S)))
        case "killed held":
            after_s, back_s = random.choice((0.0, 0.001, 0.005, 0.03, 0.1)), random.choice((None, *RESTARTS_S))
            world.invariants.on_hold = lambda: simulation.after(after_s, _kill, gateway, back_s)
        case "frames":
            frames(world)
        case "away":
            away(world)
        case "stalls":
            stalls(world, gateway)
        case "restarts":
            restarts(world)
        case "power":
            power(world)
        case "nmt":
            nmt(world)
        case "operator":
            Operator(world, sorted(random.uniform(at, found + 2.0) for _ in range(random.randint(1, 3))), random)
        case "stranger":
            stranger(world)
        case "pv":
            pv_gone(world)
        case "term":
            told_to_end(world, gateway, random.uniform(at, found + 0.5))
    if what not in ("kills", "killed", "killed held"):
        maybe_killed(world, gateway, 0.2)


def strangers(world: World) -> None:
    gateway = one_job(world)
    stranger(world)
    maybe_killed(world, gateway, 0.4)


def decisions(world: World) -> None:
    """Acceptance and rollback, cut anywhere and asked again."""
    random = world.random
    world.actions = (plans.Action("relay", 0.1, 4), plans.Action("setpoint", 0.2, 2))
    world.tune = plans.tunes(world.actions)
    world.plan_s = 6 * world.loop.wall_s + 0.6
    gateway = world.gateway()
    chosen = random.choice((("accept",), ("accept", "rollback"), ("accept", "rollback"), ("rollback",)))
    world.person(gateway, 0.5, decisions=chosen, tries=8)
    if random.random() < 0.8:
        killed(world, gateway, random.choice((1, 2, 3)), never=0.03)
    what = random.random()
    if what < 0.25:
        frames(world)
    elif what < 0.4:
        power(world)
    elif what < 0.5:
        world.plan_s += 2.0
        operator(world, random.randint(1, 2))
    elif what < 0.6:
        world.plan_s += 2.0
        restarts(world)


def after_acceptance(world: World) -> None:
    """Something goes wrong under gains that were accepted, and one of all that happens until the watch has decided."""
    random = world.random
    world.pv_limits = Limits(low=20.0, high=80.0)
    world.time_constant, world.dead_time = 6.0, 8.0
    world.actions = (plans.Action("setpoint", 0.1, 3),)
    world.tune = plans.tunes(world.actions)
    world.plan_s = 14.0
    gateway = world.gateway()
    load, gain = random.choice(((watched.LOAD_PCT, 1.0), (watched.LOAD_PCT, 1.0), (1.0, watched.GAIN)))
    watched.watched(world, gateway, lambda: world.upset_plant(load, gain), until_s=14.0)
    world.person(gateway, 0.5, decisions=random.choice((("accept",), ("accept",), ("accept", "rollback"))), tries=8)
    what = random.choice(
        (None, "kills", "killed", "killed", "frames", "away", "restarts", "power", "operator", "gains", "gains", "nmt")
    )
    if what == "kills":
        killed(world, gateway, never=0.0)
    elif what == "killed":
        killed_at(world, gateway, random.uniform(4.0, 14.0), random.choice(RESTARTS_S))
    elif what == "frames":
        frames(world)
    elif what == "away":
        away(world)
    elif what == "restarts":
        restarts(world)
    elif what == "power":
        power(world)
    elif what == "operator":
        operator(world, random.randint(1, 3))
    elif what == "gains":
        Operator(world, sorted(random.uniform(3.0, 10.0) for _ in range(4)), random, ("gains",))
    elif what == "nmt":
        nmt(world)


def power_cuts(world: World) -> None:
    random = world.random
    world.actions = plans.draw(random, max(4, world.loop.samples // 4))
    world.tune = plans.tunes(world.actions)
    world.plan_s = world.plan_s / 4 + 1.0
    gateway = world.gateway()
    world.person(gateway, 0.5, decisions=("accept", "rollback")[: random.randint(1, 2)], tries=8)
    power(world)
    if random.random() < 0.5:
        operator(world, random.randint(1, 2))
    maybe_killed(world, gateway, 0.2)


def everything(world: World) -> None:
    random = world.random
    gateway = one_job(world, decisions=("accept", "rollback")[: random.randint(0, 2)], abort_s=person_aborts(world))
    also = [frames, away, restarts, nmt, pv_gone, operator, plc, stranger, power, lambda it: stalls(it, gateway)]
    for what in random.sample(also, random.randint(2, 4)):
        what(world)
    maybe_killed(world, gateway)


# -- real procedures


def _real(world: World, request: RetuneRequest, takes_s: float, also: tuple[str, ...] = ()) -> None:
    random = world.random
    loop = world.loop
    world.tune = plans.real
    world.request = request
    world.plan_s = takes_s
    gateway = one_job(world, decisions=("accept", "rollback")[: random.randint(0, 2)])
    what = random.choice((None, "kills", "kills", "operator", "pv", "frames", "restarts", "nmt", "away", *also))
    if what == "kills":
        killed(world, gateway)
    elif what == "operator":
        operator(world)
    elif what == "pv":
        pv_gone(world)
    elif what == "frames":
        frames(world)
    elif what == "restarts":
        restarts(world)
    elif what == "nmt":
        nmt(world)
    elif what == "away":
        away(world)
    elif what == "plc":
        plc(world)
    assert loop.wall_s <= 0.2


def real_fast(world: World) -> None:
    _real(world, retune_request(method="fast", verify=world.random.random() < 0.7), 500 * world.loop.wall_s)


def real_setpoint(world: World) -> None:
    request = retune_request(method="setpoint", verify=world.random.random() < 0.7)
    _real(world, request, 400 * world.loop.wall_s, ("plc",))


def real_manual(world: World) -> None:
    """In a phase of a pulse, mostly."""
    if world.random.random() < 0.6:
        manual_pulses.drawn(world)
    else:
        manual_pulses.expect(world)
        _real(world, world.request, world.plan_s)


def real_five_stage(world: World) -> None:
    world.time_constant, world.dead_time = 36.0, 9.0  # in samples: the procedure asks for more of them per period
    _real(world, retune_request(method="five-stage"), 6000 * world.loop.wall_s)


def real_trial(world: World) -> None:
    Ts = world.loop.sample_time_s
    model = FirstOrderModel(K=1.0, T_s=world.time_constant * Ts, L_s=world.dead_time * Ts)
    _real(world, retune_request(method="fast", start="design", model=model), 300 * world.loop.wall_s)
