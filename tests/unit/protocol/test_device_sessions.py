"""Sessions over a bus in memory: opening, orders, ends, and what is said of them by SDO, PDO and EMCY."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from loopwright.controller.device import RetainedState
from loopwright.protocol.objects import lookup
from loopwright.protocol.profile import (
    COMMAND_FRAME,
    MV_FRAME,
    PV_FRAME,
    TUNER_NODE,
    UNASKED,
    Abort,
    Cause,
    Emcy,
    Mode,
    Order,
    RelayState,
    channel_ids,
    emcy_id,
)
from loopwright.protocol.session import check_of, object_of
from tests.unit.protocol.rig import CONTROLLER, IDS, KP, Rig

TERMS = (TUNER_NODE, 100, 3000, 1000, 1000)
NEW = (300.0, 10.0, 0.0, 0.0, 1.0, 0.0)


@pytest.fixture
def rig() -> Rig:
    rig = Rig()
    rig.run(3)
    return rig


class TestOpening:
    def test_is_told_by_sdo_and_by_the_status(self, rig: Rig) -> None:
        offered = rig.read("controller_session_next")
        assert rig.open() == offered != rig.read("controller_session_next")
        assert (rig.read("controller_session_holder"), rig.read("controller_session_is_open")) == (TUNER_NODE, 1)
        rig.run(1)
        assert rig.session() == (True, Cause.NONE)

    def test_home_is_read_back(self, rig: Rig) -> None:
        rig.write("controller_setpoint", 50.25)
        rig.run(1)
        mv = rig.read("controller_mv")
        rig.open()
        rig.order(Order.SETPOINT, 51.0)
        rig.order(Order.MODE, Mode.MANUAL)
        names = ("mode", "setpoint", "manual_output", "mv", "kp")
        assert [rig.read(f"controller_home_{name}") for name in names] == [Mode.AUTOMATIC, 50.25, 50.0, mv, KP]

    def test_a_second_one_is_refused_with_an_abort(self, rig: Rig) -> None:
        number = rig.open()
        assert rig.order(Order.OPEN, 0x55, *TERMS[1:]) is Abort.DEVICE_STATE
        assert (rig.read("controller_session"), rig.read("controller_session_holder")) == (number, TUNER_NODE)

    def test_each_channel_has_its_own(self) -> None:
        rig = Rig(channels=2)
        rig.run(3)
        assert rig.open(sub=1) != rig.open(sub=2)
        assert rig.order(Order.CLOSE, sub=1) is None
        assert (rig.read("controller_session", 1), rig.read("controller_session", 2) > 0) == (0, True)

    @pytest.mark.parametrize(
        ("name", "value"),
        [("tuner", 0), ("tuner", 128), ("lease_samples", 0), ("lease_ms", 0), ("pv_silence_ms", 0), ("watch_ms", 0)],
    )
    def test_terms_without_an_end_cannot_be_staged(self, rig: Rig, name: str, value: int) -> None:
        assert rig.write(f"controller_session_{name}", value) in (Abort.TOO_LOW, Abort.TOO_HIGH)

    def test_an_rpdo_that_moves_the_set_point_keeps_a_test_away(self, rig: Rig) -> None:
        """The inner loop of a cascade."""
        for value in (50.1, 50.2):
            rig.client.send(IDS.command, COMMAND_FRAME.pack(value))
            rig.pump()
        assert rig.order(Order.OPEN, *TERMS) == Abort.LOCAL_CONTROL == 0x08000021
        rig.wait(1.5)
        rig.client.send(IDS.command, COMMAND_FRAME.pack(50.2))
        rig.pump()
        assert rig.order(Order.OPEN, *TERMS) is Abort.LOCAL_CONTROL
        rig.wait(0.6)
        assert rig.order(Order.OPEN, *TERMS) is None, "repeating a value drives nothing"

    def test_a_plc_that_says_the_set_point_it_has_drives_nothing(self) -> None:
        """Its REAL32 is the nearest to the set-point, not equal to the double of the options."""
        rig = Rig(setpoint=49.2838831323648137)
        rig.run(3)
        rig.client.send(IDS.command, COMMAND_FRAME.pack(49.2838831323648137))
        rig.pump()
        assert rig.order(Order.OPEN, *TERMS) is None


class TestOrders:
    def test_what_is_staged_has_no_effect(self, rig: Rig) -> None:
        before = rig.read("controller_setpoint"), rig.read("controller_mode"), rig.read("controller_ti")
        rig.open()
        rig.write("controller_session_setpoint", 55.0)
        rig.write("controller_session_mode", Mode.OFF)
        rig.write("controller_session_ti", 1.0)
        rig.run(3)
        assert (rig.read("controller_setpoint"), rig.read("controller_mode"), rig.read("controller_ti")) == before

    def test_the_check_puts_it_in_force(self, rig: Rig) -> None:
        rig.open()
        assert rig.order(Order.TRY, *NEW) is None
        rig.run(1)
        assert rig.status()[1] == 1 and rig.read("controller_accepted_kp") == KP
        assert rig.order(Order.ACCEPT, *NEW) is None
        assert rig.order(Order.CLOSE) is None
        assert (rig.read("controller_accepted_kp"), rig.read("controller_accept_count")) == (300.0, 1)
        assert rig.is_home()

    def test_staged_by_another_meanwhile_it_is_refused(self, rig: Rig) -> None:
        number = rig.open()
        check = check_of(number, 1, Order.ACCEPT, NEW)
        for name, value in zip(("kp", "ti", "td", "tf", "b", "c"), NEW, strict=True):
            rig.write(f"controller_session_{name}", value)
        rig.write("controller_session_kp", 999.0)
        assert rig.write(object_of(Order.ACCEPT), check) is Abort.INVALID_VALUE
        assert rig.read("controller_accepted_kp") == KP

    def test_a_value_beyond_its_limits_is_refused_where_it_is_staged(self, rig: Rig) -> None:
        rig.open()
        for name, value in (("session_output", 150.0), ("session_mode", 3), ("relay_average", 0), ("session_kp", 0.0)):
            assert rig.write(f"controller_{name}", value) in (Abort.TOO_HIGH, Abort.TOO_LOW)

    def test_a_relay_swings_between_its_two_amplitudes(self, rig: Rig) -> None:
        rig.open()
        assert rig.order(Order.RELAY, 4.0, 0.0, 50.0, 10_000, 40.0, 60.0, 2.0, 3) is None
        outputs = set()
        for _ in range(200):
            rig.run(1)
            outputs.add(rig.read("plant_mv"))
        assert outputs == {48.0, 54.0} and rig.status()[0] == Mode.EXPERIMENT

    def test_what_cannot_be_kept_is_not_accepted(self, capsys: pytest.CaptureFixture[str]) -> None:
        later: list[Sequence[RetainedState]] = []

        class Full:
            def write_now(self, channels: Sequence[RetainedState]) -> None:
                raise OSError("No space left on device")

            def write_soon(self, channels: Sequence[RetainedState]) -> None:
                later.append(channels)

        rig = Rig(retained_state=Full())
        rig.run(1)
        rig.open()
        assert rig.order(Order.ACCEPT, *NEW) is Abort.NOT_STORED
        assert (rig.read("controller_accepted_kp"), rig.read("controller_accept_count")) == (KP, 0)
        assert "No space left" in capsys.readouterr().err
        assert later[-1][0].accepted.Kp == KP, "what was refused may be on the disk all the same"


class TestEnds:
    def test_a_lease_used_up(self, rig: Rig) -> None:
        rig.open(samples=5)
        rig.order(Order.SETPOINT, 51.0)
        rig.run(5)
        assert rig.read("controller_session_is_open") == 1
        rig.run(1)
        assert rig.status() == (Mode.AUTOMATIC, 0, 50.0) and rig.session() == (False, Cause.LEASE)
        assert rig.emergencies(CONTROLLER) == [Emcy.LEASE_USED_UP]
        rig.open()
        assert rig.emergencies(CONTROLLER)[-1] == Emcy.ERROR_GONE

    def test_a_renewal_pays_for_this_session_only(self, rig: Rig) -> None:
        assert rig.write("controller_session_renewal", 1) is Abort.DEVICE_STATE
        number = rig.open(samples=5)
        for _ in range(4):
            rig.run(4)
            assert rig.write("controller_session_renewal", number) is None
        assert rig.write("controller_session_renewal", number + 1) is Abort.DEVICE_STATE
        rig.run(6)
        assert rig.write("controller_session_renewal", number) is Abort.DEVICE_STATE
        assert rig.read("controller_session_last") == number

    def test_a_renewal_by_pdo_pays_for_the_session_that_it_names(self) -> None:
        rig = Rig(channels=2)
        rig.run(3)
        first, second = rig.open(samples=5), rig.open(samples=5, sub=2)
        for _ in range(4):
            rig.run(4)
            rig.renew(first, 1)
            rig.renew(second, 1)
            rig.renew(first, 3)
        assert [rig.read("controller_session", sub) for sub in (1, 2)] == [first, 0]
        rig.run(6)
        assert rig.read("controller_session") == 0

    def test_a_renewal_of_a_session_that_is_over_is_answered_with_the_status(self, rig: Rig) -> None:
        number = rig.open()
        rig.order(Order.CLOSE)
        rig.run(1)
        before = len(rig.wire.sent(IDS.status))
        for times, which in enumerate((number, number + 1, 0), 1):
            rig.renew(which)
            assert len(rig.wire.sent(IDS.status)) == before + times and rig.session() == (False, Cause.CLOSED)

    def test_each_channel_says_and_clears_its_own_error(self) -> None:
        rig = Rig(channels=2)
        rig.run(1)
        for sub in (1, 2):
            rig.open(samples=3, sub=sub)
            rig.run(4)
        sources = [data[3] for data in rig.wire.sent(emcy_id(CONTROLLER)) if data[:2] == b"\x01\xff"]
        assert sources == [1, 2]
        registers = []
        for sub in (1, 2):
            rig.open(sub=sub)
            registers.append(rig.read("error_register"))
        assert registers == [0x81, 0]

    @pytest.mark.parametrize("first", [True, False], ids=["never heard", "heard before"])
    def test_a_tuner_that_is_silent_loses_the_loop(self, rig: Rig, first: bool) -> None:
        rig.open(silence_ms=60_000)
        rig.order(Order.SETPOINT, 51.0)
        if not first:
            rig.wait(3.0, alive=[TUNER_NODE])
        rig.wait(0.9)
        assert rig.read("controller_session_is_open") == 1
        rig.wait(0.2)
        assert rig.is_home() and rig.read("controller_cause") == Cause.HEARTBEAT
        assert rig.emergencies(CONTROLLER)[0] in (Emcy.TUNER_LOST, Emcy.NO_PV)
        assert Emcy.TUNER_LOST in rig.emergencies(CONTROLLER)

    def test_another_gateways_heartbeat_keeps_no_session(self, rig: Rig) -> None:
        rig.open(silence_ms=60_000)
        rig.wait(1.2, alive=[TUNER_NODE - 1])
        assert rig.read("controller_cause") == Cause.HEARTBEAT

    def test_each_session_has_its_own_tuner(self) -> None:
        rig = Rig(channels=2)
        rig.run(3)
        for sub, node in ((1, 0x55), (2, 0x56)):
            assert rig.order(Order.OPEN, node, 10_000, 60_000, 60_000, 1000, sub=sub) is None
        rig.wait(1.2, alive=[0x56])
        assert [rig.read("controller_session_is_open", sub) for sub in (1, 2)] == [0, 1]

    def test_1016h_is_the_installers(self, rig: Rig) -> None:
        assert rig.read("heartbeat_consumer") == 0
        rig.open()
        rig.order(Order.CLOSE)
        assert rig.read("heartbeat_consumer") == 0

    def test_a_tuner_with_nothing_open_may_fall_silent(self, rig: Rig) -> None:
        rig.open()
        rig.order(Order.CLOSE)
        rig.wait(0.5, alive=[TUNER_NODE])
        rig.wait(3.0)
        assert Emcy.TUNER_LOST not in rig.emergencies(CONTROLLER)

    def test_relay_ends_at_a_pv_limit(self, rig: Rig) -> None:
        rig.open()
        rig.relay(amplitude=40.0, low=49.95, high=50.05)
        rig.run(200)
        assert rig.is_home() and rig.read("controller_relay_state") == RelayState.ENDED_BY_LIMIT
        assert Emcy.PV_LIMIT in rig.emergencies(CONTROLLER)


class TestSilence:
    def test_a_silent_pv_brings_the_output_of_home_unasked_and_the_plant_takes_it(self, rig: Rig) -> None:
        rig.under_test()
        home, number = rig.read("controller_home_mv"), rig.plant.number
        assert rig.read("plant_mv") != home
        rig.wire.frames.clear()
        rig.wait(0.9, alive=[TUNER_NODE])
        assert rig.wire.sent(IDS.mv) == []
        rig.wait(0.3, alive=[TUNER_NODE])
        assert rig.wire.sent(IDS.mv) == [MV_FRAME.pack(home, UNASKED)]
        assert rig.is_home() and rig.read("controller_cause") == Cause.NO_PV
        assert (rig.read("plant_mv"), rig.plant.number) == (pytest.approx(home, rel=1e-6), number)
        assert rig.read("controller_pv_valid") == 0 and Emcy.NO_PV in rig.emergencies(CONTROLLER)

    def test_a_session_closed_while_nothing_moves_brings_it_too(self, rig: Rig) -> None:
        rig.under_test()
        home = rig.read("controller_home_mv")
        rig.wire.frames.clear()
        rig.order(Order.CLOSE)
        assert rig.wire.sent(IDS.mv) == []
        rig.wait(1.2)
        assert rig.wire.sent(IDS.mv) == [MV_FRAME.pack(home, UNASKED)]

    def test_samples_that_go_on_are_answered_and_nothing_is_sent_unasked(self, rig: Rig) -> None:
        rig.under_test()
        rig.order(Order.CLOSE)
        rig.wire.frames.clear()
        rig.run(3)
        rig.wait(3.0)
        assert len(rig.wire.sent(IDS.mv)) == 3

    def test_of_two_channels_the_one_that_is_silent_goes_home(self) -> None:
        rig = Rig(channels=2)
        rig.run(3)
        for sub in (1, 2):
            rig.open(sub=sub)
            rig.relay(sub=sub)
        for n in range(12):
            rig.client.send(channel_ids(2).pv, PV_FRAME.pack(50.0, 100 + n))
            rig.wait(0.1, alive=[TUNER_NODE])
        assert [rig.read("controller_session_is_open", sub) for sub in (1, 2)] == [0, 1]


def test_the_orders_objects_are_where_the_profile_says() -> None:
    assert [lookup(object_of(order)).index for order in Order] == list(range(0x2170, 0x217A))
