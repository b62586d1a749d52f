"""One seed, one history: a loop, who is about it, what goes wrong with it, and how it ended."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from random import Random
from typing import Any

from loopwright.controller.channel import Settings
from loopwright.controller.device import ControllerChannel
from loopwright.controller.pid import Parameters
from loopwright.plantsim.plant import LinearPlant
from loopwright.protocol.profile import CONTROLLER_NODE, PLANT_NODE, Mode, NmtState
from loopwright.service.execution.procedures import Tune
from loopwright.service.inputs.config import Limits, LoopConfig, PermittedTest
from loopwright.service.inputs.request import retune_request
from loopwright.service.loops.bus_loop import BusLoop
from loopwright.service.states.job_state import ACTIVE, JobState
from loopwright.service.states.loop_state import LoopState, state_json
from loopwright.service.store.jobs import Job
from tests.simulation import plans
from tests.simulation.devices import Controller, PlantNode
from tests.simulation.gateway import Gateway, SimStation, noted_reading
from tests.simulation.invariants import Bad, Invariants, real32
from tests.simulation.people import Person
from tests.simulation.scheduler import START, Runaway, Simulation
from tests.simulation.wire import State, Wire

URL = "virtual:sim"
TAG = "L"
TIMES = (
    # (sample time s, pace), and how often
    ((0.1, 1.0), 30), ((0.05, 1.0), 8), ((0.01, 1.0), 4), ((0.5, 1.0), 6), ((1.0, 10.0), 8), ((0.1, 10.0), 8),
    ((0.1, 0.0), 14), ((1.0, 0.0), 4), ((60.0, 0.0), 2), ((60.0, 1000.0), 6), ((1.0, 1.0), 3), ((5.0, 10.0), 3),
    ((10.0, 1000.0), 2), ((10.0, 1.0), 1),
)  # fmt: skip
BLOCKS_WALL_S = 0.006
_BLOCKS_FRAME_S = 0.002
"""A plant that runs as fast as the answers come keeps the simulation busy: there, the bus is a slow one."""
EPOCH_S = 4e9
"""Wall time at the simulation's zero, later than that of any machine, by which jobs note what they do."""
_LOOK_S = 0.25
_OVER_S = 1.9
"""The 1.5 s for which the heartbeat of a tuner may be missing, and a little."""
_PATIENCE_S = 75.0
"""Within which, after the last fault and without its plan's time, a job has ended: the restoring of a loop that does
not answer takes up to 25 s, a start waits for another tuner and listens, and the person asks again."""


@dataclass
class Loop:
    """What is drawn of the loop itself. wall_s: of one sample on the bus, s; in blocks the time of a few frames."""

    sample_time_s: float
    pace: float
    mode: Mode
    sp: float
    manual_output: float
    noise: float
    keep: bool
    samples: int

    @property
    def wall_s(self) -> float:
        return self.sample_time_s / self.pace if self.pace else BLOCKS_WALL_S

    @property
    def plan_s(self) -> float:
        """About how long a made-up plan takes on the bus."""
        return self.samples * self.wall_s * 1.2 + 0.6


def draw_loop(random: Random) -> Loop:
    ((sample_time_s, pace),) = random.choices([each for each, _ in TIMES], [often for _, often in TIMES])
    wall_s = sample_time_s / pace if pace else BLOCKS_WALL_S
    samples = 150 if not pace else max(8, min(70, round(random.uniform(2.0, 6.0) / wall_s)))
    mode = random.choices((Mode.AUTOMATIC, Mode.MANUAL, Mode.OFF), (75, 15, 10))[0]
    sp = real32(random.choice((50.0, 50.0, random.uniform(49.0, 51.0))))
    output = real32(random.choice((50.0, random.uniform(45.0, 55.0))))
    noise = random.choice((0.0, 0.01, 0.05))
    return Loop(sample_time_s, pace, mode, sp, output, noise, random.random() < 0.5, samples)


@dataclass
class Ending:
    """How a history ended. jobs: state and reason of each."""

    kind: str
    seed: int
    jobs: list[tuple[str, str]] = field(default_factory=list)
    bad: list[Bad] = field(default_factory=list)
    simulated_s: float = 0.0
    events: int = 0
    steps: int = 0
    log: list[str] = field(default_factory=list)

    @property
    def ending(self) -> str:
        """Of its first job."""
        return self.jobs[0][0] if self.jobs else "no job"


class World:
    """Everything of a history. random: for what is drawn before it begins."""

    def __init__(self, kind: str, seed: int, loop: Loop | None = None, keeps_log: bool = False) -> None:
        self.kind, self.seed = kind, seed
        self.random = Random(f"{kind} {seed} drawn")
        self.simulation = simulation = Simulation(f"{kind} {seed} history", keeps_log)
        self.loop = loop = loop or draw_loop(self.random)
        self.wire = wire = Wire(simulation)
        if not loop.pace:
            wire.frame_s = _BLOCKS_FRAME_S
        self.actions = plans.draw(self.random, loop.samples)
        self.tune: Tune = plans.tunes(self.actions)
        self.request = retune_request(method="fast")
        self.permitted = PermittedTest()
        self.pv_limits = Limits(low=20.0, high=80.0) if self.random.random() < 0.2 else Limits(low=-50.0, high=150.0)
        self.listen_s = 2.0 if self.random.random() < 0.25 else 0.0
        tick_s = 0.02 if loop.wall_s < 0.05 else 0.04 if loop.wall_s <= 0.5 else 0.1
        Ts = loop.sample_time_s
        gains = Parameters(real32(0.6), real32(15.0 * Ts), b=real32(1.0))
        self.home_gains = gains
        start = ControllerChannel(gains, loop.sp, Settings(pv_low=0.0, pv_high=100.0), loop.mode, loop.manual_output)
        draws = Random(f"{kind} {seed} numbers")
        self.controller = Controller(
            wire, "controller", CONTROLLER_NODE, PLANT_NODE, start, Ts, tick_s, loop.keep,
            lambda: draws.randrange(1, 1 << 32), loop.pace,
        )  # fmt: skip

        def build(sample_time_s: float, noise_std: float, seed: int) -> LinearPlant:
            return LinearPlant(
                [1.0], [self.time_constant * sample_time_s, 1.0], self.dead_time * sample_time_s, sample_time_s,
                mv_nominal=50.0, pv_nominal=50.0, noise_std=noise_std, seed=seed, mv_low=0.0, mv_high=100.0,
            )  # fmt: skip

        self.time_constant, self.dead_time = 12.0, 3.0
        self.plant = PlantNode(
            wire, "plant", PLANT_NODE, CONTROLLER_NODE, build, loop.noise, 50.0, Ts, loop.pace, tick_s
        )
        self.invariants = Invariants(simulation, wire, self.controller, self.plant)
        self.gateways: list[Gateway] = []
        self.people: list[Person] = []
        self.trouble_until = 0.0
        self.clean_since = START
        self.plan_s = loop.plan_s
        self.may_stay_open = False
        self.struck = False
        """What is to happen at a certain point of the job has happened."""
        self.quiet = True
        """Nothing but kills: a dead tuner's session then has its time."""
        self.readings: dict[str, deque[tuple[dict[str, Any], float]]] = {}
        self.proposed = plans.PROPOSED
        self.at_the_end: list[Callable[[], None]] = []
        """What else is looked at then."""
        self.closing: list[Callable[[], None]] = []
        """What is put right again once the history is over."""

    @property
    def wall_s(self) -> float:
        """The wall clock of what has one, s since 1970 UTC."""
        return EPOCH_S + self.simulation.now

    def upset_plant(self, load: float = 0.0, gain: float = 1.0) -> None:
        """Another load and another gain of the plant, while it is on."""
        if self.plant.is_on:
            self.plant.device.plants[0].disturbance = load
            self.plant.device.plants[0].gain = gain
            self.simulation.note("plant", f"load {load:g} %, gain x {gain:g}")

    def calm_plant(self) -> None:
        self.upset_plant()

    def trouble(self, until_s: float) -> None:
        """Something goes wrong, or somebody acts, up to so many s after the start."""
        self.trouble_until = max(self.trouble_until, until_s)

    def config(self) -> LoopConfig:
        Ts = self.loop.sample_time_s
        return LoopConfig(
            tag=TAG, bus=URL, controller_node=CONTROLLER_NODE, plant_node=PLANT_NODE, pv_unit="%",
            pv_limits=self.pv_limits, t95_s=(3.0 * self.time_constant + self.dead_time) * Ts,
            sp_deviation=2.0, test=self.permitted,
        )  # fmt: skip

    def gateway(self, node: int = 0x7D) -> Gateway:
        number = len(self.gateways)
        name = f"gateway {'AB'[number]}"
        readings: deque[tuple[dict[str, Any], float]] = deque(maxlen=20)
        self.readings[name] = readings

        def note(state: LoopState, began: float) -> None:
            readings.append((state_json(state), began))

        def open_loop(station: SimStation, config: LoopConfig) -> BusLoop:
            station.listen_s = self.listen_s
            return BusLoop(
                config.bus, config.controller_node, config.plant_node, config.channel, station=station,
                pv_limits=(config.pv_limits.low, config.pv_limits.high), read=noted_reading(station.monotonic, note),
            )  # fmt: skip

        config = self.config()
        gateway = Gateway(self.wire, name, number, node, {TAG: config}, self.tune_of, open_loop)
        self.gateways.append(gateway)
        self.simulation.after(0.2 + 0.1 * number, gateway.start)
        gateway.store.after_move = lambda row, state: self._moved(gateway, row, state)
        gateway.on_start = lambda process: process.on_death.append(lambda: self._died(gateway))
        return gateway

    def tune_of(self, *args: Any, **more: Any) -> Any:
        return self.tune(*args, **more)

    def _moved(self, gateway: Gateway, row: Job, state: JobState) -> None:
        restored, since = row.restored, self.simulation.now
        for said, began in self.readings[gateway.name]:
            if restored is not None and _alike(said, restored):
                since = began
        self.invariants.moved(gateway.name, row, state, since, START)

    def _died(self, gateway: Gateway) -> None:
        """Its session is over within the time that its heartbeat may be missing, and a little."""
        controller = self.controller
        if not self.quiet or not controller.is_on:
            return
        session = controller.device.sessions[0]
        number = session.number
        if number and session.holder == gateway.node:

            def look() -> None:
                now = controller.device.sessions[0].number
                if now == number and not (gateway.is_up and gateway.busy()):
                    self.invariants.say(f"a dead tuner's session is open: {_OVER_S:g} s after its death")

            self.simulation.after(_OVER_S, look)

    def permit(self, row: Job) -> None:
        """A person decides: either set of the job may be the accepted one from now on."""
        proposed = None if row.result is None or row.result.new_gains is None else asdict(row.result.new_gains.gains())
        for gains in (row.previous_gains, proposed):
            if gains:
                names = ("Kp", "Ti", "Td", "Tf", "b", "c")
                self.invariants.permitted.append(Parameters(*(real32(float(gains[name])) for name in names)))

    def person(self, gateway: Gateway, at_s: float = 0.6, **more: Any) -> Person:
        person = Person(self, gateway, at_s, self.request, **more)
        self.people.append(person)
        return person

    # -- the history

    def run(self) -> Ending:
        simulation = self.simulation
        simulation.after(0.0, self.power_on_controller)
        simulation.after(0.01, self.plant.power_on)
        ending = Ending(self.kind, self.seed)
        try:
            self._run()
        except Runaway as runaway:
            self.invariants.say(f"runaway: {runaway}")
        except Exception as defect:
            import traceback

            frames = traceback.extract_tb(defect.__traceback__)
            where = "; ".join(f"{each.filename.rsplit('/', 1)[-1]}:{each.lineno}" for each in frames[-4:])
            self.invariants.say(f"defect: {type(defect).__name__}: {defect} at {where}")
        finally:
            simulation.keeps_log, kept = False, simulation.keeps_log
            simulation.end()
            simulation.keeps_log = kept
            for put_right in self.closing:
                put_right()
        for gateway in self.gateways:
            gateway.store.on_statement = gateway.store.after_move = None
            for row in gateway.rows():
                ending.jobs.append((row.state, row.reason or ""))
            if gateway.is_up:
                self.invariants.held_jobs(gateway.store.seen())
        ending.bad = self.invariants.bad
        ending.simulated_s = simulation.now - START
        ending.events = simulation.events
        ending.steps = sum(process.steps for process in simulation.processes)
        return ending

    def _run(self) -> None:
        simulation = self.simulation
        most_kills = 4
        deadline = START + 2.0 + self.trouble_until + most_kills * (self.plan_s + 10.0) + _PATIENCE_S
        calm_since: float | None = None
        settle_s = max(1.6, 3.5 * min(self.loop.wall_s, 60.0), 1.2)
        while True:
            simulation.run(simulation.now + _LOOK_S)
            if not self._calm():
                calm_since = None
            elif calm_since is None:
                calm_since = simulation.now
                self.invariants.before_the_end()
            elif simulation.now - calm_since >= settle_s:
                break
            if simulation.now > deadline:
                self._late()
                break
        clean = simulation.now - max(self.clean_since, START + self.trouble_until) > 1.2
        for _ in range(40):  # between two samples
            if self.plant.is_on and self.controller.is_on and self.plant.mv == self.controller_mv:
                break
            simulation.run(simulation.now + 0.0002)
        for look in self.at_the_end:
            look()
        self.invariants.at_the_end(clean and self._both_operational() and self.wire.state is State.UP)

    @property
    def controller_mv(self) -> float:
        return real32(self.controller.device.sessions[0].channel.mv)

    def _both_operational(self) -> bool:
        return all(each.is_on and each.runtime.state is NmtState.OPERATIONAL for each in (self.controller, self.plant))

    def _calm(self) -> bool:
        """Nothing goes wrong any more, and nobody is at work."""
        if self.simulation.now < START + self.trouble_until or not all(person.done for person in self.people):
            return False
        if any(gateway.starts and not gateway.is_up and not gateway.gone for gateway in self.gateways):
            return False
        if self.controller.is_on and self.controller.device.sessions[0].is_open:
            return False
        return not any(gateway.is_up and gateway.busy() for gateway in self.gateways)

    def _late(self) -> None:
        for gateway in self.gateways:
            if gateway.is_up and gateway.busy():
                self.invariants.say("a job has not ended: in the time it has for it")
            elif not gateway.is_up and not gateway.gone:
                self.invariants.say("a service has not come up: in the time it has for it")
        if not all(person.done for person in self.people):
            self.invariants.say("a person has no answer: in the time a decision has")

    def power_on_controller(self) -> None:
        if not self.controller.is_on:
            first = self.controller.process is None
            if not first:
                self.invariants.power_on()
            self.controller.power_on()

    def power_off_controller(self) -> None:
        self.invariants.off_at = self.simulation.now
        self.controller.power_off()


def _alike(one: dict[str, Any], other: dict[str, Any]) -> bool:
    return all(one[name] == other.get(name) for name in ("mode", "sp", "mv", "pv", "on_trial"))


__all__ = ["ACTIVE", "Ending", "World"]
