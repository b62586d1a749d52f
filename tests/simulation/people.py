"""Who else is there: the person who asks for jobs and decides them, an operator, a PLC, a stranger on the bus."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from random import Random
from typing import TYPE_CHECKING, Any

from loopwright.protocol.bus import BusError
from loopwright.protocol.profile import (
    COMMAND_FRAME,
    NMT_FRAME,
    NMT_ID,
    Mode,
    NmtCommand,
    ParameterCommand,
    channel_ids,
)
from loopwright.protocol.tuner import Tuner, TunerError
from loopwright.service.errors import Conflict, Stopping
from loopwright.service.inputs.request import BadLimits, RetuneRequest
from loopwright.service.jobs.manager import Jobs
from loopwright.service.states.job_state import ACTIVE, IllegalMove, JobState
from loopwright.service.store.store import Busy
from loopwright.tuning.reasons import Ended, Reason
from tests.simulation.gateway import Gateway, SimStation
from tests.simulation.scheduler import Process
from tests.simulation.wire import Port

if TYPE_CHECKING:
    from tests.simulation.history import World

_REFUSALS = (Ended, Conflict, Busy, IllegalMove, Stopping, BadLimits)
_LOOK_S = 0.5
_AGAIN_S = 1.0


class Person:
    """Asks a gateway for a job at a time, perhaps aborts it, and decides what it proposes; what is cut off is asked
    again."""

    def __init__(
        self, world: World, gateway: Gateway, at_s: float, request: RetuneRequest, decisions: tuple[str, ...] = (),
        abort_s: float | None = None, tries: int = 6,
    ) -> None:  # fmt: skip
        self.world = world
        self.gateway = gateway
        self.done = False
        self.errors: list[str] = []
        self._request = request
        self._decisions = decisions
        self._abort_s = abort_s
        self._tries = tries
        process = self._process = Process(world.simulation, f"person at {gateway.name}")
        world.simulation.after(at_s, lambda: self._begin(process))

    def _begin(self, process: Process) -> None:
        task = process.start(self._go)

        def over() -> None:
            self.done = True
            if task.error is not None:
                raise task.error

        task.on_done.append(over)

    def _wait(self, seconds: float) -> None:
        task = self.world.simulation.task
        assert task is not None
        task.pause(seconds)

    def _ask(self, what: str, call: Callable[[Jobs], Any]) -> tuple[Any, BaseException | None, bool]:
        self.world.simulation.note(self._process.name, f"asks: {what}")
        answer, error, died = self.gateway.ask(what, call)
        said = "no answer, it died" if died else f"{type(error).__name__}: {error}" if error is not None else "done"
        self.world.simulation.note(self._process.name, f"is told of {what}: {said}")
        if error is not None and not isinstance(error, _REFUSALS):
            raise error
        return answer, error, died

    def _go(self) -> None:
        job_id = self._start()
        if job_id is None:
            return
        if self._abort_s is not None:
            self._wait(self._abort_s)
            if self.gateway.is_up:
                self._ask("abort", lambda jobs: jobs.abort(job_id, "person"))
        while self.gateway.state_of(job_id) in ACTIVE:
            if not self.gateway.wait_until_up():
                return
            self._wait(_LOOK_S)
        for decision in self._decisions:
            if self.gateway.state_of(job_id) not in ("proposed", "accepted") or not self._decide(job_id, decision):
                return

    def _start(self) -> str | None:
        while True:
            if not self.gateway.wait_until_up():
                return None
            row, error, _ = self._ask("retune", lambda jobs: jobs.start("L", self._request))
            if row is not None:
                return str(row.id)
            rows = self.gateway.rows()
            if rows:  # it was begun before the answer was lost
                return rows[-1].id
            if error is not None:
                return None

    def _decide(self, job_id: str, decision: str) -> bool:
        """Until it is told that it is done, or for so many times."""
        wanted = JobState.ACCEPTED if decision == "accept" else JobState.ROLLED_BACK
        for _ in range(self._tries):
            if not self.gateway.wait_until_up():
                return False
            self.world.permit(self.gateway.store.get(job_id))
            _, error, died = self._ask(decision, lambda jobs: getattr(jobs.decisions, decision)(job_id, "person"))
            if not died and error is None:
                return True
            if self.gateway.store.get(job_id).state == wanted:
                return True
            if error is not None:
                self.errors.append(f"{type(error).__name__}: {error}")
            self._wait(_AGAIN_S)
        return False


class Operator:
    """Outside changes to the loop: one at each of the times, by SDO as a panel sends it."""

    def __init__(self, world: World, times: list[float], random: Random, kinds: tuple[str, ...] = ()) -> None:
        self._world = world
        self._random = random
        self._kinds = kinds or ("setpoint", "setpoint", "mode", "mode", "output", "gains", "limits")
        process = self._process = Process(world.simulation, "operator")
        self._station = SimStation(world.wire, process, 0x7C)
        for at in times:
            world.trouble(at + 1.0)
            world.simulation.after(at, lambda: process.start(self._act))

    def _act(self) -> None:
        random = self._random
        kind = random.choice(self._kinds)
        writes: list[tuple[str, float]] = []
        if kind == "setpoint":
            writes = [("controller_setpoint", 50.0 + random.choice((0.0, random.uniform(-3.0, 3.0))))]
        elif kind == "mode":
            writes = [("controller_mode_command", float(random.choice((Mode.OFF, Mode.MANUAL, Mode.AUTOMATIC))))]
        elif kind == "output":
            writes = [("controller_manual_output", random.uniform(30.0, 70.0))]
        elif kind == "gains":
            if random.random() < 0.6:
                writes.append(("controller_staged_kp", random.uniform(0.3, 1.5)))
            commands = [ParameterCommand.TRY, ParameterCommand.ACCEPT, ParameterCommand.GO_BACK]
            writes += [("controller_parameter_command", float(each)) for each in commands if random.random() < 0.5]
        else:
            writes = [
                random.choice(
                    (
                        ("controller_mv_low", 5.0), ("controller_mv_high", 95.0), ("controller_pv_high", 110.0),
                        ("controller_rate_limit", 500.0), ("controller_safe_output", 10.0),
                    )
                )
            ]  # fmt: skip
        tuner: Tuner | None = None
        try:
            tuner = Tuner("virtual:sim", self._world.controller.node, None, station=self._station)
            for name, value in writes:
                self._world.simulation.note("operator", f"writes {name} = {value:g}")
                tuner.write(name, value)
        except (TunerError, BusError) as error:
            self._world.simulation.note("operator", f"is refused: {error}")
        finally:
            if tuner is not None:
                tuner.close()


class Plc:
    """Sends the set-point by RPDO in each period; at each of the times another one."""

    def __init__(self, world: World, period_s: float, until_s: float, times: list[float], random: Random) -> None:
        self._world = world
        self._port = Port(world.wire, Process(world.simulation, "plc"), lambda: None)
        self._value = world.controller.start_values.setpoint
        self._id = channel_ids(1, 0x10, world.controller.node).command
        simulation = world.simulation
        for at in times:
            world.trouble(at + 1.0)
            simulation.after(at, self._other, random)
        world.trouble(until_s)
        self._until = simulation.now + until_s
        self._period_s = period_s
        simulation.after(random.random() * period_s, self._send)

    def _other(self, random: Random) -> None:
        self._value += random.uniform(-1.0, 1.0)

    def _send(self) -> None:
        with contextlib.suppress(BusError):
            self._port.send(self._id, COMMAND_FRAME.pack(self._value))
        if self._world.simulation.now < self._until:
            self._world.simulation.after(self._period_s, self._send)


class Stranger:
    """A third node: NMT commands, orders that are not its to give, and frames of others sent once more."""

    def __init__(self, world: World, name: str = "stranger") -> None:
        self._world = world
        self._port = Port(world.wire, Process(world.simulation, name), lambda: None)
        self.heard: list[tuple[int, bytes]] = []

    def listens(self, can_id: int) -> None:
        def heard(port: Port, sent: int, data: bytes) -> None:
            if sent == can_id and port is not self._port:
                self.heard.append((sent, data))

        self._world.wire.on_frame = heard

    def send(self, at_s: float, can_id: int, data: bytes, words: str = "") -> None:
        def now() -> None:
            if words:
                self._world.simulation.note("stranger", words)
            with contextlib.suppress(BusError):
                self._port.send(can_id, data)

        self._world.trouble(at_s)
        self._world.simulation.after(at_s, now)

    def nmt(self, at_s: float, command: NmtCommand, node: int) -> None:
        self.send(at_s, NMT_ID, NMT_FRAME.pack(command, node), f"NMT {command.name.lower()} of node {node:02X}h")

    def repeats(self, at_s: float, random: Random) -> None:
        """A frame that was heard before, once more."""

        def now() -> None:
            if self.heard:
                # the later ones are more of interest
                can_id, data = self.heard[-1 - int(len(self.heard) * random.random() ** 2)]
                with contextlib.suppress(BusError):
                    self._port.send(can_id, data)

        self._world.trouble(at_s)
        self._world.simulation.after(at_s, now)


__all__ = ["Operator", "Person", "Plc", "Reason", "Stranger"]
