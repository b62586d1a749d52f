"""The tasks that every device has beside its own: NMT with gating, heartbeats, EMCY, SDO; one thread, no timers.

Heartbeats are sent from the loop that does the work, so a device that hangs falls silent. On the path of a sample this
module adds only one dictionary look-up per frame.
"""

from __future__ import annotations

import contextlib
import struct
import sys
import time
from collections.abc import Callable, Iterable
from functools import partial

from loopwright.protocol.bus import Bus, BusError
from loopwright.protocol.emergencies import Emergencies
from loopwright.protocol.heartbeats import Consumer, Producer
from loopwright.protocol.object_dictionary import Dictionary
from loopwright.protocol.objects import Value
from loopwright.protocol.profile import (
    HEARTBEAT_FRAME,
    NMT_FRAME,
    NMT_ID,
    Emcy,
    NmtCommand,
    NmtState,
    emcy_id,
    heartbeat_id,
    node_name,
    sdo_request_id,
    sdo_response_id,
)
from loopwright.protocol.sdo import SdoServer

Handler = Callable[[bytes], None]

_IDLE_S = 0.02
_MAX_FRAMES_BETWEEN_TICKS = 64  # reading the clock is a system call in some virtual machines
_PAUSE_AFTER_BUS_ERROR_S = 0.05
_REPORTED_AGAIN_AFTER_S = 5.0  # time without an error after which the next one is reported as new
_COMMUNICATION = (0x1000, 0x1FFF)
_LENGTH_DETAIL = struct.Struct("<HBB")  # detail of EMCY 8210h: COB-ID, bytes received, bytes mapped


class Runtime:
    """Serves one device on the bus.

    handlers: functions for PDOs and SYNC by COB-ID; they are called only in the state operational.
    The other public attributes are hooks of the device.
    """

    def __init__(
        self, bus: Bus, node: int, dictionary: Dictionary, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.node = node
        self.dictionary = dictionary
        self.clock = clock
        self.state = NmtState.BOOT_UP
        self.handlers: dict[int, Handler] = {}
        self.lengths: dict[int, int] = {}
        """Bytes mapped to a received PDO, by COB-ID. Its handler gets exactly that many: a longer frame is cut, a
        shorter one is not processed but reported by EMCY 8210h. Without an entry, every frame is handed over as
        received."""
        self.on_tick: Callable[[float], None] = lambda now: None
        """Hook called with the wall time about every 20 ms, and at least every 64 frames."""
        self.on_leave_operational: Callable[[], None] = lambda: None
        self.on_reset: Callable[[], None] = lambda: None
        """Hook for Reset node: 1000h-1FFFh have their start values already; the device resets everything else."""
        self.on_heartbeat_lost: Callable[[int], bytes | None] = lambda node: b""
        """Hook called with the node that was lost; returns the detail that EMCY 8130h carries after the node, or None
        when nothing depends on that node and no EMCY is sent."""
        self.on_heartbeat: Callable[[int], None] = lambda node: None
        """Hook called for each heartbeat of a node that is listened to."""
        self.due: float | None = None
        """Wall time at which `on_due` is to be called next, s; None for never."""
        self.on_due: Callable[[], None] = lambda: None
        self._bus = bus
        self.send = bus.send
        self.sdo = SdoServer(dictionary.read, dictionary.write, dictionary.room)
        self._emergencies = Emergencies(dictionary, self._send_emcy)
        self.raise_error = self._emergencies.raise_error
        self.clear_error = self._emergencies.clear_error
        self._always: dict[int, Handler] = {}
        self._active: dict[int, tuple[Handler, int | None]] = {}
        """Handler and length of each frame that this device processes in its present state, by COB-ID."""
        self._too_short: set[int] = set()
        """COB-IDs whose last frame was too short."""
        self._watches = Consumer(clock)
        self._listened: frozenset[int] = frozenset()
        self._own_beat = Producer()
        self._countdown = self._between_ticks = 1
        self._last_tick = clock()
        self._stopping = False
        self._told, self._told_at = "", 0.0
        dictionary.on_write["heartbeat_consumer"] = self._write_consumer
        dictionary.on_write["heartbeat_producer"] = self._write_producer
        dictionary.on_read["node_state"] = lambda sub: self.state

    # Start and end

    def start(self) -> None:
        """Boots the device; the present values of the dictionary become those that a reset restores."""
        self.dictionary.set_restore_values()
        self._boot()

    def _boot(self) -> None:
        """Sends the boot-up frame and goes through pre-operational to operational: control must not wait for a
        tuner."""
        for sub in (1, 2):
            self._watches.watch(sub, int(self.dictionary.get("heartbeat_consumer", sub)))
        self._collect_handlers()
        try:
            self._bus.send(heartbeat_id(self.node), HEARTBEAT_FRAME.pack(NmtState.BOOT_UP))
        finally:  # after a reset the device controls again also where the bus does not take that frame
            self._enter(NmtState.PRE_OPERATIONAL)
            self._enter(NmtState.OPERATIONAL)

    def stop(self) -> None:
        """Ends `run`; it may be called from a signal handler."""
        self._stopping = True

    def run(self) -> None:
        """Works until `stop` is called, also when the bus goes down and comes back."""
        while not self._stopping:
            try:
                self.poll()
            except BusError as error:
                self._tell(error)
                time.sleep(_PAUSE_AFTER_BUS_ERROR_S)
                with contextlib.suppress(BusError):
                    self.tick()

    def _tell(self, error: BusError) -> None:
        """Prints a bus error once, as long as it stays the same."""
        now = self.clock()
        if str(error) != self._told or now - self._told_at > _REPORTED_AGAIN_AFTER_S:
            print(f"node {node_name(self.node)}: {error}", file=sys.stderr, flush=True)
        self._told, self._told_at = str(error), now

    def poll(self, idle_s: float = _IDLE_S) -> bool:
        """Processes one frame, or what is due. Returns False when no frame came within `idle_s` of wall time."""
        wait = idle_s
        if self.due is not None:
            wait = self.due - self.clock()
            if wait <= 0.0:
                self.due = None
                self.on_due()
                wait = 0.0
            elif wait > idle_s:
                wait = idle_s
        frame = self._bus.recv(wait)
        if frame is None:
            if wait:
                self.tick()
            return False
        active = self._active.get(frame[0])
        if active is not None:
            handler, length = active
            if length is None or len(frame[1]) == length:
                handler(frame[1])
            else:
                self._on_other_length(frame[0], handler, length, frame[1])
        self._countdown -= 1
        if self._countdown <= 0:
            self.tick()
        return True

    def tick(self) -> None:
        """Does what time has made due: heartbeats, nodes that have fallen silent, the device's own work."""
        now = self.clock()
        slow = now - self._last_tick > _IDLE_S
        between = self._between_ticks // 2 if slow else self._between_ticks * 2
        self._countdown = self._between_ticks = min(max(between, 1), _MAX_FRAMES_BETWEEN_TICKS)
        self._last_tick = now
        try:
            self._produce_heartbeat(now)
            self._emergencies.send_unsent()
        finally:  # the device's own time goes on also where the bus takes no frame
            try:
                self._consume_heartbeats(now)
            finally:
                self.on_tick(now)

    # NMT

    def _enter(self, state: NmtState) -> None:
        if state is self.state:
            return
        try:
            if self.state is NmtState.OPERATIONAL:
                self.on_leave_operational()  # first, because it may send a last PDO
        finally:  # the command holds also where the bus does not take that PDO
            self.state = state
            self.gate()
            self._own_beat.restart()

    def gate(self) -> None:
        """Activates PDOs in operational only, and SDO in every state but stopped."""
        self._active = {can_id: (handler, None) for can_id, handler in self._always.items()}
        if self.state is NmtState.OPERATIONAL:
            for can_id, handler in self.handlers.items():
                self._active[can_id] = handler, self.lengths.get(can_id)
            for can_id in self._too_short:
                self._active[can_id] = partial(self._after_too_short, can_id), None
        if self.state is NmtState.STOPPED:
            del self._active[sdo_request_id(self.node)]

    def _collect_handlers(self) -> None:
        self._always = {NMT_ID: self._on_nmt, sdo_request_id(self.node): self._on_sdo}
        for node in self._listened | {watch.node for watch in self._watches}:
            self._always[heartbeat_id(node)] = partial(self._on_heartbeat, node)
        self.gate()
        self._bus.set_filters({*self._always, *self.handlers})

    def _on_nmt(self, data: bytes) -> None:
        if len(data) < NMT_FRAME.size:
            return
        command, node = NMT_FRAME.unpack_from(data)
        if node not in (0, self.node):
            return
        if command == NmtCommand.START:
            self._enter(NmtState.OPERATIONAL)
        elif command == NmtCommand.STOP:
            self._enter(NmtState.STOPPED)
        elif command == NmtCommand.PRE_OPERATIONAL:
            self._enter(NmtState.PRE_OPERATIONAL)
        elif command in (NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION):
            self._reset(command == NmtCommand.RESET_NODE)

    def _reset(self, node: bool) -> None:
        """Resets the communication, or the whole node: both restore 1000h-1FFFh as at power-on.

        The writers of changed objects are called as by an SDO, in the state in which these objects may be written.
        """
        with contextlib.suppress(BusError):  # the bus may not take a last PDO; the reset goes on
            self._enter(NmtState.PRE_OPERATIONAL)
        self.sdo.end()
        self._emergencies.forget()
        self._too_short.clear()
        self._watches.clear()
        for name, sub in self.dictionary.restore(*_COMMUNICATION):
            if name in self.dictionary.on_write:
                self.dictionary.on_write[name](sub, self.dictionary.get(name, sub))
        if node:
            self.on_reset()
        self.state = NmtState.BOOT_UP
        self._boot()

    # PDOs that are not as long as mapped

    def _on_other_length(self, can_id: int, handler: Handler, length: int, data: bytes) -> None:
        if len(data) > length:
            handler(data[:length])
            return
        detail = _LENGTH_DETAIL.pack(can_id, len(data), length)
        self.raise_error(Emcy.PDO_LENGTH, detail, source=detail[:2])
        self._too_short.add(can_id)
        self.gate()

    def _after_too_short(self, can_id: int, data: bytes) -> None:
        """Replaces the handler until a frame is long enough, so that no other frame pays for the check."""
        length = self.lengths[can_id]
        if len(data) >= length:
            self._too_short.discard(can_id)
            self.gate()
            self.clear_error(Emcy.PDO_LENGTH, _LENGTH_DETAIL.pack(can_id, 0, 0)[:2])
            self.handlers[can_id](data[:length])

    # SDO

    def _on_sdo(self, data: bytes) -> None:
        answer = self.sdo.answer(data)
        if answer is not None:
            for at in range(0, len(answer), 8):
                self._bus.send(sdo_response_id(self.node), answer[at : at + 8])

    # Heartbeats

    def _produce_heartbeat(self, now: float) -> None:
        period_ms = int(self.dictionary.get("heartbeat_producer"))
        if self._own_beat.is_due(now, period_ms / 1000.0):
            self._bus.send(heartbeat_id(self.node), HEARTBEAT_FRAME.pack(self.state))

    def _consume_heartbeats(self, now: float) -> None:
        for watch in self._watches.overdue(now):
            detail = self.on_heartbeat_lost(watch.node)
            if detail is not None:
                watch.lost = True
                self.raise_error(Emcy.HEARTBEAT_LOST, bytes((watch.node,)) + detail)

    def listen(self, nodes: Iterable[int]) -> None:
        """Sets the nodes whose heartbeats are passed to `on_heartbeat`, besides those of 1016h; 0 stands for none."""
        listened = frozenset(nodes) - {0}
        if listened != self._listened:
            self._listened = listened
            self._collect_handlers()

    def _on_heartbeat(self, node: int, data: bytes) -> None:
        self.on_heartbeat(node)
        for watch in self._watches:
            if watch.node == node and self._watches.heard(watch):
                self._heartbeats_back()

    def _heartbeats_back(self) -> None:
        lost = {bytes((watch.node,)) for watch in self._watches if watch.lost}
        for source in self._emergencies.sources(Emcy.HEARTBEAT_LOST):
            if source not in lost:
                self.clear_error(Emcy.HEARTBEAT_LOST, source)

    def _write_consumer(self, sub: int, value: Value) -> None:
        self._watches.watch(sub, int(value))
        self._collect_handlers()
        self._heartbeats_back()

    def _write_producer(self, sub: int, value: Value) -> None:
        self._own_beat.restart()

    # Emergencies

    def _send_emcy(self, frame: bytes) -> None:
        if self.state is not NmtState.STOPPED:
            self._bus.send(emcy_id(self.node), frame)
