"""The process that listens: each bus is opened once more, and nothing is ever sent.

    python -m loopwright.service.listening.child FD

FD is its connection to the service, which starts it; it ends with the service. It imports little: numpy and the bus.
"""

from __future__ import annotations

import os
import signal
import struct
import sys
import threading
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path

from loopwright.protocol.bus import Bus, BusError, open_bus
from loopwright.protocol.profile import ChannelIds, heartbeat_id
from loopwright.service.listening.bins import Bins, packed
from loopwright.service.listening.heard_loop import Heard, HeardLoop
from loopwright.service.listening.heard_node import HeardHeartbeat, HeardNode
from loopwright.service.listening.messages import (
    Finish,
    FinishedBlock,
    HistoryAnswer,
    Learn,
    Listen,
    NewSamples,
    Query,
    Report,
    Watch,
)
from loopwright.service.listening.rings import Rings

AGAIN_S = 2.0
"""Wall time between two tries to open a bus, s."""
REPORT_S = 1.0
TELL_S = 0.1
"""Wall time between two messages of new samples, s."""
BLOCK_S = 60.0
"""Wall time after which the bins of a loop are handed over to be stored, s: a process that dies loses at most these."""
_RECV_S = 0.5
_JUMP_S = 0.1
_FIRST_TO_DIE = "500"

Take = Callable[[bytes, float], None]


class Clock:
    """The wall time, steady between its jumps: the time of a sample is never before that of an earlier one."""

    def __init__(self, wall: Callable[[], float] = time.time, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._wall, self._monotonic = wall, monotonic
        self._offset = wall() - monotonic()

    def now(self) -> float:
        return self._monotonic() + self._offset

    def set_back(self) -> bool:
        """Follows the wall clock where it has jumped. Returns whether it was put back."""
        ahead_s = self.now() - self._wall()
        if abs(ahead_s) > _JUMP_S:
            self._offset -= ahead_s
        return ahead_s > _JUMP_S

    def of(self, wall_s: float) -> float:
        """Returns this clock's time at a recent time of the wall clock, which is up to a jump away."""
        return wall_s + self.now() - self._wall()


class HeardBus:
    """Listens to one bus, in a thread. `lock` guards the loops and the nodes."""

    def __init__(
        self,
        url: str,
        ids: Mapping[str, ChannelIds],
        clock: Clock,
        open_bus: Callable[[str], Bus],
        nodes: Collection[int] = (),
    ) -> None:
        self.lock = threading.Lock()
        self.loops = {tag: HeardLoop() for tag in ids}
        self.nodes = {node: HeardNode() for node in nodes}
        self.down: str | None = "not opened yet"
        self._url, self._clock, self._open = url, clock, open_bus
        self._frames = self._reported = 0
        self._takes: dict[int, tuple[Take, ...]] = {}
        for tag, of_loop in ids.items():
            loop = self.loops[tag]
            each: tuple[tuple[int, Take], ...] = (
                (of_loop.pv, loop.take_pv), (of_loop.mv, loop.take_mv), (of_loop.status, loop.take_status)
            )  # fmt: skip
            for can_id, take in each:  # plant I/O may feed several controllers
                self._takes[can_id] = (*self._takes.get(can_id, ()), take)
        self._heartbeats = {heartbeat_id(node): heard.take for node, heard in self.nodes.items()}

    def run(self) -> None:
        """Listens for ever; a bus that is down is opened again."""
        while True:
            try:
                bus = self._open(self._url)
                try:
                    bus.set_filters((*self._takes, *self._heartbeats))
                    self.down = None
                    self._listen(bus)
                finally:
                    bus.close()
            except BusError as error:
                self.down = str(error)
            except Exception as error:  # python-can's interfaces raise what they like
                self.down = f"{type(error).__name__}: {error}"
            with self.lock:
                for loop in self.loops.values():
                    loop.interrupted()
            time.sleep(AGAIN_S)

    def _listen(self, bus: Bus) -> None:
        while True:
            frame = bus.recv(_RECV_S)
            if frame is not None:
                self.take(*frame)

    def take(self, can_id: int, data: bytes) -> None:
        """Takes a frame."""
        takes = self._takes.get(can_id)
        if takes is None:  # a heartbeat, or a frame from before the filter
            heartbeat = self._heartbeats.get(can_id)
            takes = () if heartbeat is None else (heartbeat,)
        else:
            self._frames += 1
        now_s = self._clock.now()
        with self.lock:
            for take in takes:
                with suppress(struct.error):  # a foreign frame with this identifier
                    take(data, now_s)

    def new_frames(self) -> int:
        """Returns the number of frames of process data since this was asked last."""
        before, self._reported = self._reported, self._frames
        return self._reported - before


class Child:
    """The process: it answers the service, and reports to it."""

    def __init__(
        self,
        loops: Mapping[str, Mapping[str, ChannelIds]],
        clock: Clock,
        open_bus: Callable[[str], Bus] = open_bus,
        nodes: Mapping[str, Collection[int]] | None = None,
    ) -> None:
        self._clock = clock
        nodes = nodes or {}
        self.buses = {url: HeardBus(url, ids, clock, open_bus, nodes.get(url, ())) for url, ids in loops.items()}
        self._of_tag = {tag: bus for bus in self.buses.values() for tag in bus.loops}
        # Spread over the time of a block, so that they are not all packed at once.
        first_s = clock.now()
        spread = enumerate(self._of_tag, 1)
        self._last_s: dict[str, float] = {}
        self._told: dict[str, tuple[Rings, int]] = {}
        """The loops that are watched: their rings, and how many of their samples were told."""
        self._saved_s = {tag: first_s - BLOCK_S + BLOCK_S * n / len(self._of_tag) for n, tag in spread}

    def start(self) -> None:
        for url, bus in self.buses.items():
            threading.Thread(target=bus.run, name=url, daemon=True).start()

    def serve(self, connection: Connection) -> None:
        """Serves until the service asks for the end. Raises EOFError, OSError when the service is gone."""
        due = tell_due = time.monotonic() + REPORT_S
        while True:
            next_s = min(due, tell_due) if self._told else due
            if connection.poll(max(0.0, next_s - time.monotonic())):
                message = connection.recv()
                if isinstance(message, Query):
                    connection.send(self.answer(message))
                elif isinstance(message, Learn):
                    self.learn(message)
                elif isinstance(message, Watch):
                    self.watch(message)
                elif isinstance(message, Finish):
                    connection.send(self.report(finished=True))
                    return
            if self._told and time.monotonic() >= tell_due:
                if (new := self.new_samples()).samples:
                    connection.send(new)
                tell_due = time.monotonic() + TELL_S
            if time.monotonic() >= due:
                connection.send(self.report())
                due = time.monotonic() + REPORT_S

    def answer(self, query: Query) -> HistoryAnswer:
        bus = self._of_tag[query.tag]
        with bus.lock:
            loop = bus.loops[query.tag]
            rows = loop.rings.rows(query.from_s, query.to_s, query.points)
            return HistoryAnswer(query.number, rows, loop.rings.oldest_s, loop.silent_from_s(self._clock.now()))

    def learn(self, message: Learn) -> None:
        bus = self._of_tag[message.tag]
        found = replace(message.found, began_s=self._clock.of(message.found.began_s))
        with bus.lock:
            bus.loops[message.tag].learn(found, self._clock.now())

    def watch(self, message: Watch) -> None:
        told = {}
        for tag in message.tags:
            bus = self._of_tag[tag]
            with bus.lock:
                rings = bus.loops[tag].rings
                told[tag] = self._told.get(tag, (rings, rings.count))
        self._told = told

    def new_samples(self) -> NewSamples:
        """Returns the samples of the watched loops that were not returned before."""
        found: dict[str, Bins] = {}
        for tag, (rings, count) in self._told.items():
            bus = self._of_tag[tag]
            with bus.lock:
                present = bus.loops[tag].rings
                new = present.since(count if present is rings else 0)
                self._told[tag] = (present, present.count)
            if len(new):
                found[tag] = new
        return NewSamples(found)

    def _heard(self, now_s: float) -> dict[str, Heard]:
        found: dict[str, Heard] = {}
        for tag, bus in self._of_tag.items():
            with bus.lock:
                latest = bus.loops[tag].latest(now_s)
            if latest is not None:
                found[tag] = latest
        return found

    def _nodes(self, now_s: float) -> dict[tuple[str, int], HeardHeartbeat]:
        found: dict[tuple[str, int], HeardHeartbeat] = {}
        for url, bus in self.buses.items():
            with bus.lock:
                for node, heard in bus.nodes.items():
                    if (latest := heard.latest(now_s)) is not None:
                        found[url, node] = latest
        return found

    def report(self, finished: bool = False) -> Report:
        if self._clock.set_back():
            for bus in self.buses.values():
                with bus.lock:
                    for loop in bus.loops.values():
                        loop.began_anew()
                    for node in bus.nodes.values():
                        node.began_anew()
        now_s = self._clock.now()
        to_read = [tag for tag, bus in self._of_tag.items() if bus.loops[tag].to_read(now_s)]
        return Report(
            down={url: bus.down for url, bus in self.buses.items() if bus.down is not None},
            frames={url: bus.new_frames() for url, bus in self.buses.items()},
            to_read=to_read,
            blocks=[block for tag in self._of_tag if (block := self._block(tag, now_s, finished)) is not None],
            finished=finished,
            heard=self._heard(now_s),
            nodes=self._nodes(now_s),
        )

    def _block(self, tag: str, now_s: float, finished: bool) -> FinishedBlock | None:
        """Returns the block of a loop that is due."""
        if not finished and 0.0 <= now_s - self._saved_s[tag] < BLOCK_S:
            return None
        self._saved_s[tag] = now_s
        bus = self._of_tag[tag]
        with bus.lock:
            rows = bus.loops[tag].rings.unsaved(all_of_it=finished)
        if rows is None:
            return None
        first_s, last_s = rows.bins["at_s"][0].item(), rows.bins["until_s"][-1].item()
        after_s, self._last_s[tag] = self._last_s.get(tag), last_s
        return FinishedBlock(tag, after_s, first_s, last_s, len(rows.bins), packed(rows))


def main() -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the service alone ends it, by closing the connection
    with suppress(OSError):  # where there is none, or it may not be written
        Path("/proc/self/oom_score_adj").write_text(_FIRST_TO_DIE)
    connection = Connection(int(sys.argv[1]))
    with suppress(EOFError, OSError):
        first = connection.recv()
        assert isinstance(first, Listen)
        child = Child(first.loops, Clock(), nodes=first.nodes)
        child.start()
        child.serve(connection)
    os._exit(0)  # the threads of the buses wait for frames


if __name__ == "__main__":
    main()
