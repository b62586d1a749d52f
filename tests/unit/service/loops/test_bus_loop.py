"""The live loop on devices and a bus in memory: what it asks of the controller, when, and what it makes of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest

from loopwright.controller.channel import Mode as ControllerMode
from loopwright.controller.device import RetainedState
from loopwright.controller.pid import Parameters
from loopwright.protocol.objects import Value
from loopwright.protocol.profile import (
    CONTROLLER_NODE,
    EMCY_FRAME,
    HEARTBEAT_FRAME,
    MV_FRAME,
    PLANT_NODE,
    PV_FRAME,
    TUNER_NODE,
    Cause,
    Emcy,
    NmtCommand,
    NmtState,
    OnMissingAnswer,
    channel_ids,
    emcy_id,
    heartbeat_id,
    node_name,
)
from loopwright.protocol.tuner import RENEWAL_S, TURN_S
from loopwright.service.loops.bus_loop import BusLoop
from loopwright.service.loops.bus_session import CONFIRM_S, LEASE_WALL_S
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Command, Mode, SetGains, SetMode, SetOutput, SetRelay, SetSetpoint
from loopwright.tuning.reasons import Aborted, Ended, Failed, Reason, Refused
from tests.unit.service.bus_site import FOUND, NEW, RELAY, Gateway, Site

RENEWAL = "controller_session_renewal"


@pytest.fixture
def in_blocks() -> Site:
    return Site(pace=0.0)


@pytest.fixture
def site() -> Site:
    return Site()


class TestBeginning:
    def test_opens_a_session_and_gives_home_as_the_controller_has_noted_it(self, site: Site) -> None:
        site.hand("controller_setpoint", 50.25)
        home, number = site.begun()
        session = site.controller.sessions[0]
        assert (session.number, session.holder) == (number, TUNER_NODE)
        assert (home.mode, home.sp, home.gains) == (Mode.AUTOMATIC, 50.25, Gains(200.0, 12.0))
        assert home.node_state == "operational"
        assert home.mv == pytest.approx(session.home.mv, rel=1e-6)

    def test_the_number_is_written_down_before_the_opening(self, site: Site) -> None:
        site.let_run()
        seen: list[tuple[int, bool]] = []
        site.loop.begin(note_session=lambda number: seen.append((number, site.controller.sessions[0].is_open)))
        assert len(seen) == 1 and seen[0][0] and not seen[0][1]

    def test_tells_what_the_plant_does_when_the_controller_falls_silent(self, site: Site) -> None:
        for reaction, words in ((OnMissingAnswer.STOP_RUN, "stops its run"), (OnMissingAnswer.SAFE_OUTPUT, "of 50 %")):
            site.plant.dictionary.set("plant_on_missing_answer", reaction)
            assert words in site.loop.read().fail_action

    @pytest.mark.parametrize("device", ["controller", "plant"])
    def test_versions_that_differ_are_named_on_both_sides(self, site: Site, device: str) -> None:
        getattr(site, device).dictionary.set("identity", 0x00010003, 3)
        with pytest.raises(Refused, match=rf"{device} node .*revision 1\.3 .*this service 3\.0") as caught:
            site.loop.begin()
        assert caught.value.reason is Reason.DEVICE_MISMATCH
        assert site.names() == []

    def test_a_plant_with_another_sample_time_is_refused(self, site: Site) -> None:
        site.plant.dictionary.set("sample_time", 50_000)
        with pytest.raises(Refused, match=r"0\.1 s.*0\.05 s"):
            site.loop.begin()

    @pytest.mark.parametrize("node", [CONTROLLER_NODE, PLANT_NODE])
    def test_a_node_that_is_not_operational_is_named(self, site: Site, node: int) -> None:
        site.nmt(NmtCommand.PRE_OPERATIONAL, node)
        with pytest.raises(Failed, match=rf"{node:02X}h \({node}\) is pre-operational") as caught:
            site.loop.begin()
        assert caught.value.reason is Reason.NODE_NOT_OPERATIONAL
        assert site.loop.read().node_state == f"node {node_name(node)} is pre-operational"

    def test_a_stopped_controller_answers_no_sdo_and_is_named_all_the_same(self, site: Site) -> None:
        site.loop.read()
        site.nmt(NmtCommand.STOP)
        site.pass_time(1.0)
        with pytest.raises(Failed) as caught:
            site.loop.read()
        assert caught.value.reason is Reason.NODE_NOT_OPERATIONAL

    @pytest.mark.parametrize("node", [CONTROLLER_NODE, PLANT_NODE])
    def test_a_node_that_beats_and_answers_no_sdo_is_not_called_silent(self, site: Site, node: int) -> None:
        device = site.controller if node == CONTROLLER_NODE else site.plant
        site.let_run()
        device.runtime.sdo.answer = lambda *args: None  # type: ignore[method-assign]
        with pytest.raises(Failed, match=rf"{node:02X}h \({node}\) does not answer .*its heartbeat is heard") as caught:
            site.loop.begin()
        assert caught.value.reason is Reason.NODE_NOT_ANSWERING

    def test_a_trial_by_hand_is_nobody_elses_to_end(self, site: Site) -> None:
        site.let_run()
        site.hand("controller_staged_kp", 99.0)
        site.hand("controller_parameter_command", 1)
        with pytest.raises(Refused, match="tries other gains by hand") as caught:
            site.loop.begin()
        assert caught.value.reason is Reason.GAINS_CHANGED
        assert site.channel.in_effect.Kp == 99.0

    def test_a_set_point_that_an_rpdo_drives_is_not_tuned_against(self, site: Site) -> None:
        site.let_run()
        for value in (b"\x00\x00\x48\x42", b"\x00\x00\x4c\x42"):  # 50, 51
            site.replay((channel_ids(1).command, value))
        with pytest.raises(Refused) as caught:
            site.loop.begin()
        assert caught.value.reason is Reason.SETPOINT_IS_DRIVEN
        assert not site.controller.sessions[0].is_open

    def test_another_gateway_with_our_node_id_is_refused(self, site: Site) -> None:
        site.let_run()
        gateway = Gateway(site, listen_s=2.0)
        gateway.before = lambda call: site.replay((heartbeat_id(TUNER_NODE), b"\x05"))
        with pytest.raises(Refused, match="--node") as caught:
            site.tuner(gateway).begin()
        assert caught.value.reason is Reason.LOOP_IN_USE

    def test_1016h_stays_the_installers(self, site: Site) -> None:
        site.controller.dictionary.set("heartbeat_consumer", 0x00550064, 1)
        home, _ = site.begun()
        site.loop.step((SetSetpoint(50.1),))
        site.loop.restore(home)
        site.loop.accept(NEW, home.gains)
        assert "heartbeat_consumer" not in site.names()
        assert site.controller.dictionary.get("heartbeat_consumer", 1) == 0x00550064


class TestLease:
    def test_is_confirmed_before_commands_are_sent(self, in_blocks: Site) -> None:
        loop = in_blocks.loop
        loop.begin()
        in_blocks.names()
        for _ in range(100):
            loop.step(())
        assert in_blocks.names() == [], "renewals wait for no answer"
        loop.session.confirmed_at -= CONFIRM_S
        loop.step((SetSetpoint(50.1),))
        assert in_blocks.names() == [RENEWAL, "controller_session_setpoint", "controller_order_setpoint"]

    @pytest.mark.parametrize("commands", [(RELAY, SetMode(Mode.EXPERIMENT)), (SetGains(NEW),)], ids=str)
    def test_is_paid_between_writes_that_take_long(self, site: Site, commands: Sequence[Command]) -> None:
        """As many loops that ask one node make them."""
        site.begun()
        paid = site.wire.clock.now
        site.names()
        site.slow_s = 0.45
        site.loop.step(commands)
        site.slow_s = 0.0
        written = site.written
        assert written[-1][1] - paid > LEASE_WALL_S and RENEWAL not in dict(written)
        site.pass_time(0.01)
        assert site.controller.sessions[0].is_open

    def test_is_paid_while_others_have_their_turn_with_the_node(self, site: Site) -> None:
        """An SDO server answers one at a time, and who waits for it is alive."""
        site.begun()
        turn = site.gateway.sdo_lock("wire", CONTROLLER_NODE).take()
        turn.__enter__()
        began_at = site.wire.clock.now

        def others() -> float:
            site.pass_time(0.2)
            if site.wire.clock.now - began_at > 2 * LEASE_WALL_S:
                site.gateway.monotonic = site.wire.clock
                turn.__exit__(None, None, None)
            return site.wire.clock.now

        site.gateway.monotonic = others
        site.loop.step((SetSetpoint(50.1),))
        assert site.wire.clock.now - began_at > 2 * LEASE_WALL_S
        assert site.controller.sessions[0].is_open and site.channel.setpoint == pytest.approx(50.1)

    def test_is_paid_no_longer_where_whoever_has_the_turn_hangs(self, site: Site) -> None:
        site.begun()
        turn = site.gateway.sdo_lock("wire", CONTROLLER_NODE).take()
        turn.__enter__()
        began_at = site.wire.clock.now

        def others() -> float:
            site.pass_time(0.2)
            if not site.controller.sessions[0].is_open:
                site.gateway.monotonic = site.wire.clock
                turn.__exit__(None, None, None)
            return site.wire.clock.now

        site.gateway.monotonic = others
        with pytest.raises(Failed) as caught:
            site.loop.step((SetSetpoint(50.1),))
        assert caught.value.reason is Reason.SESSION_ENDED_BY_DEVICE and site.channel.setpoint == 50.0
        assert TURN_S < site.wire.clock.now - began_at < TURN_S + LEASE_WALL_S

    def test_an_abort_does_not_wait_for_the_turn(self, site: Site) -> None:
        wanted: list[Reason] = []
        site.let_run()
        home = site.loop.begin(lambda: wanted[0] if wanted else None)
        turn = site.gateway.sdo_lock("wire", CONTROLLER_NODE).take()
        turn.__enter__()
        wanted.append(Reason.OPERATOR)
        with pytest.raises(Aborted, match="had their turn"):
            site.loop.step((SetSetpoint(50.1),))
        turn.__exit__(None, None, None)
        site.loop.restore(home)
        assert site.is_home() and not site.controller.sessions[0].is_open

    def test_an_end_whose_status_was_lost_is_told_again(self, site: Site) -> None:
        """A renewal of a session that is over has an answer all the same."""
        site.begun()
        site.controller.sessions[0].end(Cause.LEASE)
        site.controller.told[0] = site.controller.told[0] and (*site.controller.told[0][:3], False, Cause.LEASE)
        began_at = site.wire.clock.now
        with pytest.raises(Failed, match="cause: lease"):
            while True:
                site.loop.step(())
        assert site.wire.clock.now - began_at < 2 * RENEWAL_S

    def test_says_how_long_it_was_not_paid_when_it_is_used_up(self, site: Site) -> None:
        """A thread that computes for four seconds, while other loops of this process send its heartbeat."""
        site.begun()
        site.loop.step(())
        site.pass_time(4.0, beating=TUNER_NODE)
        with pytest.raises(Failed, match=r"cause: lease\); at most 4\.[0-5] s passed between two renewals"):
            for _ in range(100):
                site.loop.step(())

    def test_is_paid_while_home_is_read_beside_many_others(self, site: Site) -> None:
        """Thirty answers, for each of which a loop may have to wait for fifty others that begin, too."""
        site.slow_s = 0.2
        began_at = site.wire.clock.now
        _, number = site.begun()
        assert site.wire.clock.now - began_at > 2 * LEASE_WALL_S
        site.loop.step(())
        assert site.controller.sessions[0].is_open and site.loop.session.number == number

    def test_of_a_session_that_has_ended_is_not_paid(self, in_blocks: Site) -> None:
        in_blocks.loop.begin()
        in_blocks.controller.sessions[0].end(Cause.LEASE)
        with pytest.raises(Failed, match="cause: lease") as caught:
            for _ in range(100):
                in_blocks.loop.step(())
        assert caught.value.reason is Reason.SESSION_ENDED_BY_DEVICE

    def test_is_paid_while_a_slow_sample_is_waited_for(self) -> None:
        site = Site(Ts=60.0)
        site.begun()
        began = site.wire.clock.now
        for _ in range(3):
            site.loop.step(())
        assert site.wire.clock.now - began > 100.0 and site.controller.sessions[0].is_open


class TestWaiting:
    def test_at_a_slow_sample_time_an_abort_is_heard_at_once(self) -> None:
        site = Site(Ts=60.0)
        site.let_run()
        asked_at = 0.0

        def stop() -> Reason | None:
            return Reason.OPERATOR if asked_at and site.wire.clock.now > asked_at else None

        site.loop.begin(stop)
        site.loop.step(())
        asked_at = site.wire.clock.now + 5.0
        with pytest.raises(Aborted) as caught:
            site.loop.step(())
        assert caught.value.reason is Reason.OPERATOR
        assert site.wire.clock.now - asked_at < 0.2

    def test_a_plant_that_another_test_runs_in_blocks_is_waited_for_until_somebody_asks_to_stop(
        self, in_blocks: Site
    ) -> None:
        held, asked = in_blocks.gateway.plant_lock("wire", PLANT_NODE), 0

        def stop() -> Reason | None:
            nonlocal asked
            asked += 1
            return Reason.SERVICE_STOPPED if asked > 2 else None

        with held, pytest.raises(Aborted, match="another test was using plant node 10h"):
            in_blocks.loop.begin(stop)
        assert not in_blocks.controller.sessions[0].is_open
        assert in_blocks.loop.begin().mode is Mode.AUTOMATIC

    def test_a_plant_that_does_not_come_to_a_halt_is_waited_for_until_somebody_asks_to_stop(
        self, in_blocks: Site
    ) -> None:
        gateway, number = in_blocks.gateway, 0

        def samples(call: int) -> None:
            nonlocal number
            in_blocks.wire.clock.now += 0.001
            if in_blocks.wire.buses[-1].queue:
                return
            number += 1
            in_blocks.replay((channel_ids(1).pv, PV_FRAME.pack(50.0, number)))
            in_blocks.replay((channel_ids(1).mv, MV_FRAME.pack(50.0, number)))

        gateway.before = samples
        with pytest.raises(Aborted, match="brought to a halt"):
            in_blocks.loop.begin(lambda: Reason.OPERATOR if number > 100 else None)
        assert not gateway.plant_lock("wire", PLANT_NODE).locked(), "the plant was given back"

    def test_a_plant_that_runs_again_while_it_is_halted_is_told_once_more(self, in_blocks: Site) -> None:
        gateway, number, told = in_blocks.gateway, 0, 0
        written = in_blocks.plant.dictionary.on_write["plant_samples_to_run"]

        def tell(sub: int, value: Value) -> None:
            nonlocal told
            told += 1
            written(sub, value)

        def samples(call: int) -> None:
            nonlocal number
            in_blocks.wire.clock.now += 0.001
            if told != 1 or in_blocks.wire.buses[-1].queue:
                return
            number += 1
            in_blocks.replay((channel_ids(1).pv, PV_FRAME.pack(50.0, number)))
            in_blocks.replay((channel_ids(1).mv, MV_FRAME.pack(50.0, number)))

        in_blocks.plant.dictionary.on_write["plant_samples_to_run"] = tell
        gateway.before = samples
        in_blocks.loop.begin()
        assert told == 2 and number

    def test_samples_that_a_plant_at_full_speed_has_left_do_not_count_as_running_on(self, in_blocks: Site) -> None:
        """A service that is slow, because its only processor is busy, still finds the plant halted."""
        gateway, left = in_blocks.gateway, 20_000
        written = in_blocks.plant.dictionary.on_write["plant_samples_to_run"]

        def tell(sub: int, value: Value) -> None:
            written(sub, value)
            for number in range(left):
                in_blocks.replay((channel_ids(1).pv, PV_FRAME.pack(50.0, number % 0x10000)))
                in_blocks.replay((channel_ids(1).mv, MV_FRAME.pack(50.0, number % 0x10000)))
            in_blocks.plant.dictionary.on_write["plant_samples_to_run"] = written

        def slow(call: int) -> None:
            in_blocks.wire.clock.now += 0.0005

        in_blocks.plant.dictionary.on_write["plant_samples_to_run"] = tell
        gateway.before = slow
        assert in_blocks.loop.begin().mode is Mode.AUTOMATIC

    def test_what_is_read_during_anothers_test_is_what_that_comes_back_to(self, site: Site) -> None:
        site.begun()
        site.loop.step((SetSetpoint(50.2), SetGains(NEW)))
        _, second = site.another(0x7C)
        found = second.read(beside_tests=True)
        assert (found.sp, found.mode, found.on_trial) == (50.0, Mode.AUTOMATIC, False)
        assert second.read().on_trial, "who looks on sees the test"

    def test_another_tuners_session_is_waited_for_until_somebody_asks_to_stop(self, site: Site) -> None:
        site.begun()
        _, second = site.another(0x7C)
        with pytest.raises(Aborted, match="another tuner held the loop"):
            second.begin(lambda: Reason.OPERATOR)


class TestSamples:
    @pytest.mark.parametrize("pace", [0.0, 1.0], ids=["in blocks", "in real time"])
    def test_go_on_over_the_wrap_of_their_number(self, pace: float) -> None:
        site = Site(pace)
        site.let_run()
        site.plant.number = 0xFFFFFFF0
        site.loop.begin()
        samples = [site.loop.step(()) for _ in range(40)]
        assert [round(sample.t, 6) for sample in samples] == [round(0.1 * n, 6) for n in range(40)]
        assert site.plant.number < 100

    def test_of_a_plant_that_has_started_anew_are_lost(self, site: Site) -> None:
        site.begun()
        for _ in range(20):
            site.loop.step(())
        site.plant.number = 2
        with pytest.raises(Failed, match="started anew") as caught:
            site.loop.step(())
        assert caught.value.reason is Reason.SAMPLES_LOST

    def test_a_plant_that_is_gone_is_named_though_the_controller_has_ended_the_test(self, site: Site) -> None:
        site.begun()
        site.plant.runtime.poll = lambda idle_s=0.0: False  # type: ignore[method-assign, assignment]
        with pytest.raises(Failed, match=r"node 10h \(16\) does not answer") as caught:
            for _ in range(30):
                site.loop.step(())
        assert caught.value.reason is Reason.NODE_LOST


class TestCommands:
    def test_what_a_relay_has_already_is_not_written_again(self, in_blocks: Site) -> None:
        loop = in_blocks.loop
        loop.begin()
        loop.step((RELAY, SetMode(Mode.EXPERIMENT)))
        first = [name for name in in_blocks.names() if name.startswith("controller_relay_")]
        assert len(first) == len(set(first)) >= 8
        for _ in range(9):
            loop.step(())
        loop.step((replace(RELAY, amplitude=6.0),))
        assert in_blocks.names() == ["controller_relay_amplitude", "controller_order_relay"]

    def test_each_does_what_it_says_in_the_sample_after_it(self, site: Site) -> None:
        site.begun()
        sample = site.loop.step((SetSetpoint(50.25), SetGains(NEW)))
        assert (sample.sp, site.channel.in_effect.Kp, site.channel.on_trial) == (50.25, 150.0, True)
        assert site.loop.step((SetMode(Mode.MANUAL), SetOutput(55.0))).mode == Mode.MANUAL
        assert site.loop.step(()).mv == 55.0
        assert site.loop.step((RELAY, SetMode(Mode.EXPERIMENT))).mode == Mode.EXPERIMENT
        assert {site.loop.step(()).mv for _ in range(5)} <= {45.0, 55.0}

    @pytest.mark.parametrize("limits", [None, (49.0, 51.5)], ids=["the span", "the job's"])
    def test_the_relays_pv_limits_are_the_jobs(self, site: Site, limits: tuple[float, float] | None) -> None:
        site.let_run()
        loop = site.tuner(Gateway(site), limits)
        loop.begin()
        loop.step((RELAY, SetMode(Mode.EXPERIMENT)))
        relay = site.channel.relay
        assert relay is not None
        assert (relay.settings.pv_low, relay.settings.pv_high) == (limits or (40.0, 60.0))

    def test_a_pv_that_leaves_them_ends_the_test(self, site: Site) -> None:
        site.let_run()
        loop = site.tuner(Gateway(site), (49.999, 50.001))
        home = loop.begin()
        with pytest.raises(Failed) as caught:
            for commands in ((RELAY, SetMode(Mode.EXPERIMENT)), *[()] * 200):
                loop.step(commands)
        assert caught.value.reason is Reason.PV_LIMIT
        assert loop.restore(home).changed == {} and site.is_home()

    @pytest.mark.parametrize("command", [SetOutput(150.0), SetGains(Gains(0.0)), SetRelay(0.0, 0.0, 50.0)], ids=str)
    def test_what_the_controller_refuses_is_said(self, site: Site, command: Command) -> None:
        home, _ = site.begun()
        with pytest.raises(Refused, match="controller refused") as caught:
            site.loop.step((command,))
        assert caught.value.reason is Reason.BAD_INPUT
        assert site.loop.restore(home).changed == {} and site.is_home()


class TestRestoring:
    def test_closes_the_session_and_reads_the_loop_back(self, site: Site) -> None:
        home, _ = site.begun()
        site.loop.step((SetSetpoint(50.25), SetGains(NEW)))
        restored = site.loop.restore(home)
        assert (restored.how, restored.changed) == ("the session was closed", {})
        assert (restored.state.mode, restored.state.sp, restored.state.gains) == (home.mode, home.sp, home.gains)
        assert site.is_home() and site.controller.sessions[0].cause is Cause.CLOSED

    def test_works_for_a_loop_whose_plant_has_no_node(self, site: Site) -> None:
        site.let_run()
        loop = BusLoop("wire", CONTROLLER_NODE, None, station=Gateway(site))
        home = loop.begin()
        loop.step((SetSetpoint(50.25),))
        assert loop.restore(home).changed == {} and site.is_home()

    def test_works_while_the_plant_is_silent(self, site: Site) -> None:
        home, _ = site.begun()
        site.loop.step((RELAY, SetMode(Mode.EXPERIMENT)))
        site.plant.runtime.poll = lambda idle_s=0.0: False  # type: ignore[method-assign, assignment]
        restored = site.loop.restore(home)
        assert "node 10h (16) is silent" in restored.state.node_state and site.is_home()

    @pytest.mark.parametrize("name", Gains.__dataclass_fields__)
    def test_all_six_gains_are_compared(self, site: Site, name: str) -> None:
        home, _ = site.begun()
        site.loop.restore(home)
        site.channel.accept(replace(FOUND, **{name: getattr(FOUND, name) + 0.5}))
        found = site.loop.restore(home, session=0)
        assert set(found.changed) == {"gains"}

    def test_what_differs_by_nobodys_hand_is_not_confirmed(self, site: Site) -> None:
        home, _ = site.begun()
        site.loop.step(())
        site.gateway.before = lambda call: setattr(site.channel, "setpoint", 51.0)
        with pytest.raises(Failed, match="set-point is 51, was 50") as caught:
            site.loop.restore(home)
        assert caught.value.reason is Reason.RESTORE_UNCONFIRMED

    @pytest.mark.parametrize("kept", [True, False], ids=["kept", "forgotten"])
    def test_a_controller_that_was_restarted_is_told(self, site: Site, kept: bool) -> None:
        home, _ = site.begun()
        site.loop.step((SetSetpoint(50.25),))
        site.nmt(NmtCommand.RESET_NODE)
        with pytest.raises(Ended):
            for _ in range(50):
                site.loop.step(())
        restored = site.loop.restore(home)
        assert "restarted" in restored.how and restored.changed == {}

    def test_tries_again_until_the_bus_is_back(self, site: Site) -> None:
        home, _ = site.begun()
        site.loop.step((SetSetpoint(50.25),))
        site.lost, back_at = OSError(19, "No such device"), site.wire.clock.now + 2.0
        sleep = site.gateway.sleep

        def until_it_is_back(seconds: float) -> None:
            sleep(seconds)
            if site.wire.clock.now > back_at:
                site.lost = None

        site.gateway.sleep = until_it_is_back
        assert site.loop.restore(home).changed == {} and site.is_home()

    def test_an_interface_that_disappears_is_a_lost_bus(self, site: Site) -> None:
        """The kernel says so at whatever call comes next; not each is one that the bus layer has a word for."""
        site.begun()
        site.lost = OSError(19, "No such device")
        with pytest.raises(Failed, match=r"No such device.*interface") as caught:
            site.loop.step(())
        assert caught.value.reason is Reason.BUS_LOST

    @pytest.mark.parametrize("way", ["job", "acceptance"])
    def test_a_loop_let_go_is_no_emergency(self, site: Site, way: str) -> None:
        if way == "job":
            home, _ = site.begun()
            site.loop.step(())
            site.loop.restore(home)
        else:
            site.let_run()
            site.loop.accept(NEW, Gains(200.0, 12.0))
        beats = len(site.wire.sent(heartbeat_id(TUNER_NODE)))
        site.pass_time(3.0)
        assert site.wire.sent(emcy_id(CONTROLLER_NODE)) == []
        assert len(site.wire.sent(heartbeat_id(TUNER_NODE))) == beats


class TestTwoChannels:
    def test_a_pv_limit_has_its_name_while_another_channel_stands_at_one(self) -> None:
        site = Site(channels=2)
        site.let_run()
        one = site.tuner(Gateway(site, 0x7C), (49.999, 50.001))
        two = site.tuner(Gateway(site), channel=2)
        one.begin()
        two.begin()
        two.step((RELAY, SetMode(Mode.EXPERIMENT)))
        with pytest.raises(Failed):
            for commands in ((RELAY, SetMode(Mode.EXPERIMENT)), *[()] * 100):
                one.step(commands)
                two.step(())
        assert Emcy.PV_LIMIT in [EMCY_FRAME.unpack(data)[0] for data in site.wire.sent(emcy_id(CONTROLLER_NODE))]
        assert two.step(()).mode == Mode.EXPERIMENT


class Full:
    """A storage without room; `lose` does something besides."""

    def __init__(self, error: BaseException) -> None:
        self.error = error
        self.on_now = lambda: None

    def write_now(self, channels: Sequence[RetainedState]) -> None:
        self.on_now()
        raise self.error

    def write_soon(self, channels: Sequence[RetainedState]) -> None: ...


class TestAccepting:
    OLD = Gains(200.0, 12.0)

    def test_leaves_nothing_behind(self, site: Site) -> None:
        site.let_run()
        site.hand("controller_mode_command", ControllerMode.MANUAL)
        site.hand("controller_manual_output", 43.0)
        assert site.loop.accept(NEW, self.OLD).gains == NEW
        beats = len(site.wire.sent(heartbeat_id(TUNER_NODE)))
        site.pass_time(10.0)
        assert site.channel.accepted.Kp == 150.0 and site.is_home(mode=ControllerMode.MANUAL)
        assert site.mv == 43.0 and len(site.wire.sent(heartbeat_id(TUNER_NODE))) == beats

    def test_twice_is_once(self, site: Site) -> None:
        for _ in range(2):
            assert site.loop.accept(NEW, self.OLD).gains == NEW

    def test_does_not_move_the_output(self, site: Site) -> None:
        site.let_run()
        mv = site.mv
        site.loop.accept(NEW, self.OLD)
        site.pass_time(0.3)
        assert site.mv == pytest.approx(mv, abs=0.1)

    def test_refuses_where_somebody_has_changed_the_gains(self, site: Site) -> None:
        site.let_run()
        site.channel.accept(Parameters(99.0, 12.0))
        with pytest.raises(Refused, match="the gains were changed meanwhile") as caught:
            site.loop.accept(NEW, self.OLD)
        assert caught.value.reason is Reason.GAINS_CHANGED
        assert site.channel.accepted.Kp == 99.0 and site.is_home()

    def test_what_the_controller_cannot_keep_does_not_stay(self, site: Site) -> None:
        site.let_run()
        site.controller.retained_store = Full(OSError(28, "No space left on device"))
        with pytest.raises(Refused, match="could not store it"):
            site.loop.accept(NEW, self.OLD)
        assert site.channel.accepted == FOUND and site.is_home()

    def test_one_whose_answer_was_lost_is_one(self, site: Site) -> None:
        site.let_run()
        number = 0

        def lose_answers(call: int) -> None:
            nonlocal number
            if "controller_order_accept" in [name for name, _ in site.written] and number < 3:
                number += 1
                for bus in site.wire.buses:
                    if hasattr(bus, "gateway"):
                        bus.queue.clear()

        site.gateway.before = lose_answers
        assert site.loop.accept(NEW, self.OLD).gains == NEW
        assert site.is_home() and site.channel.accept_count == 1

    def test_keeps_its_hands_off_a_loop_that_another_tunes(self, site: Site) -> None:
        site.begun()
        site.loop.step((SetGains(Gains(80.0, 5.0)),))
        gateway, second = site.another(0x7C)

        def first_lives(call: int) -> None:
            site.replay((heartbeat_id(TUNER_NODE), HEARTBEAT_FRAME.pack(NmtState.OPERATIONAL)))
            site.controller.sessions[0].renew(site.controller.sessions[0].number, site.wire.clock.now)

        gateway.before = first_lives
        with pytest.raises(Refused, match=r"7Dh \(125\) holds a session") as caught:
            second.accept(NEW, self.OLD)
        assert caught.value.reason is Reason.LOOP_IN_USE
        assert site.channel.on_trial and site.channel.in_effect.Kp == 80.0

    def test_is_made_while_the_plant_stands_still(self, in_blocks: Site) -> None:
        assert in_blocks.loop.accept(NEW, self.OLD).gains == NEW and in_blocks.is_home()

    def test_tries_to_end_its_session_until_the_bus_is_back(self, site: Site) -> None:
        site.let_run()
        full = Full(OSError(28, "No space left on device"))
        full.on_now = lambda: setattr(site, "lost", OSError(19, "No such device"))
        site.controller.retained_store = full
        sleep, tries = site.gateway.sleep, 0

        def soon_back(seconds: float) -> None:
            nonlocal tries
            tries += 1
            sleep(seconds)
            if tries > 10:
                site.lost = None

        site.gateway.sleep = soon_back
        with pytest.raises(Refused, match="could not store it"):
            site.loop.accept(NEW, self.OLD)
        assert tries > 10
        assert site.channel.accepted == FOUND and site.is_home()


class TestTelling:
    """What is said of a loop after a test is what the controller holds."""

    def test_a_trial_by_hand_is_told(self, site: Site) -> None:
        home, _ = site.begun()
        site.hand("controller_staged_kp", 99.0)
        site.hand("controller_parameter_command", 1)
        restored = site.loop.restore(home)
        assert restored.state.on_trial and "trial" in restored.changed

    def test_an_opening_that_is_refused_leaves_no_session_to_look_after(self, site: Site) -> None:
        told: list[int] = []
        site.let_run()
        for value in (b"\x00\x00\x48\x42", b"\x00\x00\x4c\x42"):  # 50, 51
            site.replay((channel_ids(1).command, value))
        with pytest.raises(Refused) as caught:
            site.loop.begin(note_session=told.append)
        assert caught.value.reason is Reason.SETPOINT_IS_DRIVEN
        assert told[0] > 0 and told[-1] == 0
