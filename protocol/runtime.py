"""What every device does beside its work: NMT with gating, heartbeats, EMCY, SDO. One thread, one bus, no timers.

Heartbeats go out from the loop that does the work, so a device that hangs falls silent. Nothing here is on the path of
a sample but one dictionary look-up per frame.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from protocol.bus import Bus, BusError
from protocol.dictionary import Dictionary
from protocol.objects import Value
from protocol.profile import (
    EMCY_FRAME,
    EMCY_REGISTER,
    HEARTBEAT_FRAME,
    NMT_FRAME,
    NMT_ID,
    Abort,
    Emcy,
    NmtCommand,
    NmtState,
    emcy_id,
    heartbeat_id,
    sdo_request_id,
    sdo_response_id,
)
from protocol.sdo import SdoAbort, SdoServer

Handler = Callable[[bytes], None]

_IDLE_S = 0.02
_MOST_FRAMES_BETWEEN_TICKS = 64  # reading the clock is a system call in some virtual machines
_PAUSE_AFTER_BUS_ERROR_S = 0.05


@dataclass(slots=True)
class _Watch:
    node: int
    limit_s: float
    heard: float | None = None
    """Wall time of the last heartbeat; None before the first one (watching starts with it) and after the loss."""
    lost: bool = False


class Runtime:
    """`handlers` take PDOs and SYNC by COB-ID, in operational only. The other attributes are the device's hooks."""

    def __init__(
        self, bus: Bus, node: int, dictionary: Dictionary, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.node = node
        self.dictionary = dictionary
        self.clock = clock
        self.state = NmtState.BOOT_UP
        self.handlers: dict[int, Handler] = {}
        self.on_tick: Callable[[float], None] = lambda now: None
        """Called with the wall time about every 20 ms, and at least every 64 frames."""
        self.on_leave_operational: Callable[[], None] = lambda: None
        self.on_reset: Callable[[], None] = lambda: None
        self.on_heartbeat_lost: Callable[[int], bytes | None] = lambda node: b""
        """Node lost; returns what EMCY 8130h carries behind the node, None when nothing hung on it: no emergency."""
        self.due: float | None = None
        """Wall time at which `on_due` is to be called next."""
        self.on_due: Callable[[], None] = lambda: None
        self._bus = bus
        self.send = bus.send
        self._sdo = SdoServer(dictionary.read, dictionary.write)
        self._always: dict[int, Handler] = {}
        self._active: dict[int, Handler] = {}
        self._watches: dict[int, _Watch] = {}
        self._errors: list[tuple[Emcy, bytes]] = []
        """Each with its source, the first byte of its detail: a channel, or a node that was lost."""
        self._history: list[int] = []
        self._next_heartbeat = 0.0
        self._countdown = self._between_ticks = 1
        self._last_tick = clock()
        self._stopping = False
        dictionary.on_write["heartbeat_consumer"] = self._write_consumer
        dictionary.on_write["heartbeat_producer"] = self._write_producer
        dictionary.on_read["error_register"] = lambda sub: self._error_register()
        dictionary.on_read["error_field"] = lambda sub: (self._history + [0] * 4)[sub - 1]

    # Life

    def start(self) -> None:
        """Boot-up, pre-operational, and on to operational by itself: control must not wait for a tuner."""
        for sub in (1, 2):
            self._watch(sub, int(self.dictionary.get("heartbeat_consumer", sub)))
        self._collect_handlers()
        self._bus.send(heartbeat_id(self.node), HEARTBEAT_FRAME.pack(NmtState.BOOT_UP))
        self._enter(NmtState.PRE_OPERATIONAL)
        self._enter(NmtState.OPERATIONAL)

    def stop(self) -> None:
        """Ends `run`; may be called from a signal handler."""
        self._stopping = True

    def run(self) -> None:
        """Works until `stop`. A bus that goes down and comes back is lived through."""
        while not self._stopping:
            try:
                self.poll()
            except BusError:
                time.sleep(_PAUSE_AFTER_BUS_ERROR_S)
                with contextlib.suppress(BusError):
                    self._tick()

    def poll(self, idle_s: float = _IDLE_S) -> bool:
        """One frame, or whatever time has made due. False when no frame came within `idle_s`."""
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
                self._tick()
            return False
        handler = self._active.get(frame[0])
        if handler is not None:
            handler(frame[1])
        self._countdown -= 1
        if self._countdown <= 0:
            self._tick()
        return True

    def _tick(self) -> None:
        now = self.clock()
        slow = now - self._last_tick > _IDLE_S
        between = self._between_ticks // 2 if slow else self._between_ticks * 2
        self._countdown = self._between_ticks = min(max(between, 1), _MOST_FRAMES_BETWEEN_TICKS)
        self._last_tick = now
        self._produce_heartbeat(now)
        self._consume_heartbeats(now)
        self.on_tick(now)

    # NMT

    def _enter(self, state: NmtState) -> None:
        if state is self.state:
            return
        left_operational = self.state is NmtState.OPERATIONAL
        self.state = state
        self._gate()
        if left_operational:
            self.on_leave_operational()
        self._next_heartbeat = 0.0

    def _gate(self) -> None:
        """PDOs in operational only; SDO not in stopped."""
        self._active = dict(self._always)
        if self.state is NmtState.OPERATIONAL:
            self._active.update(self.handlers)
        if self.state is NmtState.STOPPED:
            del self._active[sdo_request_id(self.node)]

    def _collect_handlers(self) -> None:
        self._always = {NMT_ID: self._on_nmt, sdo_request_id(self.node): self._on_sdo}
        for watch in self._watches.values():
            self._always[heartbeat_id(watch.node)] = partial(self._on_heartbeat, watch)
        self._gate()
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
            self._enter(NmtState.BOOT_UP)
            if command == NmtCommand.RESET_NODE:
                self.on_reset()
            self._errors.clear()
            self.start()

    # SDO

    def _on_sdo(self, data: bytes) -> None:
        answer = self._sdo.answer(data)
        if answer is not None:
            self._bus.send(sdo_response_id(self.node), answer)

    # Heartbeats

    def _produce_heartbeat(self, now: float) -> None:
        period_ms = int(self.dictionary.get("heartbeat_producer"))
        if period_ms and now >= self._next_heartbeat:
            self._next_heartbeat = now + period_ms / 1000.0
            self._bus.send(heartbeat_id(self.node), HEARTBEAT_FRAME.pack(self.state))

    def _consume_heartbeats(self, now: float) -> None:
        for watch in self._watches.values():
            if watch.heard is not None and now - watch.heard > watch.limit_s:
                watch.heard = None
                detail = self.on_heartbeat_lost(watch.node)
                if detail is not None:
                    watch.lost = True
                    self.raise_error(Emcy.HEARTBEAT_LOST, bytes((watch.node,)) + detail)

    def _on_heartbeat(self, watch: _Watch, data: bytes) -> None:
        watch.heard = self.clock()
        if watch.lost:
            watch.lost = False
            self._heartbeats_back()

    def _heartbeats_back(self) -> None:
        lost = {bytes((watch.node,)) for watch in self._watches.values() if watch.lost}
        for code, source in list(self._errors):
            if code is Emcy.HEARTBEAT_LOST and source not in lost:
                self.clear_error(code, source)

    def _write_consumer(self, sub: int, value: Value) -> None:
        self._watch(sub, int(value))
        self._collect_handlers()
        self._heartbeats_back()

    def _watch(self, sub: int, value: int) -> None:
        """Node-ID in bits 16-22, milliseconds below; a new value waits for a first heartbeat again."""
        node, limit_ms = value >> 16 & 0xFF, value & 0xFFFF
        if value >> 24 or node > 127:
            raise SdoAbort(Abort.INVALID_VALUE)
        if node and limit_ms:
            self._watches[sub] = _Watch(node, limit_ms / 1000.0)
        else:
            self._watches.pop(sub, None)

    def _write_producer(self, sub: int, value: Value) -> None:
        self._next_heartbeat = 0.0

    # Emergencies

    def raise_error(self, code: Emcy, detail: bytes = b"") -> None:
        """Says it once per occurrence; an error that stays is not repeated until `clear_error`.

        The first byte of `detail` is the source. That of another source is said too: whoever holds channel 2 must not
        miss what happens to it because channel 1 has the same error.
        """
        error = code, detail[:1]
        if error in self._errors:
            return
        self._errors.append(error)
        self._history = [int(code), *self._history][:4]
        self._send_emcy(code, EMCY_REGISTER[code], detail)

    def clear_error(self, code: Emcy, source: bytes | None = None) -> None:
        """Of one source, or of all. EMCY 0000h says it, with the register of what is left."""
        left = [error for error in self._errors if error[0] != code or source not in (None, error[1])]
        if len(left) < len(self._errors):
            self._errors = left
            self._send_emcy(Emcy.ERROR_GONE, self._error_register(), b"")

    def _send_emcy(self, code: Emcy, register: int, detail: bytes) -> None:
        if self.state is not NmtState.STOPPED:
            self._bus.send(emcy_id(self.node), EMCY_FRAME.pack(code, register, detail[:5]))

    def _error_register(self) -> int:
        register = 0
        for code, _ in self._errors:
            register |= EMCY_REGISTER[code]
        return register
