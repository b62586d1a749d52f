"""The tuner's side of the bus: parameters by SDO, samples from the PDOs of one loop, and the tuner's heartbeat.

All calls block in one thread: a wait for an answer or a sample also sends the heartbeat, so a tuner that hangs falls
silent. Frames that arrive during an SDO are taken in order and returned later.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum

from loopwright.protocol.bus import Bus, Frame
from loopwright.protocol.objects import Device, Object, Shape, Type, Value, lookup
from loopwright.protocol.patience import WAIT_S, Patience
from loopwright.protocol.process_data import BusSample, ProcessData
from loopwright.protocol.profile import (
    HEARTBEAT_FRAME,
    PLANT_NODE,
    RENEWAL_FRAME,
    Abort,
    NmtState,
    channel_ids,
    heartbeat_id,
    node_name,
    renewal_id,
    sdo_request_id,
    sdo_response_id,
)
from loopwright.protocol.real32 import shortest
from loopwright.protocol.sdo import SdoAbort
from loopwright.protocol.sdo_segments import SegmentedUpload
from loopwright.protocol.station import Station

_TAKE_IN_S = 0.1
"""Time for which frames that are here already are received where nothing is asked for, s."""
_BACKLOG_S = 30.0
"""Time for which they are searched for an answer, or for all segments of one, s: a plant at full speed leaves thousands
of them to a busy machine."""
_ABORT = 0x80
_URGENT = ("controller_session_renewal", "controller_order_close", "controller_order_hold")
RENEWAL_S = 0.5
"""Wall time between two renewals of a session's lease, s. They are not answered, and some may be lost."""
BEAT_S = 0.6
"""Time within which a node of the profile sends its next heartbeat, s."""
TURN_S = 10.0
"""Longest wait for a node's lock, s. After it the loop renews no lease any more, because the lock's holder hangs."""

ABORT_TEXT = {
    Abort.TOGGLE: "toggle bit not alternated",
    Abort.COMMAND: "command not known",
    Abort.BLOCK_SIZE: "wrong block size",
    Abort.SEQUENCE_NUMBER: "wrong sequence number",
    Abort.OUT_OF_MEMORY: "out of memory",
    Abort.WRITE_ONLY: "write only",
    Abort.READ_ONLY: "read only",
    Abort.NO_OBJECT: "no such object",
    Abort.INCOMPATIBLE: "does not fit what is there already",
    Abort.LENGTH: "wrong length",
    Abort.NO_SUBINDEX: "no such sub-index",
    Abort.INVALID_VALUE: "invalid value",
    Abort.TOO_HIGH: "above the limit",
    Abort.TOO_LOW: "below the limit",
    Abort.MAXIMUM_BELOW_MINIMUM: "maximum below minimum",
    Abort.GENERAL: "general error",
    Abort.NOT_STORED: "the device could not store it",
    Abort.LOCAL_CONTROL: "something else controls it",
    Abort.DEVICE_STATE: "not in the present state of the device",
    Abort.NO_DATA: "no data",
}


class FailureKind(StrEnum):
    """The ways in which an SDO fails."""

    TIMEOUT = "timeout"
    ABORT = "abort"


class TunerError(Exception):
    """Raised for an SDO that failed: without an answer (TIMEOUT) of `node`, or refused by the device with `code`
    (ABORT)."""

    def __init__(self, kind: FailureKind, text: str, code: int = 0, node: int = 0) -> None:
        super().__init__(text)
        self.kind = kind
        self.code = code
        self.node = node


class Tuner(ProcessData):
    """The client of one loop: one channel of a controller and of the plant I/O that feeds it."""

    def __init__(
        self,
        url: str,
        controller_node: int,
        plant_node: int | None,
        channel: int = 1,
        *,
        station: Station | None = None,
        sdo_timeout_s: float = 0.25,
        sdo_tries: int = 3,
    ) -> None:
        """Opens the bus.

        plant_node: node-ID of the plant I/O; None for a plant without SDO, whose PV frames are still expected from node
        10h.
        station: state that this process shares; by default a new one, for a client that only reads.
        """
        super().__init__()
        self.station = station or Station()
        ids = channel_ids(channel, plant_node or PLANT_NODE, controller_node)
        self._url = url
        self._controller = controller_node
        self._plant = plant_node
        self._channel = channel
        self._sdo_timeout_s = sdo_timeout_s
        self._sdo_tries = sdo_tries
        self._retry_s, self._retry_until = 0.0, 0.0
        self._pv_id, self._mv_id, self._status_id = ids.pv, ids.mv, ids.status
        self._alive = {heartbeat_id(node): node for node in (controller_node, plant_node) if node is not None}
        self._bus: Bus = self.station.open_bus(url)
        self._heard = frozenset({self._pv_id, self._mv_id, self._status_id, *self._alive})
        self._bus.set_filters(self._heard)
        self._answers: deque[Frame] = deque()
        self._samples: deque[BusSample] = deque()
        self.beating = False
        """Whether this tuner sends heartbeats. A client that only reads must not keep alive the trial of a tuner that
        died."""
        self.session = 0
        """Number of the session whose lease is renewed during every wait; 0 for none."""
        self._renewed_at = 0.0
        self.longest_between_renewals_s = 0.0
        """Longest time between two renewals of the session, as this tuner sent them, s."""
        self._check_stop_request: Callable[[], None] = lambda: None
        self.node_states: dict[int, int] = {}
        """NMT states of controller and plant from their latest heartbeats, by node-ID."""
        self._beaten_at: dict[int, float] = {}
        """Times on the clock at which a heartbeat of controller and plant was received last, by node-ID, s."""
        self.restarted = False
        """Whether the controller has sent a boot-up frame."""

    def close(self) -> None:
        self._bus.close()

    # -- heartbeat and frames

    def start_heartbeat(self) -> None:
        """Starts the heartbeat, and sends the first one at once. Raises NodeTaken."""
        self.station.join(self._url)
        self.beating = True
        self.station.beat(self._url, self._bus, self.station.monotonic())

    def set_renewed_session(self, session: int, check_stop_request: Callable[[], None] = lambda: None) -> None:
        """Renews the lease of this session, which was just granted, from now on; 0 ends the renewals.

        check_stop_request: called while the loop waits for a node's lock; it raises when the job is asked to stop.
        """
        self.session, self._renewed_at, self._check_stop_request = session, self.station.monotonic(), check_stop_request
        if session:
            self.longest_between_renewals_s = 0.0

    def heartbeat(self) -> float:
        """Sends the heartbeat when it is due and no other loop on this bus has sent it, and the renewal of the session.
        Returns the time on the clock, whose reading is a system call in some virtual machines."""
        if not self.beating:
            return self.station.monotonic()
        now = self.station.beat_if_due(self._url, self._bus)
        if self.session and now - self._renewed_at >= RENEWAL_S:
            self.longest_between_renewals_s = max(self.longest_between_renewals_s, now - self._renewed_at)
            self._renewed_at = now
            self._bus.send(renewal_id(self._controller), RENEWAL_FRAME.pack(self.session, self._channel))
        return now

    def beats(self, node: int) -> bool:
        """Whether a node that has just left a request unanswered still sends heartbeats. One that was never heard is
        given the time of a heartbeat."""
        give_up = self.station.monotonic() + BEAT_S
        while node in self._alive.values() and node not in self._beaten_at:
            left = give_up - self.heartbeat()
            if left <= 0.0:
                return False
            self._receive(min(left, WAIT_S))
        return self.station.monotonic() - self._beaten_at.get(node, -math.inf) < BEAT_S

    def sample(self, timeout_s: float) -> BusSample | None:
        """Returns the next sample in order, or None when none came within `timeout_s` of wall time."""
        now = self.heartbeat()  # also while samples are queued: a tuner that catches up is alive
        patience = Patience(now + timeout_s, _TAKE_IN_S)
        while not self._samples:
            wait = patience.wait(now)
            if wait is None or (not self._receive(wait) and not wait):
                return None
            now = self.heartbeat()
        return self._samples.popleft()

    def drain(self) -> None:
        """Receives all waiting frames and drops their samples, so that the next sample is a new one."""
        self._take_in()
        self._samples.clear()

    def _take_in(self) -> None:
        """Receives the waiting frames in order, for a limited time: on an overloaded bus the rest is received later, so
        that the heartbeat continues."""
        give_up = self.station.monotonic() + _TAKE_IN_S
        while self._receive(0.0) and self.heartbeat() < give_up:
            pass

    def _receive(self, timeout_s: float) -> bool:
        frame = self._bus.recv(timeout_s)
        if frame is None:
            return False
        can_id, data = frame
        try:
            if can_id == self._mv_id:
                answered = self.take_mv(data)
                if answered is not None:
                    n, pv, mv = answered
                    sample = BusSample(n, shortest(pv), shortest(mv), self.mode, self.on_trial, self.sp)
                    self._samples.append(sample)
            elif can_id == self._pv_id:
                self.take_pv(data)
            elif can_id == self._status_id:
                self.take_status(data)
            elif can_id in self._alive:
                (state,) = HEARTBEAT_FRAME.unpack(data)
                self.node_states[self._alive[can_id]] = state
                self._beaten_at[self._alive[can_id]] = self.station.monotonic()
                self.restarted |= state == NmtState.BOOT_UP and self._alive[can_id] == self._controller
            else:
                self._answers.append(frame)
        except struct.error:
            pass  # a foreign frame with this identifier: it carries no sample
        return True

    # -- SDO

    def read(self, name: str, sub: int | None = None, node: int | None = None) -> Value:
        """Returns the value of an object by name, of this tuner's channel unless `sub` is given. Raises TunerError."""
        entry, node, sub = self._address(name, sub, node)
        with self._turn(node, name):
            data = self._request(entry, node, sub, 0x40, b"\0\0\0\0")
            if data[0] & 0x02:
                length = 4 - (data[0] >> 2 & 3) if data[0] & 0x01 else entry.type.size
                raw = data[4 : 4 + length]
            else:
                raw = self._segments(entry, node, data)
        try:
            value = entry.type.decode(raw)
        except struct.error as error:
            text = f"{name}: {len(raw)} bytes do not make a {entry.type.name}"
            raise TunerError(FailureKind.ABORT, text, Abort.LENGTH) from error
        return shortest(float(value)) if entry.type is Type.REAL32 else value

    def number(self, name: str, sub: int | None = None, node: int | None = None) -> float:
        """Returns the value of a numeric object. Raises TunerError."""
        return float(self.read(name, sub, node))

    def write(self, name: str, value: float, sub: int | None = None, node: int | None = None) -> None:
        """Writes a number; every object that the profile lets a tuner write fits one frame. Raises TunerError."""
        entry, node, sub = self._address(name, sub, node)
        raw = entry.type.encode(value if entry.type is Type.REAL32 else int(value))
        with self._turn(node, name):
            self._request(entry, node, sub, 0x23 | (4 - len(raw)) << 2, raw.ljust(4, b"\0"))

    def _address(self, name: str, sub: int | None, node: int | None) -> tuple[Object, int, int]:
        entry = lookup(name)
        if node is None:
            node = self._plant if entry.device is Device.PLANT else self._controller
        if node is None:
            raise TunerError(FailureKind.TIMEOUT, f"{name}: this loop's plant has no node")
        if sub is None:
            sub = self._channel if entry.shape is Shape.CHANNELS else 0
        return entry, node, sub

    @contextmanager
    def retrying(self, each_s: float, all_s: float) -> Iterator[None]:
        """Repeats an unanswered request more often than usual: on a bus that loses frames, a long sequence of requests
        otherwise fails at one of them.

        each_s: wall time for which one request is repeated, s.
        all_s: wall time after which requests are repeated only as often as usual, s.
        """
        self._retry_s, self._retry_until = each_s, self.station.monotonic() + all_s
        try:
            yield
        finally:
            self._retry_s = 0.0

    @contextmanager
    def _turn(self, node: int, name: str) -> Iterator[None]:
        """Holds the lock of the node and receives its answers; requests that keep the session alive go first. Outside
        of it the answers are not received: they belong to other loops, and each of fifty loops would wake for all of
        them."""
        waits_since = self.station.monotonic()

        def meanwhile() -> None:
            self._check_stop_request()
            if self.station.monotonic() - waits_since < TURN_S:
                self.heartbeat()

        with self.station.sdo_lock(self._url, node).take(name in _URGENT, meanwhile):
            self._bus.set_filters(self._heard | {sdo_response_id(node)})
            try:
                yield
            finally:
                self._bus.set_filters(self._heard)

    def _request(self, entry: Object, node: int, sub: int, command: int, payload: bytes) -> bytes:
        """Returns the answer's 8 bytes. An answer names its object, so a late answer to another request is skipped."""
        address = struct.pack("<HB", entry.index, sub)
        request = bytes([command]) + address + payload
        expected = 0x40 if command == 0x40 else 0x60
        self._take_in()
        self._answers.clear()
        attempt = 0
        until = min(self.station.monotonic() + self._retry_s, self._retry_until)
        while attempt < self._sdo_tries or self.station.monotonic() < until:
            if attempt:
                self.station.sdo_retries[self._url] += 1
            attempt += 1
            self._bus.send(sdo_request_id(node), request)
            patience = Patience(self.station.monotonic() + self._sdo_timeout_s, _BACKLOG_S)
            while (answer := self._answer(node, patience)) is not None:
                if answer[1:4] != address:
                    continue
                if answer[0] == _ABORT:
                    raise _aborted(entry, answer)
                if answer[0] & 0xE0 == expected:
                    return answer
        raise TunerError(FailureKind.TIMEOUT, f"node {node_name(node)} does not answer ({entry.name})", node=node)

    def _segments(self, entry: Object, node: int, begun: bytes) -> bytes:
        """Returns a value that is longer than one frame, such as a string.

        begun: the answer that began its upload.
        """
        give_up = self.station.monotonic() + _BACKLOG_S
        try:
            upload = SegmentedUpload(begun, entry.type.size)
            while not upload.over:
                self._bus.send(sdo_request_id(node), upload.request())
                self._take_segment(entry, node, upload, give_up)
        except SdoAbort as abort:
            self._bus.send(sdo_request_id(node), bytes((_ABORT,)) + begun[1:4] + struct.pack("<I", abort.code))
            why = ABORT_TEXT[abort.code]
            text = f"{entry.name}: the segments of node {node_name(node)} do not make a value ({why})"
            raise TunerError(FailureKind.ABORT, text, abort.code) from abort
        return upload.value

    def _take_segment(self, entry: Object, node: int, upload: SegmentedUpload, give_up: float) -> None:
        """Raises SdoAbort for a segment that does not fit."""
        patience = Patience(self.station.monotonic() + self._sdo_timeout_s, _BACKLOG_S)
        taken = False
        while not taken:
            answer = self._answer(node, patience) if self.station.monotonic() < give_up else None
            if answer is None:
                text = f"node {node_name(node)} stopped in the middle of {entry.name}"
                raise TunerError(FailureKind.TIMEOUT, text, node=node)
            if answer[0] == _ABORT:
                raise _aborted(entry, answer)
            taken = upload.take(answer)

    def _answer(self, node: int, patience: Patience) -> bytes | None:
        wanted = sdo_response_id(node)
        while True:
            while self._answers:
                can_id, data = self._answers.popleft()
                if can_id == wanted and len(data) == 8:
                    return data
            wait = patience.wait(self.heartbeat())
            if wait is None or (not self._receive(wait) and not wait):
                return None


def _aborted(entry: Object, answer: bytes) -> TunerError:
    code = int.from_bytes(answer[4:8], "little")
    text = ABORT_TEXT.get(Abort(code)) if code in list(Abort) else None
    return TunerError(FailureKind.ABORT, f"{entry.name}: {text or 'refused'} ({code:08X}h)", code)
