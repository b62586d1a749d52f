"""The watch after an acceptance in simulated time: what it hears, its thread as a task, and what may not come of it.

What is heard are the frames that reach a port of the gateway's; what the listener reads of a loop by SDO beside it is
looked up in the controller, while the bus is up. The wall clock of the watch is that of the simulation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from loopwright.protocol.profile import CONTROLLER_NODE, PLANT_NODE, channel_ids
from loopwright.service.jobs import watching
from loopwright.service.jobs.manager import Jobs
from loopwright.service.jobs.watching import BY, Watching
from loopwright.service.listening.heard_loop import Heard, HeardLoop, InEffect
from loopwright.service.listening.listening import History
from loopwright.service.observing import accepted_operation
from loopwright.service.states.job_state import JobState
from loopwright.service.store import watches
from loopwright.service.store.clock import stamp
from loopwright.service.store.jobs import Job
from loopwright.tuning.gains import Gains
from tests.simulation.gateway import Gateway
from tests.simulation.invariants import real32
from tests.simulation.scheduler import START, Process
from tests.simulation.wire import Port, State

if TYPE_CHECKING:
    from tests.simulation.history import World

LOAD_PCT = 120.0
"""Takes PV out of its limits, whatever MV is."""
GAIN = 3.0
"""So many times as large, the plant oscillates with growing swings."""


class SimListening:
    """The listener of a service, and what it has heard since it started."""

    def __init__(self, world: World, process: Process) -> None:
        self._world = world
        self._loop = HeardLoop()
        self._read: tuple[Gains, float] | None = None
        pv, mv, status, _ = channel_ids(1, PLANT_NODE, CONTROLLER_NODE)
        self._take = {pv: self._loop.take_pv, mv: self._loop.take_mv, status: self._loop.take_status}
        self._port = Port(world.wire, process, self._arrived)
        self._port.wanted = frozenset(self._take)

    def _arrived(self) -> None:
        while self._port.inbox:
            can_id, data = self._port.inbox.popleft()[:2]
            self._take[can_id](bytes(data), self._world.wall_s)

    @property
    def heard(self) -> dict[str, Heard]:
        now_s, controller = self._world.wall_s, self._world.controller
        if self._loop.to_read(now_s) and controller.is_on and self._world.wire.state is State.UP:
            channel = controller.device.sessions[0].channel
            gains = None if channel.on_trial else astuple(channel.accepted)
            mode, sample_time_s = int(channel.mode), self._world.loop.sample_time_s
            found = InEffect(now_s, channel.setpoint, mode, channel.on_trial, gains, sample_time_s)
            self._loop.learn(found, now_s)
            if gains is not None:
                self._read = Gains(*gains), now_s
        latest = self._loop.latest(now_s)
        return {} if latest is None else {"L": latest}

    def why_not_heard(self, tag: str) -> str | None:
        return None if self._world.wire.state is State.UP else "the bus is down"

    def gains_read_since(self, tag: str, since_s: float) -> Gains | None:
        return self._read[0] if self._read is not None and self._read[1] > since_s else None

    def history(self, tag: str, from_s: float, to_s: float, points: int) -> History:
        return History(self._loop.rings.rows(from_s, to_s, points), self.why_not_heard(tag))


def watched(world: World, gateway: Gateway, upset: Callable[[], None], until_s: float) -> None:
    """Every start of the service has a watch; some time after the acceptance something goes wrong under the new gains,
    and is over when the watch has decided, or after so many s."""
    simulation = world.simulation
    tell_time(world)

    def boot(jobs: Jobs, process: Process) -> None:
        looks = Watching(
            gateway.store, jobs.directory, jobs.decisions, SimListening(world, process), None,
            lambda: world.wall_s, lambda: world.wall_s,
        )  # type: ignore[arg-type]  # fmt: skip

        def look() -> None:
            while True:
                process.step("watch")
                assert simulation.task is not None
                simulation.task.pause(1.0)
                looks.look()

        task = process.start(look, "watch")

        def over() -> None:
            if task.error is not None:
                raise task.error

        task.on_done.append(over)

    gateway.on_boot = boot
    moved = gateway.store.after_move

    def after_move(row: Job, state: JobState) -> None:
        if moved is not None:
            moved(row, state)
        if state is JobState.ACCEPTED:
            world.trouble(simulation.now - START + until_s + 2.0)
            simulation.after(world.random.uniform(2.0, 5.0), upset)
            simulation.after(until_s, world.calm_plant)
        elif state is JobState.ROLLED_BACK:
            in_turn(world, gateway, row)

    gateway.store.after_move = after_move
    world.at_the_end.append(lambda: agrees(world, gateway))


def in_turn(world: World, gateway: Gateway, row: Job) -> None:
    """Previous gains that the watch has put back came right after the accepted ones, of all that the controller held:
    they were written, and not over gains that somebody else had set."""
    found = watches.of_jobs(gateway.store, [row.id]).get(row.id)
    if found is None or found.trouble is None:
        return
    sets = [each.accepted for each in world.invariants.held]
    runs = [one for one, before in zip(sets, [None, *sets], strict=False) if one != before]
    accepted = max((at for at, each in enumerate(runs) if each.Kp == real32(world.proposed.Kp)), default=len(runs))
    if runs[accepted + 1 : accepted + 2] != [world.home_gains]:
        world.invariants.say(f"put back, it says: after the accepted gains the controller held {runs[accepted + 1 :]}")


def agrees(world: World, gateway: Gateway) -> None:
    """What the watches say at the end is what has come."""
    for row in gateway.rows():
        watch = watches.of_jobs(gateway.store, [row.id]).get(row.id)
        if watch is None or watch.trouble is None:
            continue
        put_back = bool(watch.trouble.rolled_back)
        if put_back and row.state is not JobState.ROLLED_BACK:
            world.invariants.say(f"the watch says that it put gains back, and the job is {row.state}")
        if watch.trouble.rolled_back is None and gateway.is_up and row.state is JobState.ACCEPTED:
            world.invariants.say("the watch has not decided: in the time it has for it")
        if put_back or row.state is JobState.ACCEPTED:
            world.simulation.note("watch", f"{watch.trouble.kind}, put back {put_back}: {watch.trouble.reason}")
    world.simulation.note("watch", f"over, {BY}")


def tell_time(world: World) -> None:
    """What a watch notes is in the time of the simulation, until the history ends."""
    modules = (watching, accepted_operation, watches)
    before = [module.now for module in modules]
    for module in modules:
        module.now = lambda: stamp(datetime.fromtimestamp(world.wall_s, UTC))  # type: ignore[attr-defined]

    def restore() -> None:
        for module, now in zip(modules, before, strict=True):
            module.now = now  # type: ignore[attr-defined]

    world.closing.append(restore)
