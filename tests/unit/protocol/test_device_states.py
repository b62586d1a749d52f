"""NMT states of both devices: what each lets through, and what becomes of a session that one is left in."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from loopwright.controller.device import RetainedState
from loopwright.protocol.objects import lookup
from loopwright.protocol.profile import (
    MV_FRAME,
    UNASKED,
    Abort,
    Cause,
    Mode,
    NmtCommand,
    NmtState,
    Order,
    heartbeat_id,
    sdo_request_id,
)
from tests.unit.protocol.rig import CONTROLLER, IDS, KP, PLANT, Rig


@pytest.fixture
def rig() -> Rig:
    return Rig()


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
        assert rig.plant.dictionary.read(lookup("sample_number").index, 0) == bytes(4)
        rig.run(1)
        assert len(rig.wire.sent(IDS.mv)) == 1

    def test_heartbeat_period(self, rig: Rig) -> None:
        rig.write("heartbeat_producer", 100)
        rig.wire.frames.clear()
        rig.wait(2.0)
        assert len(rig.wire.sent(heartbeat_id(CONTROLLER))) == pytest.approx(20, abs=4)


LEAVING = [NmtCommand.PRE_OPERATIONAL, NmtCommand.STOP, NmtCommand.RESET_COMMUNICATION, NmtCommand.RESET_NODE]


class TestSessionAndStates:
    @pytest.mark.parametrize("command", LEAVING, ids=lambda command: command.name.lower())
    @pytest.mark.parametrize("to", [0, CONTROLLER], ids=["all", "the controller"])
    def test_leaving_operational_sends_the_output_of_home_as_its_last_pdo(
        self, rig: Rig, command: NmtCommand, to: int
    ) -> None:
        rig.under_test()
        home = rig.read("controller_home_mv")
        assert rig.read("plant_mv") != home
        rig.wire.frames.clear()
        rig.nmt(command, CONTROLLER)
        assert rig.wire.sent(IDS.mv)[-1] == MV_FRAME.pack(home, UNASKED)
        assert rig.read("plant_mv") == pytest.approx(home, rel=1e-6)

    @pytest.mark.parametrize("command", [NmtCommand.PRE_OPERATIONAL, NmtCommand.RESET_COMMUNICATION], ids=str)
    def test_it_ends_the_session(self, rig: Rig, command: NmtCommand) -> None:
        rig.under_test()
        rig.nmt(command, CONTROLLER)
        assert rig.is_home() and rig.read("controller_cause") == Cause.NMT

    def test_started_again_the_law_goes_on_from_the_output_of_home(self, rig: Rig) -> None:
        rig.under_test()
        home = rig.read("controller_home_mv")
        rig.nmt(NmtCommand.PRE_OPERATIONAL, CONTROLLER)
        rig.nmt(NmtCommand.START, CONTROLLER)
        rig.run(1)
        assert rig.read("plant_mv") == pytest.approx(home, abs=1.0)

    def test_the_home_of_a_manual_loop_is_its_manual_output(self, rig: Rig) -> None:
        rig.write("controller_mode_command", Mode.MANUAL)
        rig.write("controller_manual_output", 37.0)
        rig.under_test()
        rig.nmt(NmtCommand.STOP, CONTROLLER)
        assert rig.read("plant_mv") == 37.0

    def test_without_a_session_nothing_is_sent(self, rig: Rig) -> None:
        rig.run(3)
        rig.wire.frames.clear()
        rig.nmt(NmtCommand.PRE_OPERATIONAL, CONTROLLER)
        assert rig.wire.sent(IDS.mv) == []

    def test_no_session_is_opened_in_a_node_that_is_not_operational(self, rig: Rig) -> None:
        """No time would end it there."""
        rig.run(3)
        rig.nmt(NmtCommand.PRE_OPERATIONAL, CONTROLLER)
        assert rig.order(Order.OPEN, 0x7D, 100, 3000, 1000, 1000) is Abort.DEVICE_STATE
        assert rig.read("controller_session") == 0

    def test_reset_communication_leaves_what_is_of_the_application(self, rig: Rig) -> None:
        rig.write("controller_setpoint", 50.5)
        rig.write("controller_staged_kp", 300.0)
        rig.write("controller_session_output", 12.0)
        rig.run(2)
        rig.nmt(NmtCommand.RESET_COMMUNICATION, CONTROLLER)
        names = ("controller_setpoint", "controller_staged_kp", "controller_session_output", "sample_number")
        assert [rig.read(name) for name in names] == [50.5, 300.0, 12.0, 2]

    def test_reset_node_is_a_power_on(self, rig: Rig) -> None:
        rig.under_test()
        rig.order(Order.MODE, Mode.AUTOMATIC)
        assert rig.order(Order.ACCEPT, 300.0, 10.0, 0.0, 0.0, 1.0, 0.0) is None
        rig.write("controller_setpoint", 50.5)
        rig.write("controller_mode_command", Mode.MANUAL)
        rig.nmt(NmtCommand.RESET_NODE, CONTROLLER)
        assert (rig.read("controller_accepted_kp"), rig.is_home()) == (KP, True)
        assert [rig.read(name) for name in ("controller_session_last", "controller_cause", "sample_number")] == [0] * 3

    def test_reset_node_keeps_what_outlives_a_restart(self) -> None:
        class Memory:
            def __init__(self) -> None:
                self.kept: list[list[RetainedState]] = []

            def write_now(self, channels: Sequence[RetainedState]) -> None:
                self.kept.append(list(channels))

            write_soon = write_now

        memory = Memory()
        rig = Rig(retained_state=memory)
        rig.write("controller_setpoint", 50.5)
        rig.under_test()
        rig.order(Order.MODE, Mode.AUTOMATIC)
        rig.order(Order.ACCEPT, 300.0, 10.0, 0.0, 0.0, 1.0, 0.0)
        assert (memory.kept[-1][0].accepted.Kp, memory.kept[-1][0].setpoint) == (300.0, 50.5), "home, within a session"
        rig.nmt(NmtCommand.RESET_NODE, CONTROLLER)
        assert (rig.read("controller_accepted_kp"), rig.is_home(50.5)) == (300.0, True)
        rig.write("controller_mode_command", Mode.OFF)
        rig.wait(0.1)
        assert memory.kept[-1][0].mode is Mode.OFF, "the last choice, outside of one"
