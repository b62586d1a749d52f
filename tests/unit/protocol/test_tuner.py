"""The tuner's client against the devices' own SDO server, joined by a bus that is a list."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Collection

import pytest

from loopwright.protocol.bus import Bus
from loopwright.protocol.object_dictionary import Dictionary
from loopwright.protocol.objects import Device
from loopwright.protocol.patience import WAIT_S
from loopwright.protocol.profile import (
    MV_FRAME,
    PV_FRAME,
    STATUS_FRAME,
    TUNER_NODE,
    UNASKED,
    Abort,
    Cause,
    NmtState,
    channel_ids,
    heartbeat_id,
    sdo_request_id,
    sdo_response_id,
)
from loopwright.protocol.sdo import SdoServer
from loopwright.protocol.station import HEARTBEAT_S, Station
from loopwright.protocol.tuner import FailureKind, Tuner, TunerError

NODE, PLANT = 0x20, 0x10
IDS = channel_ids(1)


class ListBus:
    """Answers SDO at once, after `before` has been put in front of the answer; mute: not at all."""

    def __init__(self) -> None:
        self.sent: list[tuple[int, bytes]] = []
        self.incoming: deque[tuple[int, bytes]] = deque()
        self.before: list[tuple[int, bytes]] = []
        self.mute = 0
        self.on_request: Callable[[], object] = lambda: None
        self.servers = {}
        for device, node in ((Device.CONTROLLER, NODE), (Device.PLANT, PLANT)):
            dictionary = Dictionary(device, 1)
            server = SdoServer(dictionary.read, dictionary.write, dictionary.room)
            self.servers[sdo_request_id(node)] = (sdo_response_id(node), server)

    def send(self, can_id: int, data: bytes) -> None:
        self.sent.append((can_id, data))
        if can_id not in self.servers:
            return
        self.on_request()
        if self.mute:
            self.mute -= 1
            return
        response_id, server = self.servers[can_id]
        answer = server.answer(data)
        assert answer is not None
        self.incoming.extend([*self.before, (response_id, answer)])

    def recv(self, timeout: float | None) -> tuple[int, bytes] | None:
        return self.incoming.popleft() if self.incoming else None

    def set_filters(self, ids: Collection[int]) -> None:
        self.ids = ids

    def fileno(self) -> int:
        return -1

    def close(self) -> None: ...


@pytest.fixture
def bus() -> ListBus:
    return ListBus()


def tuner_on(bus: Bus, channel: int = 1, station: Station | None = None) -> Tuner:
    station = station or Station(listen_s=0.0, open_bus=lambda url: bus)
    return Tuner("list", NODE, PLANT, channel, station=station, sdo_timeout_s=0.01, sdo_tries=2)


@pytest.fixture
def tuner(bus: ListBus) -> Tuner:
    return tuner_on(bus)


def sample(n: int, pv: float = 1.0, mv: float = 2.0) -> list[tuple[int, bytes]]:
    return [(IDS.pv, PV_FRAME.pack(pv, n)), (IDS.mv, MV_FRAME.pack(mv, n))]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("controller_mode_command", 1),
        ("controller_setpoint", 0.1),
        ("plant_samples_to_run", 0xFFFFFFFF),
        ("plant_pace", 0),
    ],
)
def test_what_is_written_is_read_back(tuner: Tuner, name: str, value: float) -> None:
    tuner.write(name, value)
    assert tuner.number(name) == pytest.approx(value, rel=1e-7)


def test_a_long_value_comes_in_segments(tuner: Tuner) -> None:
    assert tuner.read("device_name") == "Loopwright controller"
    assert tuner.read("device_name", node=PLANT) == "Loopwright plant"


@pytest.mark.parametrize(
    ("name", "value", "code"),
    [
        ("controller_mode_command", 9, Abort.TOO_HIGH),
        ("controller_setpoint", float("nan"), Abort.INVALID_VALUE),
        ("controller_mode", 1, Abort.READ_ONLY),
    ],
)
def test_a_refusal_says_what_and_why(tuner: Tuner, name: str, value: float, code: Abort) -> None:
    with pytest.raises(TunerError, match=name) as caught:
        tuner.write(name, value)
    assert (caught.value.kind, caught.value.code) == (FailureKind.ABORT, code)


def test_a_lost_answer_is_asked_for_again(tuner: Tuner, bus: ListBus) -> None:
    bus.mute = 1
    assert tuner.number("controller_mode_command") == 2


def test_a_silent_node_is_a_timeout(tuner: Tuner, bus: ListBus) -> None:
    bus.mute = 100
    with pytest.raises(TunerError, match=r"20h \(32\) does not answer") as caught:
        tuner.read("controller_mode")
    assert caught.value.kind is FailureKind.TIMEOUT


def test_while_retrying_a_request_is_repeated_for_longer(tuner: Tuner, bus: ListBus) -> None:
    """As at the end of a test on a bus that loses frames: two tries are the usual number of this tuner."""
    bus.mute = 6
    with tuner.retrying(60.0, 60.0):
        assert tuner.number("controller_mode_command") == 2
    bus.mute = 6
    with tuner.retrying(60.0, 0.0), pytest.raises(TunerError):
        tuner.number("controller_mode_command")
    assert bus.mute == 4
    with pytest.raises(TunerError):
        tuner.number("controller_mode_command")


def test_an_answer_to_another_request_is_passed_over(tuner: Tuner, bus: ListBus) -> None:
    stray = bytes([0x4F, 0x01, 0x21, 1, 3, 0, 0, 0])
    bus.before = [(sdo_response_id(NODE), stray), (sdo_response_id(PLANT), stray)]
    assert tuner.number("controller_mode_command") == 2


def test_samples_pair_pv_with_the_mv_that_answers_it(tuner: Tuner, bus: ListBus) -> None:
    bus.incoming.append((IDS.mv, MV_FRAME.pack(0.0, 4)))
    bus.incoming.extend(sample(5, 20.0, 30.0))
    found = tuner.sample(0.01)
    assert found is not None
    assert (found.n, found.pv, found.mv) == (5, 20.0, 30.0)


def test_samples_that_arrive_while_an_sdo_waits_are_kept(tuner: Tuner, bus: ListBus) -> None:
    bus.before = [*sample(1), *sample(2)]
    tuner.read("controller_mode_command")
    assert [tuner.sample(0.01), tuner.sample(0.01)][1].n == 2  # type: ignore[union-attr]


def test_status_counts_from_the_sample_in_which_it_changed(tuner: Tuner, bus: ListBus) -> None:
    status = (IDS.status, STATUS_FRAME.pack(3, 1, 7.5, 1, Cause.NONE))
    pv, mv = sample(2)
    bus.incoming.extend([*sample(1), pv, status, mv])
    first, second = tuner.sample(0.01), tuner.sample(0.01)
    assert first is not None
    assert second is not None
    assert (first.mode, first.on_trial) == (0, False)
    assert (second.mode, second.on_trial, second.sp) == (3, True, 7.5)
    assert tuner.session_is_open


def test_draining_forgets_the_past(tuner: Tuner, bus: ListBus) -> None:
    bus.incoming.extend(sample(1))
    tuner.drain()
    assert tuner.sample(0.0) is None


def test_a_restart_is_noted(tuner: Tuner, bus: ListBus) -> None:
    bus.incoming.append((heartbeat_id(NODE), b"\0"))
    tuner.drain()
    assert tuner.restarted


@pytest.mark.parametrize("can_id", [IDS.pv, IDS.mv, IDS.status, heartbeat_id(NODE), sdo_response_id(NODE)])
def test_a_frame_of_the_wrong_length_does_no_harm(tuner: Tuner, bus: ListBus, can_id: int) -> None:
    bus.incoming.append((can_id, b""))
    bus.incoming.extend(sample(3))
    assert tuner.number("controller_mode_command") == 2
    assert tuner.sample(0.01) is not None


def test_only_who_holds_the_loop_beats(tuner: Tuner, bus: ListBus) -> None:
    tuner.sample(0.0)
    assert not bus.sent
    tuner.beating = True
    tuner.sample(0.0)
    tuner.sample(0.0)
    assert [can_id for can_id, _ in bus.sent] == [heartbeat_id(TUNER_NODE)]


def test_the_loops_of_a_process_send_one_heartbeat(tuner: Tuner, bus: ListBus) -> None:
    """The watch of the controller is on the process; the lease is of the loop."""
    other = tuner_on(bus, 2, tuner.station)
    tuner.start_heartbeat()
    other.start_heartbeat()
    assert len(bus.sent) == 2, "a watch that was just armed begins with the first beat"
    began = time.monotonic()
    while time.monotonic() - began < 0.35:
        for each in (tuner, other):
            each.sample(0.0)
        time.sleep(0.001)
    assert 6 <= len(bus.sent) <= 2 + 0.35 / (HEARTBEAT_S - WAIT_S)
    tuner.beating = False
    bus.sent.clear()
    time.sleep(HEARTBEAT_S)
    tuner.sample(0.0)
    assert not bus.sent
    other.sample(0.0)
    assert len(bus.sent) == 1, "the other goes on"


def test_answers_are_heard_by_who_has_asked_only(tuner: Tuner, bus: ListBus) -> None:
    assert not {sdo_response_id(NODE), sdo_response_id(PLANT)} & set(bus.ids)
    heard: list[set[int]] = []
    bus.on_request = lambda: heard.append(set(bus.ids))
    tuner.number("controller_mode")
    assert sdo_response_id(NODE) in heard[0] and set(IDS) - {IDS.command} <= heard[0]
    bus.mute = 100
    with pytest.raises(TunerError):
        tuner.number("controller_mode")
    assert sdo_response_id(NODE) not in bus.ids and set(IDS) - {IDS.command} <= set(bus.ids)


def test_the_bus_is_asked_for_our_frames_only(tuner: Tuner, bus: ListBus) -> None:
    assert set(IDS) - {IDS.command} <= set(bus.ids)
    assert 0x080 not in bus.ids


class Flood(ListBus):
    """Brings samples faster than anybody can take them; an answer comes as soon as it is due."""

    def __init__(self) -> None:
        super().__init__()
        self.n = 0

    def recv(self, timeout: float | None) -> tuple[int, bytes] | None:
        if self.incoming:
            return self.incoming.popleft()
        time.sleep(0.001)
        self.n += 1
        return IDS.mv, MV_FRAME.pack(40.0, self.n)


def test_a_bus_that_brings_more_than_can_be_taken_silences_nobody() -> None:
    """The watch on our heartbeat is 1 s of wall time: it must go out, and the request too."""
    bus = Flood()
    tuner = tuner_on(bus)
    tuner.beating = True
    began = time.monotonic()
    tuner.drain()
    assert tuner.number("controller_mode") == 2
    assert time.monotonic() - began < 0.5
    assert (heartbeat_id(TUNER_NODE), b"\x05") in bus.sent


def test_a_node_that_sends_without_a_pause_keeps_nobody_from_a_time_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("loopwright.protocol.tuner._BACKLOG_S", 0.1)
    bus = Flood()
    tuner = tuner_on(bus)
    assert tuner.sample(0.01) is None
    bus.mute = 100
    with pytest.raises(TunerError, match="does not answer"):
        tuner.number("controller_mode")


class Foreign(Flood):
    """Answers what nobody has asked for, without end."""

    def recv(self, timeout: float | None) -> tuple[int, bytes] | None:
        super().recv(timeout)
        return sdo_response_id(NODE), bytes([0x4F, 0x00, 0x10, 0, 3, 0, 0, 0])


def test_answers_that_nobody_has_asked_for_keep_nobody_from_a_time_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("loopwright.protocol.tuner._BACKLOG_S", 0.1)
    bus = Foreign()
    bus.mute = 100
    with pytest.raises(TunerError, match="does not answer"):
        tuner_on(bus).number("controller_mode")


def test_who_has_stood_still_still_gets_the_sample_that_came_meanwhile(
    bus: ListBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    tuner = tuner_on(bus, station=Station(listen_s=0.0, monotonic=lambda: now[0], open_bus=lambda url: bus))

    def stand_still(timeout: float | None) -> tuple[int, bytes] | None:
        monkeypatch.undo()
        now[0] += 60.0
        return None

    monkeypatch.setattr(bus, "recv", stand_still)
    bus.incoming.extend(sample(9))
    found = tuner.sample(1.0)
    assert found is not None and found.n == 9


def test_who_takes_samples_that_wait_beats_meanwhile(bus: ListBus, tuner: Tuner) -> None:
    for n in (1, 2):
        bus.incoming += [(IDS.pv, PV_FRAME.pack(50.0, n)), (IDS.mv, MV_FRAME.pack(40.0, n))]
    tuner.number("controller_mode")  # takes both in
    tuner.beating = True
    bus.sent.clear()
    assert tuner.sample(0.0) is not None
    assert bus.sent == [(heartbeat_id(TUNER_NODE), b"\x05")]


def test_an_mv_that_answers_no_sample_is_none(tuner: Tuner, bus: ListBus) -> None:
    bus.incoming.extend([(IDS.pv, PV_FRAME.pack(50.0, UNASKED)), (IDS.mv, MV_FRAME.pack(71.0, UNASKED)), *sample(7)])
    found = tuner.sample(0.01)
    assert found is not None and found.n == 7


def test_the_end_of_a_session_is_heard(tuner: Tuner, bus: ListBus) -> None:
    for is_open, cause in ((1, 0), (0, Cause.OUTSIDE_CHANGE), (0, 99)):
        bus.incoming.append((IDS.status, STATUS_FRAME.pack(2, 0, 50.0, is_open, cause)))
        tuner.drain()
        assert tuner.session_is_open == bool(is_open)


def test_the_states_of_both_nodes_are_noted(tuner: Tuner, bus: ListBus) -> None:
    bus.incoming += [
        (heartbeat_id(NODE), bytes((NmtState.PRE_OPERATIONAL,))), (heartbeat_id(PLANT), bytes((NmtState.OPERATIONAL,)))
    ]  # fmt: skip
    tuner.drain()
    assert tuner.node_states == {NODE: NmtState.PRE_OPERATIONAL, PLANT: NmtState.OPERATIONAL}
