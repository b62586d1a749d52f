"""Creates a virtual CAN interface by three netlink messages, so that an image needs no `ip`."""

from __future__ import annotations

import errno
import os
import socket
import struct

# linux/rtnetlink.h, linux/netlink.h, linux/if_link.h, linux/if.h
_NEWLINK, _DELLINK, _ERROR = 16, 17, 2
_REQUEST, _ACKNOWLEDGE, _CREATE, _EXCLUSIVE = 0x001, 0x004, 0x400, 0x200
_IFNAME, _LINKINFO, _INFO_KIND = 3, 18, 1
_UP = 0x1
_HEADER = struct.Struct("=IHHII")
_LINK = struct.Struct("=BxHiII")


class NoVcan(Exception):
    """Raised when the interface cannot be created or used; the text says why."""


def make(name: str = "vcan0") -> None:
    """Creates a vcan interface in this network namespace and brings it up; an existing one is used. Raises NoVcan."""
    try:
        _ask(_NEWLINK, _REQUEST | _ACKNOWLEDGE | _CREATE | _EXCLUSIVE, 0, _named(name) + _kind("vcan"))
    except OSError as error:
        if error.errno != errno.EEXIST:
            raise NoVcan(_why(name, error)) from error
    try:
        _ask(_NEWLINK, _REQUEST | _ACKNOWLEDGE, _UP, _named(name))
        # A kernel may have the interface but no CAN sockets.
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as probe:
            probe.bind((name,))
    except OSError as error:
        raise NoVcan(f"{name} is there and cannot be used ({error.strerror})") from error


def remove(name: str) -> None:
    """Deletes an interface of this network namespace. Raises OSError."""
    _ask(_DELLINK, _REQUEST | _ACKNOWLEDGE, 0, _named(name))


def _why(name: str, error: OSError) -> str:
    if error.errno in (errno.EPERM, errno.EACCES):
        return f"no {name}: this container lacks the capability NET_ADMIN"
    if error.errno in (errno.EOPNOTSUPP, errno.EINVAL):
        return f"no {name}: the kernel has no vcan module loaded (on Linux: sudo modprobe vcan)"
    return f"no {name}: {error.strerror}"


def _ask(kind: int, flags: int, link_flags: int, attributes: bytes) -> None:
    """Sends one request about a link and reads the kernel's answer. Raises OSError."""
    body = _LINK.pack(socket.AF_UNSPEC, 0, 0, link_flags, link_flags) + attributes
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as link:
        link.bind((0, 0))
        link.send(_HEADER.pack(_HEADER.size + len(body), kind, flags, 1, 0) + body)
        answer = link.recv(4096)
    _, answered, *_ = _HEADER.unpack_from(answer)
    code = -struct.unpack_from("=i", answer, _HEADER.size)[0] if answered == _ERROR else errno.EPROTO
    if code:
        raise OSError(code, os.strerror(code))


def _named(name: str) -> bytes:
    return _attribute(_IFNAME, name.encode() + b"\0")


def _kind(kind: str) -> bytes:
    return _attribute(_LINKINFO, _attribute(_INFO_KIND, kind.encode()))


def _attribute(number: int, value: bytes) -> bytes:
    """Returns length and number, then the value padded to a multiple of four bytes."""
    return struct.pack("=HH", 4 + len(value), number) + value + bytes(-len(value) % 4)
