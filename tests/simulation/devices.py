"""The devices as processes: switched on and off, slow or fast of clock, standing still, and looked at after each call.

The classes are the product's own; only what drives them is simulated: a frame is handled as it arrives, ticks come as
often as `Runtime.run` makes them on an idle bus.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress

from loopwright.controller.channel import Settings
from loopwright.controller.device import ControllerChannel, ControllerDevice
from loopwright.plantsim.device import PlantChannel, PlantDevice
from loopwright.plantsim.plant import LinearPlant, Plant
from loopwright.protocol.bus import BusError
from loopwright.protocol.device_runtime import Runtime
from loopwright.protocol.objects import Value
from tests.simulation.disk import Disk, PowerCut
from tests.simulation.scheduler import Process, Simulation, Timer
from tests.simulation.wire import Port, Wire

_AFTER_BUS_ERROR_S = 0.05


class Clock:
    """A device's own clock: another zero, and a little fast or slow."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._zero = simulation.random.uniform(-900.0, 9000.0)
        self._rate = 1.0 + simulation.random.uniform(-1e-3, 1e-3)

    def __call__(self) -> float:
        return self._simulation.now * self._rate + self._zero

    def when(self, own: float) -> float:
        """The simulated time at which this clock shows that."""
        return (own - self._zero) / self._rate


class Node:
    """A device and its process. on_change: called after everything the device has done."""

    def __init__(self, wire: Wire, name: str, tick_s: float) -> None:
        self.wire = wire
        self.simulation = wire.simulation
        self.name = name
        self.clock = Clock(wire.simulation)
        self.process: Process | None = None
        self.on_change: Callable[[], None] = lambda: None
        self.on_send: Callable[[int, bytes], None] | None = None
        self._tick_s = tick_s
        self._port: Port | None = None
        self._due: Timer | None = None
        self._due_at = 0.0
        self._thawing = False

    @property
    def is_on(self) -> bool:
        return self.process is not None and self.process.alive

    @property
    def runtime(self) -> Runtime:
        raise NotImplementedError

    def _make(self, port: Port) -> None:
        raise NotImplementedError

    def _start(self) -> None:
        raise NotImplementedError

    def power_on(self) -> None:
        if self.is_on:
            return
        self.simulation.note(self.name, "is switched on")
        self.process = Process(self.simulation, self.name)
        self._thawing = False
        self._port = Port(self.wire, self.process, self._work)
        self._make(self._port)
        self._guarded(self._start)
        self._tick(self.process)

    def power_off(self) -> None:
        if self.process is not None and self.process.alive:
            self.simulation.note(self.name, "is switched off")
            self.process.kill()
            if self._due is not None:
                self._due.cancel()
                self._due = None

    def freeze(self, seconds: float) -> None:
        if self.process is not None and self.process.alive:
            self.process.freeze(seconds)

    def _awake(self) -> bool:
        """False where it stands still: then it works on afterwards."""
        assert self.process is not None
        frozen = self.process.frozen_for
        if frozen <= 0.0:
            return True
        if not self._thawing:
            self._thawing = True
            self.simulation.after(frozen, self._thaw, self.process)
        return False

    def _thaw(self, process: Process) -> None:
        if process is self.process:
            self._thawing = False
            self._work()

    def _work(self) -> None:
        """What has arrived, and what is due."""
        if not self.is_on or not self._awake():
            return
        assert self._port is not None
        inbox = self._port.inbox
        while self._guarded(self._poll) and inbox and self.is_on:
            pass

    def _poll(self) -> None:
        self.runtime.poll(0.0)

    def _guarded(self, call: Callable[[], object]) -> bool:
        """False where the bus is not there."""
        process, works = self.process, True
        try:
            call()
        except BusError:
            works = False
            self.simulation.after(_AFTER_BUS_ERROR_S, self._tick_once, process)
        except PowerCut:
            self.power_off()
            return False
        self.on_change()
        if works:
            self._watch_due()
        return works

    def _watch_due(self) -> None:
        if not self.is_on:
            return
        due = self.runtime.due
        if due is None:
            return
        at = self.clock.when(due)
        if self._due is not None and self._due.call is not None and self._due_at <= at:
            return
        if self._due is not None:
            self._due.cancel()
        self._due_at = at
        self._due = self.simulation.at(max(at, self.simulation.now) + 1e-9, self._on_due, self.process)

    def _on_due(self, process: Process) -> None:
        self._due = None
        if process is self.process:
            self._work()

    def _tick_once(self, process: Process | None) -> None:
        if process is self.process and self.is_on and self._awake():
            with suppress(BusError):
                self.runtime.tick()
            self.on_change()
            self._watch_due()

    def _tick(self, process: Process) -> None:
        if process is not self.process or not self.is_on:
            return
        self._tick_once(process)
        if self._port is not None and self._port.inbox:
            self._work()  # what had arrived when the bus went away
        self.simulation.after(self._tick_s, self._tick, process)


class Controller(Node):
    """keep: whether what is chosen outlives a restart."""

    def __init__(
        self, wire: Wire, name: str, node: int, plant_node: int, channel: ControllerChannel, sample_time_s: float,
        tick_s: float, keep: bool, draw: Callable[[], int], pace: float,
    ) -> None:  # fmt: skip
        super().__init__(wire, name, tick_s)
        self.node = node
        self.start_values = channel
        self.disk = Disk(wire.simulation)
        self.keep = keep
        self.device: ControllerDevice
        self.on_write: Callable[[str, Value, Callable[[], None]], None] = lambda name, value, do: do()
        self.on_frame: Callable[[int, bytes, Callable[[], None]], None] | None = None
        self._plant_node = plant_node
        self._sample_time_s = sample_time_s
        self._draw = draw
        self._pv_timeout_s = max(1.0, 3.0 * sample_time_s / pace if pace else 0.0)

    @property
    def runtime(self) -> Runtime:
        return self.device.runtime

    def power_off(self) -> None:
        super().power_off()
        self.disk.power_off()

    def _make(self, port: Port) -> None:
        channel = self.start_values
        if self.keep and self.disk.kept is not None:
            channel = channel.with_retained(self.disk.kept[0])
        self.device = device = ControllerDevice(
            port, [channel], self._sample_time_s, self.node, self._plant_node, self._pv_timeout_s, self.clock,
            self.disk if self.keep else None, self._draw,
        )  # fmt: skip
        server = device.runtime.sdo
        write = server.write
        by_index = device.dictionary.by_index

        def written(index: int, sub: int, data: bytes) -> None:
            entry = by_index.get(index)
            if entry is None or sub != 1:
                write(index, sub, data)
                return
            try:
                value = entry.type_of(sub).decode(data)
            except Exception:
                value = math.nan
            self.on_write(entry.name, value, lambda: write(index, sub, data))

        server.write = written

    def _start(self) -> None:
        self.device.start()


class Pv:
    """A plant whose sensor can break. broken: what PV then is."""

    def __init__(self, plant: LinearPlant, sensor: Sensor) -> None:
        self._plant = plant
        self._sensor = sensor

    @property
    def pv(self) -> float:
        return self._plant.pv if self._sensor.shows is None else self._sensor.shows

    def step(self, mv: float) -> float:
        pv = self._plant.step(mv)
        return pv if self._sensor.shows is None else self._sensor.shows

    @property
    def disturbance(self) -> float:
        return self._plant.disturbance

    @disturbance.setter
    def disturbance(self, value: float) -> None:
        self._plant.disturbance = value

    @property
    def noise_std(self) -> float:
        return self._plant.noise_std

    @noise_std.setter
    def noise_std(self, value: float) -> None:
        self._plant.noise_std = value

    @property
    def gain(self) -> float:
        return self._plant.gain

    @gain.setter
    def gain(self, value: float) -> None:
        self._plant.gain = value


class Sensor:
    """shows: what a broken one shows; None: PV.  was_false: whether it was ever broken."""

    def __init__(self) -> None:
        self._shows: float | None = None
        self.was_false = False

    @property
    def shows(self) -> float | None:
        return self._shows

    @shows.setter
    def shows(self, value: float | None) -> None:
        self._shows = value
        self.was_false |= value is not None


class PlantNode(Node):
    def __init__(
        self, wire: Wire, name: str, node: int, controller_node: int, build: Callable[[float, float, int], LinearPlant],
        noise_std: float, mv: float, sample_time_s: float, pace: float, tick_s: float,
    ) -> None:  # fmt: skip
        super().__init__(wire, name, tick_s)
        self.node = node
        self.sensor = Sensor()
        self.device: PlantDevice
        self.on_missing = 0
        self._controller_node = controller_node
        self._build = build
        self._noise_std = noise_std
        self._mv = mv
        self._sample_time_s = sample_time_s
        self._pace = pace

    @property
    def runtime(self) -> Runtime:
        return self.device.runtime

    def _make(self, port: Port) -> None:
        def build(sample_time_s: float, noise_std: float, seed: int) -> Plant:
            return Pv(self._build(sample_time_s, noise_std, seed), self.sensor)

        seed = self.simulation.random.randrange(1 << 30)
        self.device = PlantDevice(
            port, [PlantChannel(build, self._mv, self._noise_std)], self._sample_time_s, self._pace, seed=seed,
            node=self.node, controller_node=self._controller_node, clock=self.clock,
        )  # fmt: skip
        self.device.dictionary.set("plant_on_missing_answer", self.on_missing)
        self.device.dictionary.set("plant_answer_timeout", 100)

    def _start(self) -> None:
        self.device.start()

    @property
    def mv(self) -> float:
        return self.device.mv[0]


__all__ = ["Clock", "Controller", "Node", "PlantNode", "Sensor", "Settings"]
