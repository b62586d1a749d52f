"""Outside changes to a loop under test: by SDO, by RPDO, by the ordinary objects of gains and limits."""

from __future__ import annotations

import pytest

from loopwright.protocol.profile import COMMAND_FRAME, Cause, Mode, Order, OutsideChange, ParameterCommand
from tests.unit.protocol.rig import IDS, KP, Rig


@pytest.fixture
def rig() -> Rig:
    rig = Rig()
    rig.under_test()
    return rig


def rpdo(rig: Rig, setpoint: float) -> None:
    rig.client.send(IDS.command, COMMAND_FRAME.pack(setpoint))
    rig.pump()


def hand(rig: Rig) -> OutsideChange:
    """What the device says has moved; none: the test goes on."""
    assert (rig.read("controller_session") == 0) == (rig.read("controller_cause") == Cause.OUTSIDE_CHANGE)
    return OutsideChange(int(rig.read("controller_outside_changes")))


@pytest.mark.parametrize(
    ("name", "value", "what"),
    [
        ("controller_setpoint", 51.0, OutsideChange.SETPOINT),
        ("controller_setpoint", 50.25, OutsideChange.SETPOINT),  # the test's own
        ("controller_setpoint", 50.0, OutsideChange.SETPOINT),  # home's
        ("controller_mode_command", Mode.OFF, OutsideChange.MODE),
        ("controller_mode_command", Mode.MANUAL, OutsideChange.MODE),
        ("controller_mode_command", Mode.AUTOMATIC, OutsideChange.MODE),
        ("controller_on", 0, OutsideChange.MODE),
        ("controller_on", 1, OutsideChange.MODE),
        ("controller_manual_output", 44.0, OutsideChange.OUTPUT),
        ("controller_manual_output", 50.0, OutsideChange.OUTPUT),
        ("controller_parameter_command", ParameterCommand.TRY, OutsideChange.GAINS),
        ("controller_parameter_command", ParameterCommand.ACCEPT, OutsideChange.GAINS),
        ("controller_parameter_command", ParameterCommand.GO_BACK, OutsideChange.GAINS),
        ("controller_mv_low", 10.0, OutsideChange.LIMITS),
        ("controller_mv_high", 90.0, OutsideChange.LIMITS),
        ("controller_safe_output", 7.0, OutsideChange.LIMITS),
        ("controller_rate_limit", 5.0, OutsideChange.LIMITS),
        ("controller_pv_low", 30.0, OutsideChange.LIMITS),
        ("controller_pv_high", 70.0, OutsideChange.LIMITS),
        ("controller_action", 0, OutsideChange.LIMITS),
    ],
)
def test_a_write_by_sdo_is_a_hand_also_of_an_equal_value(
    rig: Rig, name: str, value: float, what: OutsideChange
) -> None:
    assert rig.write(name, value) is None
    assert hand(rig) == what
    if name not in ("controller_parameter_command",):
        assert rig.read(name) == (pytest.approx(value) if name != "controller_on" else value), "it stands"
    if what is not OutsideChange.MODE:
        assert rig.read("controller_mode") == Mode.AUTOMATIC
    if what is not OutsideChange.SETPOINT:
        assert rig.read("controller_setpoint") == 50.0
    assert rig.read("controller_accepted_kp") == KP


@pytest.mark.parametrize("name", ["controller_staged_kp", "controller_session_kp", "controller_session_setpoint"])
def test_staging_is_no_hand(rig: Rig, name: str) -> None:
    rig.write(name, 60.0)
    assert hand(rig) is OutsideChange.NONE


def test_a_write_that_is_refused_is_no_hand(rig: Rig) -> None:
    for name, value in (("controller_setpoint", float("nan")), ("controller_mode_command", 3)):
        assert rig.write(name, value) is not None
    assert rig.write("controller_pv_low", 99.0) is not None, "above the high end"
    assert hand(rig) is OutsideChange.NONE


class TestRpdo:
    def test_one_that_repeats_homes_set_point_is_none(self, rig: Rig) -> None:
        for _ in range(5):
            rpdo(rig, 50.0)
            rig.run(1)
        assert hand(rig) is OutsideChange.NONE and rig.read("controller_setpoint") == 50.25

    def test_the_first_one_is_compared_with_home(self, rig: Rig) -> None:
        rpdo(rig, 50.25)
        assert hand(rig) is OutsideChange.SETPOINT, "not with what the test has commanded"
        assert rig.read("controller_setpoint") == 50.25

    def test_a_value_that_changes_is_a_hand_and_stands(self, rig: Rig) -> None:
        rpdo(rig, 50.0)
        rpdo(rig, 51.0)
        assert hand(rig) is OutsideChange.SETPOINT and rig.is_home(51.0)

    def test_one_is_compared_with_the_last_on_that_pdo(self) -> None:
        rig = Rig()
        rpdo(rig, 49.0)
        rig.wait(3.0)
        rig.write("controller_setpoint", 50.0)
        rig.under_test()
        rpdo(rig, 49.0)
        assert hand(rig) is OutsideChange.NONE and rig.read("controller_setpoint") == 50.25
        rpdo(rig, 50.0)
        assert hand(rig) is OutsideChange.SETPOINT

    def test_one_that_is_repeated_after_the_end_does_not_blame_the_set_point(self, rig: Rig) -> None:
        rpdo(rig, 50.0)
        rig.write("controller_manual_output", 44.0)
        rpdo(rig, 50.0)
        assert hand(rig) is OutsideChange.OUTPUT

    def test_one_that_differs_from_the_set_point_after_the_end_is_a_hand(self, rig: Rig) -> None:
        rpdo(rig, 50.0)
        rig.write("controller_setpoint", 51.0)
        rpdo(rig, 50.0)
        assert hand(rig) is OutsideChange.SETPOINT and rig.read("controller_setpoint") == 50.0

    def test_what_is_no_set_point_is_no_hand(self, rig: Rig) -> None:
        rpdo(rig, float("nan"))
        rig.client.send(IDS.command, b"\0\0")
        rig.pump()
        assert hand(rig) is OutsideChange.NONE

    def test_one_that_repeats_a_set_point_which_is_no_real32_is_none(self) -> None:
        rig = Rig(setpoint=50.0123456789)
        rig.under_test()
        for _ in range(3):
            rpdo(rig, 50.0123456789)
        assert hand(rig) is OutsideChange.NONE


def test_an_operators_off_is_the_safe_output_in_the_next_sample(rig: Rig) -> None:
    rig.write("controller_mode_command", Mode.OFF)
    rig.run(1)
    assert rig.read("plant_mv") == 0.0 and rig.status()[0] == Mode.OFF


def test_an_operators_manual_during_a_relay_takes_the_working_output(rig: Rig) -> None:
    assert rig.read("plant_mv") in (46.0, 54.0)
    rig.write("controller_mode_command", Mode.MANUAL)
    rig.run(1)
    assert rig.read("plant_mv") == rig.read("controller_manual_output") == 50.0


def test_gains_by_hand_need_no_session() -> None:
    rig = Rig()
    rig.run(3)
    rig.write("controller_staged_kp", 300.0)
    assert rig.write("controller_parameter_command", ParameterCommand.TRY) is None
    assert (rig.read("controller_on_trial"), rig.read("controller_accepted_kp")) == (1, KP)
    rig.write("controller_parameter_command", ParameterCommand.GO_BACK)
    assert rig.read("controller_on_trial") == 0
    rig.write("controller_parameter_command", ParameterCommand.TRY)
    rig.write("controller_parameter_command", ParameterCommand.ACCEPT)
    assert (rig.read("controller_on_trial"), rig.read("controller_accepted_kp")) == (0, 300.0)


def test_gains_staged_by_hand_do_not_get_into_an_acceptance(rig: Rig) -> None:
    rig.order(Order.MODE, Mode.AUTOMATIC)
    rig.write("controller_staged_kp", 999.0)
    assert rig.order(Order.ACCEPT, 300.0, 10.0, 0.0, 0.0, 1.0, 0.0) is None
    rig.write("controller_staged_kp", 888.0)
    assert rig.read("controller_accepted_kp") == 300.0
