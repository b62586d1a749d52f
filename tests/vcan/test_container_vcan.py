"""The netlink messages of containers/vcan.py against the kernel."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from loopwright.containers.vcan import NoVcan, make, remove
from loopwright.service.cli.demo import vcan_usable

pytestmark = pytest.mark.vcan
NAME = "vcan7"


def test_an_interface_is_made_once_used_twice_and_removed() -> None:
    try:
        make(NAME)
        flags = int(Path(f"/sys/class/net/{NAME}/flags").read_text(), 16)
        kind = int(Path(f"/sys/class/net/{NAME}/type").read_text())
        assert flags & 1 and kind == 280  # up; ARPHRD_CAN
        make(NAME)
        assert vcan_usable(NAME)
    finally:
        remove(NAME)
    assert NAME not in [name for _, name in socket.if_nameindex()]


def test_a_name_that_no_interface_can_have() -> None:
    with pytest.raises(NoVcan, match="no a-name-of-more-than-15"):
        make("a-name-of-more-than-15")
