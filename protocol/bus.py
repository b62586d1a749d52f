"""Opens CAN buses: SocketCAN by a raw socket (two system calls per frame and hop), all others through python-can."""

from __future__ import annotations

import errno
import logging
import select
import socket
import struct
import time
from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import can
from can.interfaces.socketcand import SocketCanDaemonBus

from loopwright.protocol.bus_state import (
    ERROR_FRAME,
    STATE_FRAMES,
    BusState,
    adapter_bus_off_advice,
    bus_off_advice,
    state_after,
)

Frame = tuple[int, bytes]

_CAN_FRAME = struct.Struct("=IB3x8s")
_ID_MASK = 0x1FFFFFFF
_NOT_DATA = 0x60000000  # remote or error frame
_RECEIVE_BUFFER = 4 << 20  # bytes; the default holds about 275 frames, and further ones are lost without an error
_SHORTEST_ARMED_S = 0.02  # SO_RCVTIMEO counts in kernel ticks (up to 10 ms): shorter waits use poll
_SEND_PATIENCE_S = 1.0
SO_RCVBUFFORCE = 33
_CAN_RAW_ERR_FILTER = 2  # linux/can/raw.h
_ARPHRD_CAN = "280"  # linux/if_arp.h
_AWAY = (errno.ENODEV, errno.ENXIO)
_PASSED_OVER_S = 0.05  # how long filtered-out frames may prolong a wait beyond its time-out


class BusError(Exception):
    """Raised when the bus does not exist, is down or is bus-off. The text says what to do."""


class Bus(Protocol):
    """One open connection to a bus, for one thread. It carries standard identifiers and does not return its own
    frames."""

    @property
    def state(self) -> BusState:
        """Returns the state that the CAN controller has reported since the opening. While it is bus-off, `send` raises
        BusError, and so does `recv` once no received frame is left."""
        ...

    def send(self, can_id: int, data: bytes) -> None: ...

    def recv(self, timeout: float | None) -> Frame | None:
        """Returns the next frame, or None after `timeout` seconds of wall time (None waits for ever, 0 does not
        wait)."""
        ...

    def set_filters(self, ids: Collection[int]) -> None:
        """Restricts reception to frames with these identifiers; an empty collection excludes all frames."""
        ...

    def fileno(self) -> int: ...

    def close(self) -> None: ...


def open_bus(url: str) -> Bus:
    """Opens `socketcan:vcan0`, `socketcand:HOST:PORT`, `virtual:NAME` or any `INTERFACE:CHANNEL` of python-can.

    Raises BusError.
    """
    interface, separator, rest = url.partition(":")
    if not (interface and separator and rest):
        raise BusError(f"{url!r} is not a bus; examples: socketcan:can0, socketcand:127.0.0.1:29536, virtual:demo")
    if interface == "socketcan":
        return RawBus(rest)
    return LibraryBus(url, interface, rest)


class RawBus:
    """A bus on Linux SocketCAN, without a library in between. An interface that was down is found again by its socket,
    one that was away, such as an adapter that was unplugged, by a new socket."""

    def __init__(self, interface: str) -> None:
        self._interface = interface
        self._wanted: Collection[int] | None = None
        self._use(_opened(interface))

    def _use(self, sock: socket.socket) -> None:
        self._socket = sock
        self.state = BusState.ACTIVE
        self._armed: float | None = None
        self._poll = select.poll()
        self._poll.register(sock, select.POLLIN)
        # The bound methods are stored: otherwise they would be looked up twice per frame.
        self._recv: Callable[..., bytes] = sock.recv
        self._send: Callable[[bytes], int] = sock.send
        if self._wanted is not None:
            self.set_filters(self._wanted)

    def send(self, can_id: int, data: bytes) -> None:
        frame = _CAN_FRAME.pack(can_id, len(data), data)
        try:
            self._send(frame)
        except OSError as error:
            self._send_patiently(frame, error)

    def _send_patiently(self, frame: bytes, error: OSError) -> None:
        """Repeats a send while the transmit queue is full (ENOBUFS); poll does not wait for that queue, so it is
        retried."""
        give_up = time.monotonic() + _SEND_PATIENCE_S
        while error.errno in (errno.ENOBUFS, errno.EAGAIN) and time.monotonic() < give_up:
            time.sleep(0.001)
            try:
                self._send(frame)
                return
            except OSError as again:
                error = again
        self._note(error)
        raise BusError(f"cannot send on {self._interface!r}: {error.strerror}") from error

    def recv(self, timeout: float | None) -> Frame | None:
        try:
            if timeout == self._armed:
                raw = self._recv(16)
            elif timeout is None or timeout >= _SHORTEST_ARMED_S:
                self._arm(timeout)
                raw = self._recv(16)
            else:
                if timeout > 0.0 and not self._poll.poll(timeout * 1000.0):
                    return self._nothing()
                raw = self._recv(16, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return self._nothing()
        except OSError as error:
            self._note(error)
            raise BusError(f"cannot receive on {self._interface!r}: {error.strerror}") from error
        can_id, length, data = _CAN_FRAME.unpack(raw)
        if can_id & _NOT_DATA:
            if can_id & ERROR_FRAME:
                self._become(state_after(self.state, can_id, data[:length]))
            return self._nothing()
        return can_id & _ID_MASK, data[:length] if length < 8 else data

    def _nothing(self) -> Frame | None:
        if self.state is BusState.BUS_OFF:
            raise BusError(bus_off_advice(self._interface))
        return None

    def _note(self, error: OSError) -> None:
        """Notes an interface that is down or away. The socket of one that is away never finds it again: it receives
        nothing, without an error."""
        if error.errno == errno.ENETDOWN:
            self._become(BusState.ACTIVE)  # its state when it comes up again, which no frame reports
        elif error.errno in _AWAY:
            self.state = BusState.ACTIVE
            self._recv, self._send = self._recv_again, self._send_again

    def _recv_again(self, *arguments: int) -> bytes:
        self._open_again()
        raise BlockingIOError  # the new socket has no time-out yet

    def _send_again(self, frame: bytes) -> int:
        self._open_again()
        return self._send(frame)

    def _open_again(self) -> None:
        """Takes a new socket. Raises BusError while the interface is away."""
        sock = _opened(self._interface)
        self._socket.close()
        self._use(sock)

    def _become(self, state: BusState) -> None:
        """Notes the state. The kernel accepts frames for an interface that is bus-off and drops them silently, so
        `_send` is replaced by a method that raises: a working bus then pays for no check."""
        self.state = state
        self._send = self._refuse if state is BusState.BUS_OFF else self._socket.send

    def _refuse(self, frame: bytes) -> int:
        raise BusError(bus_off_advice(self._interface))

    def _arm(self, timeout: float | None) -> None:
        """Sets the time-out in the kernel, so that a receive with the same time-out as before takes one system call."""
        seconds = 0.0 if timeout is None else timeout
        whole = int(seconds)
        value = struct.pack("@ll", whole, int((seconds - whole) * 1e6))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, value)
        self._armed = timeout

    def set_filters(self, ids: Collection[int]) -> None:
        self._wanted = frozenset(ids)
        mask = socket.CAN_SFF_MASK | socket.CAN_EFF_FLAG | socket.CAN_RTR_FLAG
        filters = b"".join(struct.pack("=II", can_id, mask) for can_id in sorted(ids))
        self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, filters)

    def fileno(self) -> int:
        return self._socket.fileno()

    def close(self) -> None:
        self._socket.close()


def can_interfaces(devices: Path = Path("/sys/class/net")) -> list[str]:
    """Returns the names of the CAN interfaces of this machine.

    devices: the folder in which Linux describes each network interface.
    """
    types = {file.parent.name: file.read_text().strip() for file in devices.glob("*/type")}
    return sorted(name for name, kind in types.items() if kind == _ARPHRD_CAN)


def _opened(interface: str) -> socket.socket:
    """Returns a raw socket that receives all data frames, and the error frames that report the controller's state."""
    if not hasattr(socket, "AF_CAN"):
        raise BusError("this system has no SocketCAN; use the loopback hub (socketcand:HOST:PORT)")
    try:
        sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    except OSError as error:
        raise BusError(f"this kernel has no SocketCAN ({error.strerror})") from error
    try:
        _enlarge(sock)
        sock.setsockopt(socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, STATE_FRAMES)
        sock.bind((interface,))
    except OSError as error:
        sock.close()
        if error.errno == errno.ENODEV:
            there = can_interfaces()
            here = f"there are: {', '.join(there)}" if there else "there is none"
            raise BusError(f"this machine has no CAN interface {interface!r}; {here}") from error
        raise BusError(f"CAN interface {interface!r} cannot be opened: {error.strerror}") from error
    return sock


def _enlarge(sock: socket.socket) -> None:
    """Enlarges the receive buffer, beyond the system's limit where that is permitted (CAP_NET_ADMIN), else up to it."""
    try:
        sock.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, _RECEIVE_BUFFER)
    except OSError:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)


_GREETED_S = 5.0
"""Wall time within which a socketcand server has to answer, s."""


class _Socketcand(SocketCanDaemonBus):
    """Reads the server's greetings one by one. The library expects "< ok >" alone in one read; on a busy machine the
    first frames follow it in the same read, and the library would report a closed bus."""

    def _expect_msg(self, msg: str) -> None:
        server: socket.socket = vars(self)["_SocketCanDaemonBus__socket"]
        received, usual = b"", server.gettimeout()
        server.settimeout(_GREETED_S)  # the kernel accepts connections for a stopped server
        try:
            while len(received) < len(msg) and (part := server.recv(len(msg) - len(received))):
                received += part
        except OSError:
            server.close()
            raise
        server.settimeout(usual)
        if received != msg.encode():
            server.close()
            raise can.CanError(f"expected {msg!r}, got {received!r}")

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        """Notices a server that is gone: the library would report a silent bus, without waiting for the time-out. The
        library's own errors have a traceback in their text, which is left out."""
        received: tuple[can.Message | None, bool]
        try:
            received = super()._recv_internal(timeout)  # type: ignore[no-untyped-call]
        except can.CanError as error:
            lost = isinstance(error.__cause__, OSError)
            what = "the connection is lost" if lost else "the server has sent what is no frame"
            raise can.CanError(f"{what}: {error.__cause__}") from error
        if received[0] is None and self._is_over():
            raise can.CanError("the server has closed the connection")
        return received

    def _is_over(self) -> bool:
        server: socket.socket = vars(self)["_SocketCanDaemonBus__socket"]
        try:
            return server.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT) == b""
        except BlockingIOError:
            return False
        except OSError as error:
            raise can.CanError(f"the connection is lost: {error}") from error


# The library's client warns about every frame that TCP splits, although TCP may split any, and logs a traceback of each
# error that it raises.
logging.getLogger(SocketCanDaemonBus.__module__).setLevel(logging.CRITICAL)

_LIBRARY_STATES = {can.BusState.PASSIVE: BusState.PASSIVE, can.BusState.ERROR: BusState.BUS_OFF}

OPENED_BY: dict[str, Callable[..., can.BusABC]] = {"socketcand": _Socketcand}


class LibraryBus:
    """A bus on any interface of python-can; its message objects make it about four times slower than the raw socket."""

    def __init__(self, url: str, interface: str, rest: str) -> None:
        try:
            arguments = _library_arguments(interface, rest)
            self._bus: can.BusABC = OPENED_BY.get(interface, partial(can.Bus, interface=interface))(**arguments)
        except (OSError, ValueError, can.CanError) as error:
            raise BusError(f"bus {url!r} cannot be opened: {error}") from error
        self._url = url
        self._wanted: frozenset[int] | None = None

    def send(self, can_id: int, data: bytes) -> None:
        try:
            self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        except (OSError, can.CanError) as error:
            self._raise_if_off()
            raise BusError(f"cannot send on {self._url!r}: {error}") from error

    def recv(self, timeout: float | None) -> Frame | None:
        give_up = None if timeout is None else time.monotonic() + timeout
        left = timeout
        while True:
            try:
                message = self._bus.recv(left)
            except (OSError, can.CanError) as error:
                raise BusError(f"cannot receive on {self._url!r}: {error}") from error
            if message is None or message.is_error_frame:
                self._raise_if_off()
            if message is None and timeout is not None:
                return None
            if message is not None and self._wants(message):
                return message.arbitration_id, bytes(message.data)
            if give_up is not None:
                # A wanted frame may already wait behind one that is filtered out.
                over = time.monotonic() - give_up
                if over > _PASSED_OVER_S:
                    return None
                left = max(0.0, -over)

    @property
    def state(self) -> BusState:
        """Returns the state as far as python-can reports it for the adapter; WARNING is never reported."""
        return _LIBRARY_STATES.get(self._bus.state, BusState.ACTIVE)

    def _raise_if_off(self) -> None:
        if self.state is BusState.BUS_OFF:
            raise BusError(adapter_bus_off_advice(self._url))

    def _wants(self, message: can.Message) -> bool:
        if message.is_error_frame or message.is_remote_frame or message.is_extended_id:
            return False
        return self._wanted is None or message.arbitration_id in self._wanted

    def set_filters(self, ids: Collection[int]) -> None:
        self._wanted = frozenset(ids)
        if isinstance(self._bus, _Socketcand):
            # python-can filters socketcand in software, and treats a filtered-out frame as an expired time-out.
            return
        # An empty list means "everything" to python-can: an identifier that cannot occur stands for "nothing".
        wanted = sorted(ids) or [0x20000000]
        self._bus.set_filters([{"can_id": can_id, "can_mask": 0x3FFFFFFF, "extended": False} for can_id in wanted])

    def fileno(self) -> int:
        """Returns the file descriptor, or -1 when the interface has none."""
        try:
            return int(self._bus.fileno())
        except NotImplementedError:
            return -1

    def close(self) -> None:
        self._bus.shutdown()


def _library_arguments(interface: str, rest: str) -> dict[str, Any]:
    if interface != "socketcand":
        return {"channel": rest}
    address, _, channel = rest.partition("/")
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit():
        raise ValueError("socketcand needs HOST:PORT or HOST:PORT/CHANNEL")
    # The library retries for 10 s when no server listens; one connection attempt beforehand fails at once.
    socket.create_connection((host, int(port)), timeout=5.0).close()
    # Without tcp_tune, Nagle's algorithm holds back every second small frame until the first is acknowledged.
    return {"channel": channel or "vcan0", "host": host, "port": int(port), "tcp_tune": True}
