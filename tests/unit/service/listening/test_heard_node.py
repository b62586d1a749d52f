"""Heartbeats of a node: when it counts as lost, and its state."""

from __future__ import annotations

import struct

import pytest

from loopwright.protocol.profile import NmtState
from loopwright.service.listening.heard_node import HeardNode

T0 = 1_769_860_800.0
OPERATIONAL = bytes([5])


def beating(period_s: float, count: int) -> tuple[HeardNode, float]:
    node = HeardNode()
    for n in range(count):
        node.take(OPERATIONAL, T0 + n * period_s)
    return node, T0 + (count - 1) * period_s


def silent(node: HeardNode, now_s: float) -> bool:
    found = node.latest(now_s)
    assert found is not None
    return found.silent


def test_a_node_that_was_never_heard_is_not_known() -> None:
    node = HeardNode()
    assert node.latest(T0) is None
    node.take(OPERATIONAL, T0)
    assert not silent(node, T0 + 60.0), "after one heartbeat nobody knows when the next one is due"
    node.began_anew()
    assert node.latest(T0) is None


@pytest.mark.parametrize(("period_s", "lost_after_s"), [(0.1, 2.0), (0.5, 2.0), (1.0, 3.0), (5.0, 15.0)])
def test_a_node_is_lost_after_two_seconds_and_three_periods(period_s: float, lost_after_s: float) -> None:
    node, last_s = beating(period_s, 10)
    assert not silent(node, last_s + lost_after_s - 0.01)
    assert silent(node, last_s + lost_after_s + 0.01)
    found = node.latest(last_s + 100.0)
    assert found is not None and found.at_s == last_s


def test_a_frame_that_came_twice_and_a_boot_up_are_no_period() -> None:
    node = HeardNode()
    for at_s in (T0, T0 + 0.001, T0 + 5.0, T0 + 5.001, T0 + 10.0):
        node.take(OPERATIONAL, at_s)
    assert not silent(node, T0 + 20.0)
    node.take(bytes([0]), T0 + 20.0)
    node.take(OPERATIONAL, T0 + 20.1)
    assert not silent(node, T0 + 30.0)


def test_an_absence_is_no_period_for_long() -> None:
    node, last_s = beating(0.5, 10)
    back_s = last_s + 60.0
    for n in range(10):
        node.take(OPERATIONAL, back_s + 0.5 * n)
    assert silent(node, back_s + 4.5 + 2.1)


@pytest.mark.parametrize(
    ("data", "state"),
    [
        (b"\x05", NmtState.OPERATIONAL),
        (b"\x7f", NmtState.PRE_OPERATIONAL),
        (b"\x85", NmtState.OPERATIONAL),
        (b"\x09", None),
    ],
)
def test_the_state_that_a_heartbeat_carries(data: bytes, state: NmtState | None) -> None:
    node = HeardNode()
    node.take(data, T0)
    found = node.latest(T0)
    assert found is not None and found.state is state


def test_a_foreign_frame_is_refused() -> None:
    with pytest.raises(struct.error):
        HeardNode().take(b"", T0)
