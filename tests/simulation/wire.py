"""The simulated bus: frames one after the other, as on a wire, and what can happen to them on the way.

A frame that is held back stays in its sender's queue, and leaves it when the bus is back, also when the sender is dead
by then. What is late at a receiver keeps its order among the frames of that sender.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Collection
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from loopwright.protocol.bus import BusError, Frame
from tests.simulation.scheduler import Killed, Process, Simulation, Task

FRAME_S = 0.00012
JITTER_S = 0.0001


class State(Enum):
    UP = "up"
    AWAY = "away"
    """Frames are lost, and nobody is told."""
    HELD = "held"
    """Frames wait in their senders' queues."""
    DOWN = "down"
    """The interface of every member is down: each call raises."""


@dataclass(slots=True)
class Faults:
    """Probabilities by frame and receiver. late_s: at most."""

    lost: float = 0.0
    doubled: float = 0.0
    late: float = 0.0
    late_s: float = 0.0


class Sent(NamedTuple):
    """For the log; put in words when it is read."""

    can_id: int
    data: bytes
    fate: str = ""


class Wire:
    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.state = State.UP
        self.members: tuple[Port, ...] = ()
        self.faults: Faults | None = None
        self.cut: set[tuple[str, int]] = set()
        """(receiver, identifier) of frames that do not get there."""
        self.blocked: frozenset[int] = frozenset()
        """Identifiers of frames that get nowhere."""
        self.ever_lost: Counter[int] = Counter()
        self.on_frame: Callable[[Port, int, bytes], None] | None = None
        self.frame_s = FRAME_S
        self._free_at = 0.0
        self._held: list[tuple[Port, int, bytes]] = []

    def join(self, port: Port) -> None:
        self.members = (*self.members, port)

    def leave(self, port: Port) -> None:
        self.members = tuple(each for each in self.members if each is not port)

    def set_state(self, state: State) -> None:
        if state is self.state:
            return
        self.simulation.note("bus", f"is {state.value}")
        self.state = state
        if state is State.UP:
            held, self._held = self._held, []
            for port, can_id, data in held:
                self.carry(port, can_id, data)
        elif state is State.DOWN:
            for port in self.members:
                port.interrupt()

    def carry(self, sender: Port, can_id: int, data: bytes) -> None:
        simulation = self.simulation
        if self.on_frame is not None:
            self.on_frame(sender, can_id, data)
        if self.state is State.HELD:
            self._held.append((sender, can_id, data))
            simulation.note(sender.name, Sent(can_id, data, "held back"))
            return
        if self.state is not State.UP or can_id in self.blocked:
            self.ever_lost[can_id] += 1
            simulation.note(sender.name, Sent(can_id, data, "lost"))
            return
        if simulation.keeps_log:
            simulation.note(sender.name, Sent(can_id, data))
        begin = max(simulation.now, self._free_at)
        self._free_at = arrival = begin + self.frame_s + JITTER_S * simulation.random.random()
        simulation.at(arrival, self._deliver, sender, can_id, data)

    def _deliver(self, sender: Port, can_id: int, data: bytes) -> None:
        if self.state is not State.UP:  # it went away with the frame on it
            if self.state is State.HELD:
                self._held.append((sender, can_id, data))
            else:
                self.ever_lost[can_id] += 1
            return
        faults = self.faults
        if faults is None and not self.cut:
            for port in self.members:
                if port is not sender and can_id in port.wanted:
                    port.take((can_id, data))
            return
        random = self.simulation.random
        for port in self.members:
            if port is sender or can_id not in port.wanted:
                continue
            if (port.name, can_id) in self.cut:
                self._lose(port, can_id, data)
                continue
            if faults is None:
                port.take((can_id, data))
                continue
            if faults.lost and random.random() < faults.lost:
                self._lose(port, can_id, data)
                continue
            times = 2 if faults.doubled and random.random() < faults.doubled else 1
            late_s = random.random() * faults.late_s if faults.late and random.random() < faults.late else 0.0
            if times == 2 or late_s:
                fate = f"for {port.name} {'twice ' if times == 2 else ''}{f'late by {late_s:.3f} s' if late_s else ''}"
                self.simulation.note("bus", Sent(can_id, data, fate.strip()))
            until = max(port.in_order.get(sender.name, 0.0), self.simulation.now + late_s)
            for _ in range(times):
                if until > self.simulation.now:
                    port.in_order[sender.name] = until
                    self.simulation.at(until, port.take_late, (can_id, data))
                else:
                    port.take((can_id, data))

    def _lose(self, port: Port, can_id: int, data: bytes) -> None:
        self.ever_lost[can_id] += 1
        self.simulation.note("bus", Sent(can_id, data, f"lost for {port.name}"))


class Port:
    """One opening of the bus (`protocol.bus.Bus`). on_arrival: of a device, which is called and does not wait."""

    def __init__(self, wire: Wire, process: Process, on_arrival: Callable[[], None] | None = None) -> None:
        self.name = process.name
        self.wanted: frozenset[int] = frozenset()
        self.in_order: dict[str, float] = {}
        """By sender: when its last frame gets here."""
        self._wire = wire
        self._process = process
        self._on_arrival = on_arrival
        self.inbox: deque[Frame] = deque()
        self._waiter: Task | None = None
        self._open = True
        if on_arrival is None:
            process.step("open")
            if wire.state is State.DOWN:
                raise BusError("the interface is down")
        wire.join(self)
        process.on_death.append(self.close)

    def take(self, frame: Frame) -> None:
        self.inbox.append(frame)
        if self._on_arrival is not None:
            self._on_arrival()
        elif self._waiter is not None:
            waiter, self._waiter = self._waiter, None
            waiter.wake()

    def take_late(self, frame: Frame) -> None:
        if self._open and frame[0] in self.wanted:
            self.take(frame)

    def interrupt(self) -> None:
        if self._waiter is not None:
            waiter, self._waiter = self._waiter, None
            self._wire.simulation.after(0.0, waiter.wake)

    def send(self, can_id: int, data: bytes) -> None:
        if self._on_arrival is None:
            self._process.step("send")
        elif not self._process.alive:
            return
        if self._wire.state is State.DOWN:
            raise BusError("cannot send: the interface is down")
        self._wire.carry(self, can_id, bytes(data))

    def recv(self, timeout: float | None) -> Frame | None:
        waits = self._on_arrival is None and timeout != 0.0
        if waits:
            self._process.step("receive")
        elif not self._process.alive:
            if self._on_arrival is None:
                raise Killed(self.name)
            return None
        if self._wire.state is State.DOWN:
            raise BusError("cannot receive: the interface is down")
        if self.inbox:
            return self.inbox.popleft()
        if waits:
            task = self._wire.simulation.task
            assert task is not None
            self._waiter = task
            task.pause(timeout)
            self._waiter = None
            if self._wire.state is State.DOWN:
                raise BusError("cannot receive: the interface is down")
            if self.inbox:
                return self.inbox.popleft()
        return None

    def set_filters(self, ids: Collection[int]) -> None:
        self.wanted = frozenset(ids)

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        self._open = False
        self._wire.leave(self)
