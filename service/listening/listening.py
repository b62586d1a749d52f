"""The listening of a service: which buses are heard, what is read by SDO beside, what is stored, and the history."""

from __future__ import annotations

import logging
import math
import threading
import time
import zlib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

import numpy as np

from loopwright.protocol.profile import PLANT_NODE, ChannelIds, channel_ids
from loopwright.service.inputs.config import BusConfig, LoopConfig
from loopwright.service.listening.bins import (
    GAP_BEFORE,
    GainSet,
    Rows,
    between,
    gaps,
    joined,
    shortest_gap_s,
    thinned,
    unpacked,
)
from loopwright.service.listening.block_writer import BlockWriter
from loopwright.service.listening.heard_loop import Heard, InEffect
from loopwright.service.listening.heard_node import HeardHeartbeat
from loopwright.service.listening.messages import HistoryAnswer, Learn, NewSamples, Report
from loopwright.service.listening.process import ListeningProcess, NotListening
from loopwright.service.store import history
from loopwright.service.store.clock_watch import uptime_s
from loopwright.service.store.history import HistoryBlock
from loopwright.service.store.store import Store
from loopwright.service.telemetry.metrics import FRAMES_RECEIVED, LISTENING_UP
from loopwright.tuning.gains import Gains
from loopwright.tuning.reasons import Ended

log = logging.getLogger(__name__)

Read = Callable[[str], InEffect | None]
"""Reads a loop; None while a job that has the loop has not read it yet. Raises Ended."""

_OPENED_TWICE = ("socketcan", "socketcand")
"""Kinds of bus that a second process can open beside the service. Of a serial adapter (slcan) it would take frames
away, a virtual bus exists in one process only, and drivers of other adapters refuse or disturb."""
PER_LOOP_S, EACH_S = 2.0, 0.1
"""Least wall time between two readings of a loop, and between two readings, s."""
_LOOK_S = 0.5
HOLE_S = 128.0
"""Wall time without a stored sample at the edge of what is known that is shown as a gap, s: blocks are stored once a
minute, and a bin of the coarsest level is 32 s."""
_STOP_S = 5.0
NOT_BEGUN = "listening has not begun yet"


@dataclass(frozen=True)
class History:
    """The history of a loop in a time.

    no_data: why the loop is not heard at present; None where it is.
    """

    rows: Rows
    no_data: str | None


class Listening:
    """Listens for the loops of this host once it is started, and knows the stored history of all.

    loops, buses: the configuration.
    read: reads set-point, mode and gains of a loop, which its process data do not carry.
    on: False where nothing is to be heard.
    """

    def __init__(
        self,
        loops: Mapping[str, LoopConfig],
        store: Store,
        read: Read | None = None,
        buses: Mapping[str, BusConfig] | None = None,
        on: bool = True,
    ) -> None:
        self._loops, self._store, self._read = loops, store, read
        self.off = {url: why for url in {loop.bus for loop in loops.values()} if (why := _off(url, buses or {}, on))}
        """Buses that are not listened to, with the reason."""
        self._down: Mapping[str, str] = {}
        self._writer = BlockWriter(store)
        self.process = ListeningProcess(
            _ids(loops, self.off), self._take, on_samples=self._take_samples, nodes=_nodes(loops, self.off)
        )
        self.heard: Mapping[str, Heard] = {}
        """What was heard last, by tag: replaced as a whole once a second."""
        self.nodes: Mapping[tuple[str, int], HeardHeartbeat] = {}
        """The heartbeats heard last, by bus and node: replaced as a whole once a second."""
        self._gains: dict[str, tuple[GainSet, float, float]] = {}
        """The gains of each loop as they were read last, and when that reading began: wall time, and uptime_s."""
        self.on_report: Callable[[], None] = lambda: None
        """Called in another thread when `heard` or a bus may have changed."""
        self.on_samples: Callable[[NewSamples], None] = lambda _: None
        """Called in another thread with the new samples of the loops that are watched."""
        self._to_read: Collection[str] = ()
        self._over = threading.Event()
        self._reader = threading.Thread(target=self._read_loops, name="listening: readings", daemon=True)
        self._started = self._begun = False

    def start(self) -> None:
        """Starts to listen, in the background."""
        for url, why in sorted(self.off.items()):
            log.info("no history of the loops on %s: %s", url, why)
        if len(self.off) < len({loop.bus for loop in self._loops.values()}):
            self._started = True
            self._writer.start()
            self.process.start()
            if self._read is not None:
                self._reader.start()

    @property
    def begun(self) -> bool:
        """Returns whether the process that listens has reported by now: before that no bus is known to be heard."""
        return self._begun

    def close(self) -> None:
        self._over.set()
        if self._started:
            self._reader.join(_STOP_S)
            self.process.close()
            self._writer.close()

    def history(self, tag: str, from_s: float, to_s: float, points: int) -> History:
        """Returns at most `points` bins of a loop of any host, from memory and from the database. Raises
        SQLAlchemyError."""
        answer, no_data = self._memory(tag, from_s, to_s, points)
        oldest_s = math.inf if answer is None else answer.oldest_s
        stored = self._stored(tag, from_s, min(to_s, oldest_s), points) if from_s < oldest_s else []
        return History(_whole(stored, answer, from_s, to_s, points), no_data)

    def watch(self, tags: Collection[str]) -> None:
        """Asks for the new samples of these loops, which `on_samples` gets."""
        if self._started:
            self.process.watch(
                frozenset(tag for tag in tags if tag in self._loops and self._loops[tag].bus not in self.off)
            )

    def why_not_heard(self, tag: str) -> str | None:
        """Returns why a loop is not heard at present, as far as its bus is the reason; None: its bus is heard."""
        if tag not in self._loops:
            return "the loop belongs to another gateway"
        url = self._loops[tag].bus
        if url in self.off:
            return self.off[url]
        return self._down.get(url) if self._begun else NOT_BEGUN

    def gains_of(self, tag: str) -> Gains | None:
        """Returns the gains of a loop as they were read last; None where they are not known."""
        found = self.gains_read(tag)
        return None if found is None else found[0]

    def gains_read(self, tag: str) -> tuple[Gains, float] | None:
        """Returns the gains of a loop as they were read last, and when that reading began, wall time, s; None where
        they are not known."""
        found = self._gains.get(tag)
        return None if found is None else (Gains(*found[0]), found[1])

    def gains_read_since(self, tag: str, since_s: float) -> Gains | None:
        """Returns the gains of a loop as they were read last, where that reading began after this time of uptime_s,
        which nobody sets; None where they are not known."""
        found = self._gains.get(tag)
        return None if found is None or found[2] <= since_s else Gains(*found[0])

    def buses(self) -> dict[str, str | None]:
        """Returns the buses of this host, each with why it is not heard at present; None: it is heard."""
        return {self._loops[tag].bus: self.why_not_heard(tag) for tag in self._loops}

    def memory(self, tag: str, from_s: float, to_s: float, points: int) -> Rows:
        """Returns at most `points` bins of a loop from memory alone; none where the loop is not heard."""
        answer, _ = self._memory(tag, from_s, to_s, points)
        return Rows() if answer is None else answer.rows

    def _memory(self, tag: str, from_s: float, to_s: float, points: int) -> tuple[HistoryAnswer | None, str | None]:
        """Returns what is in memory, and why the loop is not heard."""
        if tag not in self._loops:
            return None, "the loop belongs to another gateway, which stores its history once a minute"
        url = self._loops[tag].bus
        if url in self.off:
            return None, self.off[url]
        if not self._started:
            return None, NOT_BEGUN
        try:
            return self.process.ask(tag, from_s, to_s, points), self._down.get(url)
        except NotListening as why:
            return None, str(why)

    def _stored(self, tag: str, from_s: float, to_s: float, points: int) -> list[Rows]:
        """Returns what the database has. Where it lacks blocks there is a gap."""
        parts: list[Rows] = []
        last_s: float | None = None
        for blocks in history.read(self._store, tag, from_s, to_s):
            each = []
            for block in blocks:
                try:
                    rows = unpacked(block.data, block.count)
                except (zlib.error, ValueError):
                    log.error("a block of the history of %s is damaged: it is shown as a gap", tag)
                    continue
                if last_s is not None and block.after_s != last_s:
                    rows.bins["gap"][0] |= GAP_BEFORE
                if last_s is not None and block.first_s <= last_s:  # the clock was put back: this time was heard twice
                    rows = _later(rows, last_s)
                if not len(rows.bins):
                    continue
                each.append(rows)
                last_s = block.last_s
            if not each:
                continue
            rows = joined(each)
            found = gaps(rows.bins, from_s, to_s)
            bins = between(rows.bins, from_s, np.nextafter(to_s, -math.inf))
            if len(bins):
                shortest_s = shortest_gap_s(len(bins), from_s, to_s, points)
                told = tuple(gap for gap in found if gap[1] - gap[0] >= shortest_s)
                parts.append(Rows(thinned(bins, from_s, to_s, points), rows.sets, told))
        return parts

    # -- beside the process

    def _take(self, report: Report) -> None:
        self._down, self.heard, self.nodes = report.down, report.heard, report.nodes
        for url, frames in report.frames.items():
            FRAMES_RECEIVED.labels(url).inc(frames)
            LISTENING_UP.labels(url).set(0 if url in report.down else 1)
        self._begun = True
        self._to_read = report.to_read
        self._writer.put(
            HistoryBlock(block.tag, block.after_s, block.first_s, block.last_s, block.count, block.data)
            for block in report.blocks
        )
        self.on_report()

    def _take_samples(self, new: NewSamples) -> None:
        self.on_samples(new)

    def _read_loops(self) -> None:
        """Reads the loops that the process names, one after the other."""
        last: dict[str, float] = {}
        while not self._over.wait(_LOOK_S):
            for tag in self._to_read:
                if time.monotonic() - last.get(tag, -math.inf) < PER_LOOP_S:
                    continue
                last[tag], began_s = time.monotonic(), uptime_s()
                try:
                    found = self._read(tag) if self._read is not None else None
                except Ended:
                    found = None  # what is wrong with the loop is shown where it is asked for
                except Exception:
                    log.exception("defect while reading %s for the history", tag)
                    found = None
                if found is not None:
                    if found.gains is None:
                        self._gains.pop(tag, None)
                    else:
                        self._gains[tag] = found.gains, found.began_s, began_s
                    self.process.learn(Learn(tag, found))
                if self._over.wait(EACH_S):
                    return


def _off(url: str, buses: Mapping[str, BusConfig], on: bool) -> str | None:
    """Returns why a bus is not listened to; None where it is."""
    if not on or not buses.get(url, BusConfig()).listen:
        return "listening is turned off"
    kind = url.partition(":")[0]
    if kind not in _OPENED_TWICE:
        return f"a bus of the kind {kind} cannot be opened by a second process"
    return None


def _ids(loops: Mapping[str, LoopConfig], off: Collection[str]) -> dict[str, dict[str, ChannelIds]]:
    found: dict[str, dict[str, ChannelIds]] = {}
    for tag, loop in loops.items():
        if loop.bus not in off:
            ids = channel_ids(loop.channel, loop.plant_node or PLANT_NODE, loop.controller_node)
            found.setdefault(loop.bus, {})[tag] = ids
    return found


def _nodes(loops: Mapping[str, LoopConfig], off: Collection[str]) -> dict[str, set[int]]:
    found: dict[str, set[int]] = {}
    for loop in loops.values():
        if loop.bus not in off:
            named = (loop.controller_node, loop.plant_node)
            found.setdefault(loop.bus, set()).update(node for node in named if node is not None)
    return found


def _later(rows: Rows, than_s: float) -> Rows:
    """Returns the bins that begin later than this time, after a gap."""
    bins = rows.bins[rows.bins["at_s"] > than_s]
    bins["gap"][:1] |= GAP_BEFORE
    return Rows(bins, rows.sets)


def _whole(stored: list[Rows], answer: HistoryAnswer | None, from_s: float, to_s: float, points: int) -> Rows:
    """Returns what is stored and what is in memory as one."""
    heard = answer is not None and len(answer.rows.bins) > 0
    parts = [*stored, answer.rows] if answer is not None and heard else stored
    rows = joined(parts)
    if not len(rows.bins):
        between_samples = answer is not None and answer.oldest_s <= from_s and answer.silent_from_s > from_s
        return Rows() if between_samples else Rows(gaps=((from_s, to_s),))
    found: list[tuple[float, float]] = []
    last_s = from_s
    for part in parts:
        first_s = part.bins["at_s"][0].item()
        begins = [end for begin, end in part.gaps if begin == -math.inf]
        if begins or first_s - last_s > HOLE_S:
            found.append((last_s, begins[0] if begins else first_s))
        found += [gap for gap in part.gaps if gap[0] != -math.inf]
        last_s = part.bins["until_s"][-1].item()
    if answer is not None and heard:
        missing_from_s = max(last_s, answer.silent_from_s)
    else:
        missing_from_s = last_s if to_s - last_s > HOLE_S else to_s
    found.append((missing_from_s, to_s))
    shortest_s = shortest_gap_s(len(rows.bins), from_s, to_s, points)
    clipped = ((max(begin, from_s), min(end, to_s)) for begin, end in found if end - begin >= shortest_s)
    whole = tuple(gap for gap in clipped if gap[1] > gap[0])
    return Rows(thinned(rows.bins, from_s, to_s, points), rows.sets, whole)
