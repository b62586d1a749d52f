"""Plant and controller devices joined by a bus in memory: samples, settings, missing answers."""

from __future__ import annotations

import pytest

from loopwright.protocol.profile import (
    FOREVER,
    MV_FRAME,
    PV_FRAME,
    SYNC_ID,
    UNASKED,
    Abort,
    Emcy,
    Mode,
    NmtCommand,
    OnMissingAnswer,
)
from tests.unit.protocol.rig import CONTROLLER, IDS, KP, PLANT, TI, Rig


@pytest.fixture
def rig() -> Rig:
    return Rig()


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

    def test_a_pdo_of_another_length(self, rig: Rig) -> None:
        """Cut where it is longer, said where it is shorter."""
        rig.client.send(IDS.command, bytes.fromhex("00004c42 ff"))  # 51.0
        rig.pump()
        assert rig.read("controller_setpoint") == 51.0
        for can_id in (IDS.command, IDS.pv):
            rig.client.send(can_id, b"\0")
        rig.pump()
        assert rig.emergencies(CONTROLLER) == [Emcy.PDO_LENGTH] * 2
        rig.client.send(IDS.mv, bytes(7))
        rig.pump()
        assert rig.emergencies(PLANT) == [Emcy.PDO_LENGTH]
        rig.run(2)
        assert rig.emergencies(PLANT)[-1] == Emcy.ERROR_GONE
        assert rig.read("plant_missing_answers") == 0

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

    @pytest.mark.parametrize(("mv", "offset"), [(float("nan"), 0), (77.0, 1), (77.0, 2)])
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


class TestUnasked:
    """MV with sample number 0: it answers no sample and takes effect at once."""

    @pytest.mark.parametrize("state", [None, NmtCommand.STOP], ids=["controller operational", "controller stopped"])
    def test_the_plant_takes_it_and_stays_where_it_is(self, rig: Rig, state: NmtCommand | None) -> None:
        rig.run(3)
        if state is not None:
            rig.nmt(state, CONTROLLER)
        rig.wire.frames.clear()
        rig.client.send(IDS.mv, MV_FRAME.pack(71.0, UNASKED))
        rig.pump()
        assert (rig.read("plant_mv"), rig.plant.dictionary.on_read["sample_number"](0)) == (71.0, 3)
        assert rig.wire.sent(SYNC_ID) == rig.wire.sent(IDS.pv) == []

    def test_it_is_no_answer_to_a_sample_that_waits(self, rig: Rig) -> None:
        rig.nmt(NmtCommand.STOP, CONTROLLER)
        rig.run(1)
        rig.client.send(IDS.mv, MV_FRAME.pack(71.0, UNASKED))
        rig.wait(0.3)
        assert (rig.read("plant_mv"), rig.read("plant_missing_answers")) == (71.0, 1)

    @pytest.mark.parametrize(("sent", "taken"), [(-5.0, 0.0), (130.0, 100.0), (float("nan"), 50.0)])
    def test_it_keeps_the_range_of_the_output(self, rig: Rig, sent: float, taken: float) -> None:
        rig.client.send(IDS.mv, MV_FRAME.pack(sent, UNASKED))
        rig.pump()
        assert rig.read("plant_mv") == taken


class TestWrap:
    def test_after_the_last_sample_number_comes_1(self, rig: Rig) -> None:
        rig.run(2)
        rig.plant.number = 0xFFFFFFFD
        rig.wire.frames.clear()
        rig.run(5)
        numbers = [0xFFFFFFFE, 0xFFFFFFFF, 1, 2, 3]
        assert [PV_FRAME.unpack(data)[1] for data in rig.wire.sent(IDS.pv)] == numbers
        assert [MV_FRAME.unpack(data)[1] for data in rig.wire.sent(IDS.mv)] == numbers
        assert rig.read("plant_missing_answers") == 0
