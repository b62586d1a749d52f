"""What goes wrong in a phase of a pulse of the manual output, in a job with the real procedure."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from loopwright.protocol.profile import CONTROLLER_NODE, NmtCommand
from loopwright.service.execution.procedures import Hooks, Outcome
from loopwright.service.inputs.config import Limits, LoopConfig, PermittedTest
from loopwright.service.inputs.request import RetuneRequest, retune_request
from loopwright.service.loops.bus_loop import BusLoop
from loopwright.service.states.loop_state import LoopState
from tests.pulse_phases import Phase, PulseWatch
from tests.simulation import plans
from tests.simulation.gateway import Gateway
from tests.simulation.history import World
from tests.simulation.people import Stranger
from tests.simulation.scheduler import Process
from tests.simulation.wire import State

RESTED = 4
"""Samples; the ultimate period of the plant is some 11."""
AWAY_S = 3.0
SOON_S = 0.3
LOAD_PCT = 60.0
"""Moves PV by as many percent of its span: over a limit of the job, and not out of the span."""
Strike = Callable[[World, Gateway], None]


def expect(world: World) -> None:
    """Pulses of the manual output, and nothing else."""
    world.permitted = PermittedTest(excitations=("relay", "manual"), mv_step_max=10.0)
    world.request = retune_request(method="fast")
    world.tune = plans.real
    world.plan_s = 400 * world.loop.wall_s


def strike_in(world: World, gateway: Gateway, phase: Phase, pulse: int, strike: Strike) -> None:
    """Lets it happen once, as soon as that pulse (1 the first) comes to that phase."""
    controller, home, watch = world.controller, world.loop.manual_output, PulseWatch(RESTED)
    look = controller.on_change

    def looks() -> None:
        look()
        if world.struck or not controller.is_on:
            return
        channel = controller.device.channels[0]
        seen = watch.see(channel.manual_output != home, channel.good_samples)
        if (seen, watch.pulses) == (phase, pulse):
            world.struck = True
            world.simulation.note("strike", f"in pulse {pulse}, {phase.value}")
            world.simulation.after(0.0, strike, world, gateway)

    controller.on_change = looks
    world.trouble(world.plan_s + world.listen_s + 2.0 * AWAY_S)


def _later(world: World, seconds: float, call: Callable[..., object], *args: Any) -> None:
    """What the strike did is over then."""

    def over() -> None:
        call(*args)
        world.clean_since = world.simulation.now

    world.quiet = False
    world.simulation.after(seconds, over)


def aborted(world: World, gateway: Gateway) -> None:
    process = Process(world.simulation, "operator")
    job_id = gateway.rows()[-1].id
    process.start(lambda: gateway.ask("abort", lambda jobs: jobs.abort(job_id, "operator")))


def defect(world: World, gateway: Gateway) -> None:
    """The next sample raises what nobody expects."""
    world.invariants.a_defect_is_put_in = True


def plant_lost(world: World, gateway: Gateway) -> None:
    world.plant.power_off()
    _later(world, AWAY_S, world.plant.power_on)


def controller_lost(world: World, gateway: Gateway) -> None:
    world.power_off_controller()
    _later(world, AWAY_S, world.power_on_controller)


def controller_restarted(world: World, gateway: Gateway) -> None:
    world.power_off_controller()
    _later(world, SOON_S, world.power_on_controller)


def controller_reset(world: World, gateway: Gateway) -> None:
    world.quiet = False
    Stranger(world).nmt(0.0, NmtCommand.RESET_NODE, CONTROLLER_NODE)


def controller_pre_operational(world: World, gateway: Gateway) -> None:
    third = Stranger(world)
    third.nmt(0.0, NmtCommand.PRE_OPERATIONAL, CONTROLLER_NODE)
    _later(world, AWAY_S, third.nmt, 0.0, NmtCommand.START, CONTROLLER_NODE)


def bus_lost(world: World, gateway: Gateway) -> None:
    world.wire.set_state(State.DOWN)
    _later(world, AWAY_S, world.wire.set_state, State.UP)


def bus_away(world: World, gateway: Gateway) -> None:
    world.wire.set_state(State.AWAY)
    _later(world, AWAY_S, world.wire.set_state, State.UP)


def killed(world: World, gateway: Gateway) -> None:
    assert gateway.process is not None
    gateway.restart_after = lambda: SOON_S
    gateway.process.kill()


def killed_for_good(world: World, gateway: Gateway) -> None:
    assert gateway.process is not None
    gateway.restart_after = lambda: None
    gateway.process.kill()


def pv_limit(world: World, gateway: Gateway) -> None:
    """While the service stands still, so that the controller alone is there to end the test."""
    assert gateway.process is not None
    gateway.process.freeze(1.0)
    world.plant.device.plants[0].disturbance = LOAD_PCT
    _later(world, AWAY_S, setattr, world.plant.device.plants[0], "disturbance", 0.0)


SILENT = ("node_lost", "samples_lost", "session_ended_by_device")
STRIKES: dict[str, tuple[Strike, tuple[str, ...]]] = {
    "aborted": (aborted, ("aborted operator",)),
    "defect": (defect, ("failed internal",)),
    "plant-lost": (plant_lost, tuple(f"failed {reason}" for reason in (*SILENT, "bad_sample"))),
    "controller-lost": (controller_lost, ("failed node_lost",)),
    "controller-restarted": (controller_restarted, ("failed node_lost",)),
    "controller-reset": (controller_reset, ("failed node_lost",)),
    "pre-operational": (controller_pre_operational, ("failed node_not_operational",)),
    "bus-lost": (bus_lost, ("failed bus_lost", "failed node_lost")),
    "bus-away": (bus_away, tuple(f"failed {reason}" for reason in SILENT)),
    "killed": (killed, ("proposed ", "accepted ", "rolled_back ")),
    "killed-for-good": (killed_for_good, ("running ",)),
    "pv-limit": (pv_limit, ("failed pv_limit",)),
}
"""What is done, and how the job may end of it."""


def with_defect(world: World) -> None:
    """The procedure, of a service that has a defect as soon as one is put in."""

    def work(config: LoopConfig, request: RetuneRequest, loop: BusLoop, state: LoopState, hooks: Hooks) -> Outcome:
        steps = loop.step

        def step(commands: Any) -> Any:
            sample = steps(commands)
            if world.invariants.a_defect_is_put_in:
                raise ZeroDivisionError("a defect put in on purpose")
            return sample

        loop.step = step  # type: ignore[method-assign]
        return plans.real(config, request, loop, state, hooks)

    world.tune = work  # type: ignore[assignment]


def struck(world: World, phase: Phase, pulse: int, name: str) -> None:
    """A history in which that happens in that phase."""
    expect(world)
    with_defect(world)
    world.pv_limits = Limits(low=20.0, high=80.0)
    gateway = world.gateway()
    world.person(gateway, 0.5)
    strike_in(world, gateway, phase, pulse, STRIKES[name][0])


def drawn(world: World) -> None:
    random = world.random
    struck(world, random.choice(list(Phase)), random.randint(1, 4), random.choice(list(STRIKES)))
