"""What CiA 301 asks of every device beside its work: frame by frame, with a device and a client on a bus in memory."""

from __future__ import annotations

import struct

import pytest

from loopwright.plantsim.catalogue import find
from loopwright.plantsim.device import PlantChannel, PlantDevice
from loopwright.protocol.bus import BusError
from loopwright.protocol.device_runtime import Runtime
from loopwright.protocol.object_dictionary import Dictionary
from loopwright.protocol.objects import Device, lookup
from loopwright.protocol.profile import (
    FOREVER,
    MV_FRAME,
    NMT_FRAME,
    NMT_ID,
    REVISION,
    Abort,
    Emcy,
    NmtCommand,
    NmtState,
    channel_ids,
    emcy_id,
    heartbeat_id,
    sdo_request_id,
    sdo_response_id,
)
from tests.unit.protocol.memory_bus import Wire

NODE = 0x20
PDO, OTHER_PDO = 0x190, 0x290  # the same lower byte: two sources all the same


class Rig:
    """A device that writes down which PDOs it was given."""

    def __init__(self) -> None:
        self.wire = Wire()
        self.client = self.wire.open()
        self.given: list[tuple[int, bytes]] = []
        self.dictionary = Dictionary(Device.CONTROLLER, 1)
        self.runtime = Runtime(self.wire.open(), NODE, self.dictionary, self.wire.clock)
        self.runtime.handlers = {
            PDO: lambda data: self.given.append((PDO, data)),
            OTHER_PDO: lambda data: self.given.append((OTHER_PDO, data)),
        }
        self.runtime.lengths = {PDO: 4, OTHER_PDO: 4}

    def started(self) -> Rig:
        self.runtime.start()
        return self

    def say(self, can_id: int, data: bytes) -> None:
        self.client.send(can_id, data)
        while self.runtime.poll(0.0):
            pass

    def wait(self, seconds: float, alive: tuple[int, ...] = (), step: float = 0.02) -> None:
        for _ in range(round(seconds / step)):
            for node in alive:
                self.client.send(heartbeat_id(node), b"\x05")
            self.wire.clock.now += step
            while self.runtime.poll(1e-9):
                pass

    def nmt(self, command: NmtCommand) -> None:
        self.say(NMT_ID, NMT_FRAME.pack(command, NODE))

    def sdo(self, request: str) -> bytes:
        self.say(sdo_request_id(NODE), bytes.fromhex(request).ljust(8, b"\0"))
        return self.wire.sent(sdo_response_id(NODE))[-1]

    def read(self, index: int, sub: int) -> int | Abort:
        answer = self.sdo(f"40 {index & 0xFF:02x} {index >> 8:02x} {sub:02x}")
        value = int.from_bytes(answer[4:8], "little")
        return Abort(value) if answer[0] == 0x80 else value

    def write(self, index: int, sub: int, data: bytes) -> Abort | None:
        header = bytes((0x23 | 4 - len(data) << 2,)) + struct.pack("<HB", index, sub)
        answer = self.sdo((header + data).hex())
        return Abort(int.from_bytes(answer[4:8], "little")) if answer[0] == 0x80 else None

    def watch(self, sub: int, node: int, limit_ms: int) -> Abort | None:
        return self.write(0x1016, sub, struct.pack("<I", node << 16 | limit_ms))

    def emergencies(self) -> list[bytes]:
        return self.wire.sent(emcy_id(NODE))


@pytest.fixture
def rig() -> Rig:
    return Rig().started()


class TestHeartbeats:
    def test_nobody_is_watched_unless_it_is_asked_for(self, rig: Rig) -> None:
        assert (rig.read(0x1016, 1), rig.read(0x1016, 2)) == (0, 0)

    def test_a_node_is_watched_by_one_entry_only(self, rig: Rig) -> None:
        assert rig.watch(1, 0x7D, 500) is None
        assert rig.watch(2, 0x7D, 1000) is Abort.INCOMPATIBLE
        assert rig.read(0x1016, 2) == 0
        rig.wait(2.0, alive=(0x7D,))
        assert rig.emergencies() == []
        rig.wait(0.6)
        assert [data[:4] for data in rig.emergencies()] == [bytes.fromhex("30 81 11 7d")]

    def test_an_entry_may_be_written_again_and_freed(self, rig: Rig) -> None:
        assert rig.watch(1, 0x7D, 500) is None
        assert rig.watch(1, 0x7D, 800) is None
        assert rig.watch(2, 0, 0) is None
        assert rig.watch(2, 0x7D, 0) is None
        assert rig.watch(1, 0, 0) is None
        assert rig.watch(2, 0x7D, 500) is None

    def test_the_own_heartbeat_does_not_drift(self, rig: Rig) -> None:
        """It is looked at each 30 ms, and due each 100."""
        rig.write(0x1017, 0, struct.pack("<H", 100))
        rig.wire.frames.clear()
        rig.wait(30.0, step=0.03)
        assert len(rig.wire.sent(heartbeat_id(NODE))) == pytest.approx(300, abs=1)

    def test_heartbeats_that_could_not_be_sent_are_not_made_up_for(self, rig: Rig) -> None:
        rig.write(0x1017, 0, struct.pack("<H", 100))
        rig.wait(0.2)
        rig.wire.frames.clear()
        rig.wait(5.0, step=5.0)
        rig.wait(0.1, step=0.01)
        assert len(rig.wire.sent(heartbeat_id(NODE))) == 2


class TestErrors:
    def test_the_history_is_counted_and_cleared(self, rig: Rig) -> None:
        assert rig.read(0x1003, 0) == 0
        assert rig.read(0x1003, 1) is Abort.NO_DATA
        rig.runtime.raise_error(Emcy.NO_PV, b"\1")
        rig.runtime.raise_error(Emcy.PV_LIMIT, b"\1")
        assert rig.sdo("40 03 10 00")[0] == 0x4F, "a U8"
        assert [rig.read(0x1003, sub) for sub in range(4)] == [2, Emcy.PV_LIMIT, Emcy.NO_PV, Abort.NO_DATA]
        assert rig.read(0x1003, 5) is Abort.NO_SUBINDEX
        assert rig.write(0x1003, 0, b"\xff") is Abort.INVALID_VALUE
        assert rig.write(0x1003, 1, bytes(4)) is Abort.READ_ONLY
        assert rig.write(0x1003, 0, b"\0") is None
        assert (rig.read(0x1003, 0), rig.read(0x1003, 1)) == (0, Abort.NO_DATA)
        assert rig.read(0x1001, 0) == 0x91, "the errors are still there, only the record of them is not"

    def test_what_a_device_does_by_itself_can_be_read(self, rig: Rig) -> None:
        assert (rig.read(0x1029, 0), rig.read(0x1029, 1)) == (1, 1)
        assert rig.write(0x1029, 1, b"\0") is Abort.READ_ONLY
        assert rig.read(0x1F80, 0) == 0
        assert rig.write(0x1F80, 0, bytes(4)) is Abort.READ_ONLY
        assert rig.read(0x1018, 3) == REVISION


class TestPdos:
    def test_a_sent_pdo_says_that_it_is_not_asked_for(self, rig: Rig) -> None:
        ids = channel_ids(1)
        assert rig.read(0x1801, 1) == 0x40000000 | ids.mv
        assert rig.read(0x1802, 1) == 0x40000000 | ids.status
        assert rig.read(0x1400, 1) == ids.pv

    def test_what_arrives_by_pdo_is_not_written_by_sdo(self, rig: Rig) -> None:
        assert rig.write(0x2000, 0, bytes(4)) is Abort.DEVICE_STATE
        plant = Dictionary(Device.PLANT, 1)
        assert (lookup("sample_number").access, plant.read(0x2000, 0)) == ("rw", bytes(4))

    def test_a_longer_frame_is_cut(self, rig: Rig) -> None:
        rig.say(PDO, b"\1\2\3\4\5")
        assert rig.given == [(PDO, b"\1\2\3\4")]
        assert rig.emergencies() == []

    def test_a_shorter_frame_is_an_error_until_one_is_long_enough(self, rig: Rig) -> None:
        for _ in range(3):
            rig.say(PDO, b"\1\2\3")
        assert rig.given == []
        assert rig.emergencies() == [bytes.fromhex("10 82 11 90 01 03 04 00")]
        assert rig.read(0x1001, 0) == 0x11
        rig.say(OTHER_PDO, b"")
        assert rig.emergencies()[-1] == bytes.fromhex("10 82 11 90 02 00 04 00")
        rig.say(PDO, b"\1\2\3\4\5")
        assert rig.read(0x1001, 0) == 0x11, "the other one is still short"
        rig.say(OTHER_PDO, b"\1\2\3\4")
        assert rig.given == [(PDO, b"\1\2\3\4"), (OTHER_PDO, b"\1\2\3\4")]
        assert rig.read(0x1001, 0) == 0
        rig.say(PDO, b"\4\3\2\1")
        assert rig.given[-1] == (PDO, b"\4\3\2\1")

    def test_a_frame_too_short_before_a_pause_is_an_error_still(self, rig: Rig) -> None:
        rig.say(PDO, b"")
        rig.nmt(NmtCommand.PRE_OPERATIONAL)
        rig.say(PDO, bytes(4))
        assert rig.given == []
        rig.nmt(NmtCommand.START)
        rig.say(PDO, bytes(4))
        assert rig.given == [(PDO, bytes(4))]
        assert rig.read(0x1001, 0) == 0


class TestReset:
    @pytest.mark.parametrize("command", [NmtCommand.RESET_COMMUNICATION, NmtCommand.RESET_NODE])
    def test_communication_is_as_the_program_was_started(self, command: NmtCommand) -> None:
        rig = Rig()
        rig.dictionary.set("heartbeat_producer", 200)
        told = []
        rig.dictionary.on_write["sample_time"] = lambda sub, value: told.append((rig.runtime.state, value))
        rig.started()
        rig.watch(1, 0x7D, 300)
        rig.wait(0.1, alive=(0x7D,))
        rig.write(0x1017, 0, struct.pack("<H", 1000))
        rig.write(0x1006, 0, struct.pack("<I", 50_000))
        rig.runtime.raise_error(Emcy.NO_PV)
        told.clear()
        rig.nmt(command)
        assert told == [(NmtState.PRE_OPERATIONAL, 100_000)]
        assert rig.runtime.state is NmtState.OPERATIONAL
        assert (rig.read(0x1016, 1), rig.read(0x1017, 0), rig.read(0x1006, 0)) == (0, 200, 100_000)
        assert (rig.read(0x1001, 0), rig.read(0x1003, 0)) == (0, 0)
        before = len(rig.emergencies())
        rig.wait(1.0)
        assert len(rig.emergencies()) == before, "nobody is watched any more"

    def test_watches_of_the_start_survive_an_exchange(self) -> None:
        rig = Rig()
        rig.dictionary.set("heartbeat_consumer", 0x7D << 16 | 500, 1)
        rig.started()
        rig.watch(1, 0, 0)
        rig.watch(2, 0x7D, 500)
        rig.nmt(NmtCommand.RESET_COMMUNICATION)
        assert (rig.read(0x1016, 1), rig.read(0x1016, 2)) == (0x7D << 16 | 500, 0)

    def test_a_transfer_ends(self, rig: Rig) -> None:
        rig.sdo("40 08 10 00")
        rig.nmt(NmtCommand.RESET_COMMUNICATION)
        answer = rig.sdo("60")
        assert (answer[0], answer[4:]) == (0x80, struct.pack("<I", Abort.COMMAND))

    def test_the_application_is_reset_with_the_node_only(self, rig: Rig) -> None:
        resets: list[int] = []
        rig.runtime.on_reset = lambda: resets.append(int(rig.dictionary.get("heartbeat_producer")))
        rig.write(0x1017, 0, struct.pack("<H", 1000))
        rig.nmt(NmtCommand.RESET_COMMUNICATION)
        assert resets == []
        rig.nmt(NmtCommand.RESET_NODE)
        assert resets == [500], "the communication is as at power-on by then"


class TestPlant:
    IDS = channel_ids(1)

    @pytest.fixture
    def rig(self) -> Rig:
        rig = Rig()
        self.plant = PlantDevice(
            rig.wire.open(),
            [PlantChannel(find("fopdt").build, noise_std=0.5)],
            sample_time_s=0.2,
            pace=0.0,
            run=2,
            node=NODE,
            clock=rig.wire.clock,
        )
        self.ids = channel_ids(1, NODE)
        rig.runtime = self.plant.runtime
        self.plant.start()
        return rig

    def answer(self, rig: Rig, samples: int) -> None:
        for _ in range(samples):
            rig.wait(0.02)
            rig.say(self.ids.mv, MV_FRAME.pack(60.0, self.number))

    @property
    def number(self) -> int:
        return int.from_bytes(self.plant.dictionary.read(0x2000, 0), "little")

    def write(self, rig: Rig, name: str, value: float) -> None:
        entry = lookup(name)
        assert rig.write(entry.index, entry.count(1), entry.type.encode(value)) is None

    def test_reset_node_has_everything_as_at_power_on(self, rig: Rig) -> None:
        written = {
            "plant_pace": 5.0,
            "plant_answer_timeout": 1,
            "plant_on_missing_answer": 2,
            "plant_safe_output": 7.0,
            "plant_disturbance": 3.0,
            "plant_noise": 0.25,
            "plant_seed": 9,
            "plant_mv": 33.0,
            "plant_gain": 2.5,
        }
        fresh = [self.plant.dictionary.read(lookup(name).index, lookup(name).count(1)) for name in written]
        self.answer(rig, 2)
        for name, value in written.items():
            self.write(rig, name, value)
        self.write(rig, "plant_samples_to_run", 1)
        rig.wait(0.1)
        assert rig.read(0x2012, 0) == 1
        assert [plant.gain for plant in self.plant.plants] == [2.5]
        rig.nmt(NmtCommand.STOP)
        rig.nmt(NmtCommand.RESET_NODE)
        assert rig.read(0x2012, 0) == 0
        assert [plant.gain for plant in self.plant.plants] == [1.0]
        assert fresh == [self.plant.dictionary.read(lookup(name).index, lookup(name).count(1)) for name in written]

    def test_and_it_runs_as_it_did_then(self, rig: Rig) -> None:
        self.answer(rig, 2)
        first = rig.wire.sent(self.ids.pv)
        assert len(first) == 2
        self.write(rig, "plant_noise", 3.0)
        self.write(rig, "plant_samples_to_run", FOREVER)
        self.answer(rig, 3)
        rig.wire.frames.clear()
        rig.nmt(NmtCommand.RESET_NODE)
        self.answer(rig, 5)
        assert rig.wire.sent(self.ids.pv) == first

    def test_reset_communication_leaves_it_running(self, rig: Rig) -> None:
        self.write(rig, "plant_samples_to_run", 100)
        self.answer(rig, 3)
        before = self.number
        rig.nmt(NmtCommand.RESET_COMMUNICATION)
        self.answer(rig, 3)
        assert before < self.number <= before + 4
        assert rig.read(0x1006, 0) == 200_000

    def test_reset_communication_takes_the_sample_time_back(self, rig: Rig) -> None:
        rig.nmt(NmtCommand.PRE_OPERATIONAL)
        assert rig.write(0x1006, 0, struct.pack("<I", 50_000)) is None
        rig.nmt(NmtCommand.RESET_COMMUNICATION)
        assert self.plant.sample_time_s == 0.2


def test_trouble_with_the_bus_is_said_once(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    troubles = ["bus-off", "bus-off", "it is down", "it is down", "it is down"]

    def poll() -> bool:
        if len(troubles) == 1:
            rig.runtime.stop()
        raise BusError(troubles.pop(0))

    monkeypatch.setattr("loopwright.protocol.device_runtime._PAUSE_AFTER_BUS_ERROR_S", 0.0)
    monkeypatch.setattr(rig.runtime, "poll", poll)
    rig.runtime.run()
    assert capsys.readouterr().err.splitlines() == ["node 20h (32): bus-off", "node 20h (32): it is down"]
