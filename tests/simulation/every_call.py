"""One job that does everything, killed at each of its calls of the bus in turn, and started again after a while."""

from __future__ import annotations

from collections.abc import Iterator

from loopwright.protocol.profile import Mode
from tests.simulation import plans
from tests.simulation.history import Ending, Loop, World
from tests.simulation.scheduler import Process

KIND = "every call"
BUS = ("open", "send", "receive", "sleep")
CHANGES = ("open", "send", "commit", "engine")
"""After these, somebody else finds something that was not there before."""
RESTARTS_S = (0.05, 0.5, 2.0, 6.0)


def the_job(kill_at: int | None = None, back_s: float = 0.5, keeps_log: bool = False) -> World:
    loop = Loop(0.1, 10.0, Mode.AUTOMATIC, 50.0, 50.0, 0.01, False, 40)
    world = World(KIND, kill_at or 0, loop, keeps_log)
    world.listen_s = 0.0
    world.actions = plans.EVERYTHING
    world.tune = plans.tunes(world.actions)
    gateway = world.gateway()
    world.person(gateway, 0.3, decisions=("accept", "rollback"))
    before = gateway.on_start

    def start(process: Process) -> None:
        before(process)
        if gateway.starts == 1:
            process.kill_at = kill_at

    gateway.on_start = start
    gateway.restart_after = lambda: back_s
    return world


def calls(that_differ: bool = False) -> list[int]:
    """The steps of the undisturbed job that are calls of the bus. that_differ: of those between which nothing is sent
    or stored, which leave bus and disk as they were, the first alone."""
    world = the_job()
    found: list[int] = []
    differs = True
    gateway = world.gateways[0]
    before = gateway.on_start

    def start(process: Process) -> None:
        def step(what: str) -> None:
            nonlocal differs
            if what in BUS and (differs or not that_differ):
                found.append(process.steps)
                differs = False
            differs = differs or what in CHANGES

        before(process)
        process.on_step = step

    gateway.on_start = start
    ending = world.run()
    assert not ending.bad and ending.ending == "rolled_back", (ending.bad, ending.jobs)
    return found


def todo(restarts_s: tuple[float, ...] = RESTARTS_S, that_differ: bool = False) -> Iterator[tuple[int, float]]:
    for at in calls(that_differ):
        for back_s in restarts_s:
            yield at, back_s


def play(which: tuple[int, float]) -> Ending:
    kill_at, back_s = which
    ending = the_job(kill_at, back_s).run()
    ending.kind, ending.seed = f"every call, back after {back_s:g} s", kill_at
    return ending
