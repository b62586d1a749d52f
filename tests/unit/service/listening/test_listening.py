"""The history as the service puts it together, from the database and from the process that listens."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from loopwright.service.inputs.config import LoopConfig, parse_site
from loopwright.service.listening.bins import GAP_BEFORE, Rows, packed, unpacked
from loopwright.service.listening.heard_loop import InEffect
from loopwright.service.listening.listening import HOLE_S, NOT_BEGUN, Listening
from loopwright.service.listening.messages import HistoryAnswer
from loopwright.service.listening.process import ListeningProcess
from loopwright.service.listening.rings import Rings
from loopwright.service.store import history
from loopwright.service.store.clock_watch import uptime_s
from loopwright.service.store.history import HistoryBlock
from loopwright.service.store.store import Store
from loopwright.tuning.gains import Gains
from tests.unit.service.fakes import TAG, loop_entry
from tests.unit.service.processes import until

T0 = 1_769_860_800.0
ONE = (1.5, 20.0, 0.0, 0.0, 1.0, 0.0)


def config(**changes: Any) -> LoopConfig:
    return LoopConfig.model_validate(loop_entry() | changes)


def minute(n: int, first: bool = False) -> Rows:
    """A minute of ten samples a second, in bins of 4 s."""
    rings = Rings()
    for k in range(600):
        at = 600 * n + k
        rings.put(T0 + 0.1 * at, at + 1, float(n), 40.0, 50.0, rings.number_of(ONE), 2, GAP_BEFORE if at < 1 else 0)
    rows = rings.unsaved(all_of_it=True)
    assert rows is not None
    if first:
        rows.bins["gap"][0] = GAP_BEFORE
    return rows


def block(n: int, first: bool = False) -> HistoryBlock:
    rows = minute(n, first)
    after_s = None if first or not n else minute(n - 1).bins["until_s"][-1].item()
    first_s, last_s = rows.bins["at_s"][0].item(), rows.bins["until_s"][-1].item()
    return HistoryBlock(TAG, after_s, first_s, last_s, len(rows.bins), packed(rows))


@pytest.fixture
def listening(store: Store) -> Listening:
    return Listening({TAG: config()}, store, on=False)


def heard(listening: Listening, monkeypatch: pytest.MonkeyPatch, rows: Rows, silent_from_s: float = math.inf) -> None:
    """As if the process had these rows."""
    oldest_s = rows.bins["at_s"][0].item() if len(rows.bins) else math.inf
    answer = HistoryAnswer(1, rows, oldest_s, silent_from_s)
    monkeypatch.setattr(listening, "_memory", lambda *_: (answer, None))


@pytest.mark.parametrize("points", [10, 5000])
def test_what_is_stored_and_what_is_in_memory_are_one(
    listening: Listening, store: Store, monkeypatch: pytest.MonkeyPatch, points: int
) -> None:
    history.write(store, [block(n, first=n == 0) for n in range(5)])
    heard(listening, monkeypatch, minute(4))  # the last minute is in both
    found = listening.history(TAG, T0, T0 + 299.9, points).rows
    assert len(found.bins) <= points and found.bins["count"].sum() == 3000
    assert found.sets == (ONE,) and not found.gaps
    assert found.bins["pv_mean"][-1] == 4.0 and found.bins["pv_min"][0] == 0.0


def test_a_restart_is_a_gap_and_so_is_what_the_database_did_not_take(
    listening: Listening, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    history.write(store, [block(0, first=True), block(1), block(4), block(6, first=True)])
    heard(listening, monkeypatch, Rows(minute(9, first=True).bins, (ONE,), ((-math.inf, T0 + 540.0),)))
    found = listening.history(TAG, T0 - 1000.0, T0 + 600.0, 5000).rows
    assert found.gaps == tuple(
        (pytest.approx(T0 + begin), pytest.approx(T0 + end))
        for begin, end in ((-1000.0, 0.0), (119.9, 240.0), (299.9, 360.0), (419.9, 540.0))
    )


def test_a_gap_between_blocks_that_are_read_apart_is_one(
    listening: Listening, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(history, "_AT_ONCE", 1)
    history.write(store, [block(0, first=True), block(2, first=True), block(6, first=True)])
    gaps = listening.history(TAG, T0, T0 + 419.0, 5000).rows.gaps
    assert gaps == ((pytest.approx(T0 + 59.9), T0 + 120.0), (pytest.approx(T0 + 179.9), T0 + 360.0))


def test_a_damaged_block_is_a_gap(listening: Listening, store: Store, caplog: pytest.LogCaptureFixture) -> None:
    history.write(store, [block(0), replace(block(1), data=b"?"), block(2)])
    found = listening.history(TAG, T0, T0 + 179.0, 5000).rows
    assert found.gaps == ((pytest.approx(T0 + 59.9), pytest.approx(T0 + 120.0)),)
    assert "damaged" in caplog.text


@pytest.mark.parametrize("back_s", [0.5, 31.0, 170.0])
@pytest.mark.parametrize("points", [3, 20, 5000])
def test_a_time_that_was_heard_twice_since_the_clock_was_put_back_is_there_once(
    listening: Listening, store: Store, back_s: float, points: int
) -> None:
    history.write(store, [block(n, first=n == 0) for n in range(5)])
    history.write(store, [put_back(block(n, first=n == 5), back_s) for n in range(5, 9)])
    found = listening.history(TAG, T0, T0 + 600.0, points).rows
    assert len(found.bins) <= points
    assert (found.bins["at_s"][1:] > found.bins["until_s"][:-1]).all()
    assert all(begin < end for begin, end in found.gaps)
    apart = found.bins["n"][1:] != found.bins["n"][:-1] + found.bins["count"][:-1]
    assert points < 5000 or (found.bins["gap"][1:][apart] & GAP_BEFORE).all(), "no line is drawn from one to the other"


def put_back(one: HistoryBlock, back_s: float) -> HistoryBlock:
    """A block as heard by a clock that was put back."""
    rows = unpacked(one.data, one.count)
    for name in ("at_s", "until_s"):
        rows.bins[name] -= back_s
    first_s, last_s = one.first_s - back_s, one.last_s - back_s
    return replace(one, after_s=one.after_s and one.after_s - back_s, first_s=first_s, last_s=last_s, data=packed(rows))


def test_a_loop_that_falls_silent_has_a_gap_at_the_end(listening: Listening, monkeypatch: pytest.MonkeyPatch) -> None:
    heard(listening, monkeypatch, minute(0), silent_from_s=T0 + 59.9)
    assert listening.history(TAG, T0, T0 + 100.0, 5000).rows.gaps == ((T0 + 59.9, T0 + 100.0),)


def test_where_nothing_is_known_all_of_it_is_a_gap(listening: Listening, store: Store) -> None:
    assert listening.history(TAG, T0, T0 + 100.0, 50).rows.gaps == ((T0, T0 + 100.0),)
    history.write(store, [block(0)])
    end_s = T0 + 60.0 + 2.0 * HOLE_S
    assert listening.history(TAG, T0, end_s, 50).rows.gaps == ((pytest.approx(T0 + 59.9), end_s),)


@pytest.mark.parametrize(
    ("bus", "on", "listen", "why"),
    [
        ("socketcan:can0", False, True, "turned off"),
        ("socketcan:can0", True, False, "turned off"),
        ("slcan:/dev/ttyACM0", True, True, "kind slcan cannot be opened by a second process"),
        ("virtual:demo", True, True, "kind virtual cannot"),
        ("socketcan:can0", True, True, "has not begun"),
    ],
)
def test_a_bus_that_is_not_listened_to_says_why(store: Store, bus: str, on: bool, listen: bool, why: str) -> None:
    site = parse_site({"loops": [loop_entry() | {"bus": bus}], "buses": {bus: {"listen": listen}}}, "test")
    listening = Listening(site.loops, store, None, site.buses, on)
    found = listening.history(TAG, T0, T0 + 10.0, 10)
    assert found.no_data is not None and why in found.no_data
    assert (bus in listening.off) == (why != "has not begun")
    assert "another gateway" in (listening.history("ELSEWHERE", T0, T0 + 10.0, 10).no_data or "")


def test_a_bus_is_not_called_heard_before_the_first_report(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("start", "close"):
        monkeypatch.setattr(ListeningProcess, name, lambda process: None)
    site = parse_site({"loops": [loop_entry() | {"bus": "socketcan:can0"}]}, "test")
    listening = Listening(site.loops, store, lambda tag: None)
    listening.start()
    assert not listening.off and not listening.begun
    assert listening.why_not_heard(next(iter(site.loops))) == NOT_BEGUN and [*listening.buses().values()] == [NOT_BEGUN]
    listening.close()


def test_a_reading_of_gains_has_the_time_that_nobody_sets(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("start", "close"):
        monkeypatch.setattr(ListeningProcess, name, lambda process: None)
    site = parse_site({"loops": [loop_entry() | {"bus": "socketcan:can0"}]}, "test")
    clock_ahead_s = 4e9
    listening = Listening(site.loops, store, lambda tag: InEffect(clock_ahead_s, 50.0, 2, False, ONE, 0.1))
    monkeypatch.setattr(listening, "_to_read", (TAG,))
    before_s = uptime_s()
    listening.start()
    until(lambda: listening.gains_of(TAG) is not None)
    listening.close()
    assert listening.gains_read_since(TAG, before_s) == Gains(*ONE)
    assert listening.gains_read_since(TAG, uptime_s()) is None
