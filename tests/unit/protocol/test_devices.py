"""Plant and controller devices joined by a bus in memory: samples, sessions, states, emergencies, missing answers."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from controller.channel import Settings
from controller.device import ControllerChannel, ControllerDevice
from controller.pid import Parameters
from plantsim.catalogue import find
from plantsim.device import PlantChannel, PlantDevice
from protocol.objects import lookup
from protocol.profile import (
    EMCY_FRAME,
    FOREVER,
    HEARTBEAT_FRAME,
    MV_FRAME,
    NMT_FRAME,
    NMT_ID,
    PV_FRAME,
    STATUS_FRAME,
    SYNC_ID,
    TUNER_NODE,
    Abort,
    Cause,
    Emcy,
    ExperimentState,
    Mode,
    NmtCommand,
    NmtState,
    OnMissingAnswer,
    ParameterCommand,
    channel_ids,
    emcy_id,
    heartbeat_id,
    sdo_request_id,
    sdo_response_id,
)
from tests.unit.protocol.memory_bus import Wire

PLANT, CONTROLLER = 0x10, 0x20
IDS = channel_ids(1)
KP, TI = 200.0, 12.0  # percent per PV unit: "fopdt" has 100 % per unit, ultimate gain 850


class Rig:
    """Both devices and a client, pumped in turns; the plant starts held."""

    def __init__(self, channels: int = 1, pace: float = 0.0) -> None:
        self.wire = Wire()
        self.client = self.wire.open()
        entry = find("fopdt")
        self.plant = PlantDevice(
            self.wire.open(), [PlantChannel(entry.build)] * channels, pace=pace, run=0, clock=self.wire.clock
        )
        settings = Settings(pv_low=40.0, pv_high=60.0)
        self.controller = ControllerDevice(
            self.wire.open(),
            [ControllerChannel(Parameters(KP, TI), 50.0, settings)] * channels,
            clock=self.wire.clock,
        )
        self.controller.start()
        self.plant.start()

    def pump(self) -> None:
        """Until nobody has anything to say."""
        busy = True
        while busy:
            busy = self.plant.runtime.poll(0.0) | self.controller.runtime.poll(0.0)
            busy |= (self.plant.runtime.due or self.wire.clock.now + 1.0) <= self.wire.clock.now

    def wait(self, seconds: float, alive: Sequence[int] = ()) -> None:
        """Wall time passes in steps of 20 ms, as the devices see it on a quiet bus; nodes in `alive` beat meanwhile."""
        for _ in range(round(seconds / 0.02)):
            for node in alive:
                self.client.send(heartbeat_id(node), HEARTBEAT_FRAME.pack(NmtState.OPERATIONAL))
            self.wire.clock.now += 0.02
            for device in (self.plant, self.controller):
                while device.runtime.poll(1e-9):
                    pass
        self.pump()

    def run(self, samples: int) -> None:
        assert self.write("plant_samples_to_run", samples) is None
        self.pump()

    def write(self, name: str, value: float, sub: int = 1) -> Abort | None:
        entry = lookup(name)
        sub = sub if entry.count(1) else 0
        data = entry.type.encode(value)
        command = 0x23 | (4 - len(data)) << 2
        answer = self._request(name, bytes((command,)) + entry.index.to_bytes(2, "little") + bytes((sub,)), data)
        return Abort(int.from_bytes(answer[4:8], "little")) if answer[0] == 0x80 else None

    def read(self, name: str, sub: int = 1) -> float:
        entry = lookup(name)
        sub = sub if entry.count(1) else 0
        answer = self._request(name, b"\x40" + entry.index.to_bytes(2, "little") + bytes((sub,)), b"")
        assert answer[0] & 0xF3 == 0x43
        return float(entry.type.decode(answer[4 : 4 + entry.type.size]))

    def _request(self, name: str, header: bytes, data: bytes) -> bytes:
        node = PLANT if name.startswith("plant_") else CONTROLLER
        self.client.send(sdo_request_id(node), header + data.ljust(4, b"\0"))
        self.pump()
        return self.wire.sent(sdo_response_id(node))[-1]

    def nmt(self, command: NmtCommand, node: int = 0) -> None:
        self.client.send(NMT_ID, NMT_FRAME.pack(command, node))
        self.pump()

    def emergencies(self, node: int) -> list[int]:
        return [EMCY_FRAME.unpack(data)[0] for data in self.wire.sent(emcy_id(node))]

    def status(self) -> tuple[int, int, float]:
        status: tuple[int, int, float] = STATUS_FRAME.unpack(self.wire.sent(IDS.status)[-1])
        return status


@pytest.fixture
def rig() -> Rig:
    return Rig()


def try_gains(rig: Rig, kp: float = 300.0, lease: int = 1000) -> None:
    rig.write("controller_lease", lease)
    rig.write("controller_staged_kp", kp)
    assert rig.write("controller_parameter_command", ParameterCommand.TRY) is None


class TestSamples:
    def test_a_sample_is_sync_pv_and_mv_of_one_number(self, rig: Rig) -> None:
        rig.wire.frames.clear()
        rig.run(3)
        ids = [can_id for can_id, _ in rig.wire.frames if can_id in (SYNC_ID, IDS.pv, IDS.mv)]
        assert ids == [SYNC_ID, IDS.pv, IDS.mv] * 3
        assert [PV_FRAME.unpack(data)[1] for data in rig.wire.sent(IDS.pv)] == [1, 2, 3]
        assert [MV_FRAME.unpack(data)[1] for data in rig.wire.sent(IDS.mv)] == [1, 2, 3]
        assert rig.read("plant_samples_to_run") == 0

    def test_the_loop_is_closed(self, rig: Rig) -> None:
        rig.write("controller_setpoint", 50.2)
        rig.run(2000)
        assert rig.read("plant_pv") == pytest.approx(50.2, abs=1e-3)
        assert rig.read("plant_mv") == rig.read("controller_mv") == pytest.approx(70.0, abs=0.1)

    def test_status_comes_before_the_mv_it_changes(self, rig: Rig) -> None:
        rig.run(1)
        rig.wire.frames.clear()
        rig.write("controller_setpoint", 51.0)
        rig.run(1)
        ids = [can_id for can_id, _ in rig.wire.frames]
        assert ids.index(IDS.status) < ids.index(IDS.mv)
        assert rig.status() == (Mode.AUTOMATIC, 0, 51.0)

    def test_command_pdo_moves_the_set_point_unless_it_is_no_number(self, rig: Rig) -> None:
        rig.client.send(IDS.command, bytes.fromhex("00004842"))  # 50.0
        rig.client.send(IDS.command, bytes.fromhex("00004c42"))  # 51.0
        rig.client.send(IDS.command, bytes.fromhex("0000c07f"))  # not a number
        rig.client.send(IDS.command, b"\0")
        rig.run(1)
        assert rig.status()[2] == 51.0

    def test_channels_do_not_mix(self) -> None:
        rig = Rig(channels=3)
        rig.write("controller_setpoint", 50.2, sub=2)
        rig.run(2000)
        values = [rig.read("plant_pv", sub) for sub in (1, 2, 3)]
        assert values == pytest.approx([50.0, 50.2, 50.0], abs=1e-3)

    def test_equal_seeds_give_equal_runs(self, rig: Rig) -> None:
        rig.write("plant_noise", 0.1)
        records = []
        for _ in range(2):
            assert rig.write("plant_initialise", 1) is None
            rig.wire.frames.clear()
            rig.run(20)
            records.append(rig.wire.sent(IDS.pv))
        assert records[0] == records[1]
        assert len(set(records[0])) == 20

    def test_held_objects_are_refused_while_running(self, rig: Rig) -> None:
        rig.nmt(NmtCommand.PRE_OPERATIONAL)
        rig.write("plant_samples_to_run", FOREVER)
        assert rig.write("plant_seed", 2) is Abort.DEVICE_STATE
        assert rig.write("plant_initialise", 1) is Abort.DEVICE_STATE

    def test_pace_follows_the_clock(self) -> None:
        rig = Rig(pace=10.0)
        rig.write("plant_samples_to_run", FOREVER)
        rig.plant.runtime.poll(0.0)
        start = rig.wire.clock.now
        for _ in range(400):
            rig.plant.runtime.poll(0.005)
            rig.controller.runtime.poll(0.0)
        assert len(rig.wire.sent(IDS.mv)) == pytest.approx((rig.wire.clock.now - start) / 0.01, abs=2)


class TestSessions:
    def test_a_trial_and_its_acceptance(self, rig: Rig) -> None:
        rig.run(1)
        try_gains(rig)
        rig.run(1)
        assert rig.status()[1] == 1
        assert rig.read("controller_accepted_kp") == KP
        rig.write("controller_parameter_command", ParameterCommand.ACCEPT)
        rig.write("controller_lease", 0)
        assert rig.read("controller_accepted_kp") == 300.0
        assert rig.read("controller_accept_count") == 1
        assert rig.read("controller_on_trial") == 0

    def test_what_cannot_be_kept_is_not_accepted(self, rig: Rig, capsys: pytest.CaptureFixture[str]) -> None:
        def full(accepted: Sequence[Parameters]) -> None:
            raise OSError("No space left on device")

        rig.controller._keep = full
        rig.run(1)
        try_gains(rig)
        assert rig.write("controller_parameter_command", ParameterCommand.ACCEPT) == Abort.NOT_STORED
        assert (rig.read("controller_accepted_kp"), rig.read("controller_accept_count")) == (KP, 0)
        assert rig.read("controller_on_trial") == 1
        assert "No space left" in capsys.readouterr().err

    def test_a_lease_used_up(self, rig: Rig) -> None:
        rig.run(1)
        try_gains(rig, lease=5)
        rig.write("controller_setpoint", 51.0)
        rig.run(4)
        assert rig.read("controller_on_trial") == 1
        assert rig.read("controller_lease") == 1
        rig.run(1)
        assert rig.read("controller_cause") == Cause.LEASE
        assert rig.status() == (Mode.AUTOMATIC, 0, 50.0)
        assert Emcy.LEASE_USED_UP in rig.emergencies(CONTROLLER)
        try_gains(rig)
        assert rig.emergencies(CONTROLLER)[-1] == Emcy.ERROR_GONE

    def test_each_channel_says_and_clears_its_own_error(self) -> None:
        rig = Rig(channels=2)
        rig.run(1)
        for sub in (1, 2):
            rig.write("controller_lease", 3, sub)
            rig.run(3)
        sources = [data[3] for data in rig.wire.sent(emcy_id(CONTROLLER)) if data[:2] == b"\x01\xff"]
        assert sources == [1, 2]
        registers = []
        for sub in (1, 2):
            rig.write("controller_lease", 1000, sub)
            registers.append(rig.read("error_register"))
        assert registers == [0x81, 0]

    def test_a_renewal_pays_for_a_session_and_never_opens_one(self, rig: Rig) -> None:
        rig.run(1)
        assert rig.write("controller_lease_renewal", 100) is Abort.DEVICE_STATE
        try_gains(rig, lease=5)
        rig.run(3)
        assert rig.write("controller_lease_renewal", 100) is None
        assert rig.write("controller_lease_renewal", 0) is Abort.TOO_LOW
        assert rig.read("controller_lease") == 100
        rig.run(100)
        assert rig.read("controller_cause") == Cause.LEASE
        assert rig.write("controller_lease_renewal", 100) is Abort.DEVICE_STATE
        assert (rig.read("controller_lease"), rig.read("controller_on_trial")) == (0, 0)

    def test_a_heartbeat_lost(self, rig: Rig) -> None:
        rig.run(1)
        try_gains(rig)
        rig.wait(0.5, alive=[TUNER_NODE])
        rig.wait(0.9)
        assert rig.read("controller_on_trial") == 1
        rig.wait(0.2)
        assert rig.read("controller_on_trial") == 0
        assert rig.read("controller_cause") == Cause.HEARTBEAT
        lost = [data for data in rig.wire.sent(emcy_id(CONTROLLER)) if data[:2] == b"\x30\x81"]
        assert lost == [bytes((0x30, 0x81, 0x11, TUNER_NODE, 1, 0, 0, 0))]
        rig.wait(0.1, alive=[TUNER_NODE])
        assert Emcy.ERROR_GONE in rig.emergencies(CONTROLLER)

    def test_a_heartbeat_is_lost_again_while_another_is_away(self, rig: Rig) -> None:
        """Each loss ends what is open then: none may go unsaid because some other node is still missing."""
        assert rig.write("heartbeat_consumer", 0x55 << 16 | 500, sub=2) is None
        rig.wait(0.1, alive=[0x55, TUNER_NODE])
        for _ in range(2):
            rig.write("controller_lease", 1000)
            rig.wait(1.2)
            rig.wait(0.1, alive=[TUNER_NODE])
        sources = [data[3] for data in rig.wire.sent(emcy_id(CONTROLLER)) if data[:2] == b"\x30\x81"]
        assert sources == [0x55, TUNER_NODE, TUNER_NODE]
        assert rig.read("error_register") == 0x11

    def test_a_tuner_with_nothing_open_may_fall_silent(self) -> None:
        rig = Rig(channels=33)
        rig.wait(0.1, alive=[TUNER_NODE])
        rig.wait(1.5)
        assert Emcy.HEARTBEAT_LOST not in rig.emergencies(CONTROLLER)
        rig.write("controller_lease", 1000, sub=33)
        rig.wait(0.1, alive=[TUNER_NODE])
        rig.wait(1.5)
        assert rig.read("controller_lease", sub=33) == 0, "the watch has stayed armed"
        assert Emcy.HEARTBEAT_LOST in rig.emergencies(CONTROLLER)

    def test_no_trial_without_a_first_heartbeat_is_lost(self, rig: Rig) -> None:
        rig.run(1)
        try_gains(rig)
        rig.wait(3.0)
        assert rig.read("controller_on_trial") == 1

    def test_leaving_operational_takes_the_trial_back(self, rig: Rig) -> None:
        rig.run(1)
        try_gains(rig)
        rig.nmt(NmtCommand.PRE_OPERATIONAL, CONTROLLER)
        assert rig.read("controller_cause") == Cause.NMT
        assert rig.read("controller_on_trial") == 0

    def test_relay_ends_at_a_pv_limit(self, rig: Rig) -> None:
        rig.run(1)
        assert rig.write("controller_mode_command", Mode.EXPERIMENT) is Abort.DEVICE_STATE
        rig.write("controller_lease", 10000)
        rig.write("controller_experiment", 1)
        rig.write("controller_relay_amplitude", 40.0)
        rig.write("controller_relay_pv_low", 49.95)
        rig.write("controller_relay_pv_high", 50.05)
        assert rig.write("controller_mode_command", Mode.EXPERIMENT) is None
        rig.run(1)
        assert rig.status()[0] == Mode.EXPERIMENT
        assert rig.write("controller_parameter_command", ParameterCommand.TRY) is Abort.DEVICE_STATE
        rig.run(200)
        assert rig.status()[0] == Mode.AUTOMATIC
        assert rig.read("controller_experiment_state") == ExperimentState.ENDED_BY_LIMIT
        assert Emcy.PV_LIMIT in rig.emergencies(CONTROLLER)

    def test_a_biased_relay_swings_between_its_two_amplitudes(self, rig: Rig) -> None:
        rig.run(1)
        rig.write("controller_lease", 10000)
        rig.write("controller_experiment", 1)
        rig.write("controller_relay_amplitude", 4.0)
        rig.write("controller_relay_amplitude_low", 2.0)
        rig.write("controller_relay_average", 3)
        rig.write("controller_relay_working_output", 50.0)
        assert rig.write("controller_relay_average", 0) is Abort.TOO_LOW
        assert rig.write("controller_mode_command", Mode.EXPERIMENT) is None
        outputs = set()
        for _ in range(200):
            rig.run(1)
            outputs.add(rig.read("plant_mv"))
        assert outputs == {48.0, 54.0}


class TestSettings:
    def test_limits_hold_and_must_fit_each_other(self, rig: Rig) -> None:
        assert rig.write("controller_mv_high", 52.0) is None
        assert rig.write("controller_mv_low", 53.0) is Abort.MAXIMUM_BELOW_MINIMUM
        rig.write("controller_setpoint", 55.0)
        rig.run(50)
        assert rig.read("plant_mv") == 52.0

    def test_off_is_the_safe_output(self, rig: Rig) -> None:
        rig.write("controller_safe_output", 20.0)
        rig.write("controller_on", 0)
        rig.run(1)
        assert rig.read("controller_mode") == Mode.OFF
        assert rig.read("plant_mv") == 20.0

    def test_mirrors(self, rig: Rig) -> None:
        assert rig.read("controller_proportional_band") == pytest.approx(100.0 * 100.0 / (KP * 20.0))
        assert rig.read("controller_ti") == TI
        assert rig.read("controller_cycle_time") == pytest.approx(0.1)

    def test_sample_time_changes_in_pre_operational_only(self, rig: Rig) -> None:
        assert rig.write("sample_time", 200_000) is Abort.DEVICE_STATE
        rig.nmt(NmtCommand.PRE_OPERATIONAL)
        assert rig.write("sample_time", 200_000) is None
        assert rig.read("controller_cycle_time") == pytest.approx(0.2)


class TestStates:
    def test_starts_to_operational_by_itself(self, rig: Rig) -> None:
        for node in (PLANT, CONTROLLER):
            assert rig.wire.sent(heartbeat_id(node))[0] == bytes((NmtState.BOOT_UP,))
        assert rig.plant.runtime.state is rig.controller.runtime.state is NmtState.OPERATIONAL

    def test_pdos_in_operational_only(self, rig: Rig) -> None:
        rig.nmt(NmtCommand.PRE_OPERATIONAL, CONTROLLER)
        rig.run(1)
        assert rig.wire.sent(IDS.pv) and not rig.wire.sent(IDS.mv)

    def test_stopped_is_silent_but_for_the_heartbeat(self, rig: Rig) -> None:
        rig.nmt(NmtCommand.STOP, CONTROLLER)
        rig.wire.frames.clear()
        rig.client.send(sdo_request_id(CONTROLLER), bytes.fromhex("4000100000000000"))
        rig.wait(2.0)
        from_controller = {can_id for can_id, _ in rig.wire.frames if can_id & 0x7F == CONTROLLER}
        assert from_controller == {heartbeat_id(CONTROLLER), sdo_request_id(CONTROLLER)}
        assert set(rig.wire.sent(heartbeat_id(CONTROLLER))) == {bytes((NmtState.STOPPED,))}
        rig.nmt(NmtCommand.START)
        assert rig.read("controller_setpoint") == 50.0

    def test_commands_to_other_nodes_are_not_ours(self, rig: Rig) -> None:
        rig.nmt(NmtCommand.STOP, 0x33)
        assert rig.controller.runtime.state is NmtState.OPERATIONAL

    def test_reset_takes_the_staged_set_back_and_boots_again(self, rig: Rig) -> None:
        rig.write("controller_staged_kp", 300.0)
        rig.run(5)
        rig.wire.frames.clear()
        rig.nmt(NmtCommand.RESET_NODE)
        for node in (PLANT, CONTROLLER):
            assert rig.wire.sent(heartbeat_id(node))[0] == bytes((NmtState.BOOT_UP,))
        assert rig.read("controller_staged_kp") == KP
        assert rig.plant.dictionary.read(0x2000, 0) == bytes(4)
        rig.run(1)
        assert len(rig.wire.sent(IDS.mv)) == 1

    def test_heartbeat_period(self, rig: Rig) -> None:
        rig.write("heartbeat_producer", 100)
        rig.wire.frames.clear()
        rig.wait(2.0)
        assert len(rig.wire.sent(heartbeat_id(CONTROLLER))) == pytest.approx(20, abs=4)


class TestMissing:
    @pytest.fixture
    def alone(self, rig: Rig) -> Rig:
        """The controller does not answer."""
        rig.nmt(NmtCommand.STOP, CONTROLLER)
        return rig

    def test_hold(self, alone: Rig) -> None:
        alone.run(3)
        alone.wait(1.0)
        assert alone.read("plant_missing_answers") == 3
        assert alone.read("plant_samples_to_run") == 0
        assert alone.read("plant_mv") == 50.0
        assert alone.emergencies(PLANT) == [Emcy.NO_ANSWER]

    def test_stop_the_run(self, alone: Rig) -> None:
        alone.write("plant_on_missing_answer", OnMissingAnswer.STOP_RUN)
        alone.run(100)
        alone.wait(1.0)
        assert alone.read("plant_missing_answers") == 1
        assert alone.read("plant_samples_to_run") == 0

    def test_safe_output(self, alone: Rig) -> None:
        alone.write("plant_on_missing_answer", OnMissingAnswer.SAFE_OUTPUT)
        alone.write("plant_safe_output", 12.5)
        alone.run(1)
        alone.wait(0.3)
        assert alone.read("plant_mv") == 12.5

    def test_answers_back(self, alone: Rig) -> None:
        alone.run(1)
        alone.wait(0.3)
        alone.nmt(NmtCommand.START, CONTROLLER)
        alone.run(1)
        assert alone.emergencies(PLANT) == [Emcy.NO_ANSWER, Emcy.ERROR_GONE]

    @pytest.mark.parametrize(("mv", "offset"), [(float("nan"), 0), (77.0, -1), (77.0, 1)])
    def test_an_answer_that_is_none(self, alone: Rig, mv: float, offset: int) -> None:
        alone.run(1)
        alone.client.send(IDS.mv, MV_FRAME.pack(mv, 1 + offset & 0xFFFFFFFF))
        alone.pump()
        assert alone.read("plant_mv") == 50.0
        alone.wait(0.3)
        assert alone.read("plant_missing_answers") == 1

    def test_controller_without_pv(self, rig: Rig) -> None:
        rig.run(1)
        rig.wait(0.9)
        assert rig.emergencies(CONTROLLER) == []
        rig.wait(0.3)
        assert rig.emergencies(CONTROLLER) == [Emcy.NO_PV]
        rig.run(1)
        rig.wait(0.1)
        assert rig.emergencies(CONTROLLER) == [Emcy.NO_PV, Emcy.ERROR_GONE]
