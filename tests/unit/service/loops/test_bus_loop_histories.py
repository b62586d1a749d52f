"""Ways in which a loop once did not end safe: now it is home, or as another's hand has left it."""

from __future__ import annotations

import contextlib
import random
from collections.abc import Callable

import pytest

from loopwright.controller.channel import Mode as ControllerMode
from loopwright.controller.pid import Parameters
from loopwright.protocol.profile import (
    CONTROLLER_NODE,
    HEARTBEAT_FRAME,
    PLANT_NODE,
    TUNER_NODE,
    Cause,
    NmtCommand,
    NmtState,
    heartbeat_id,
    sdo_request_id,
)
from loopwright.service.loops.loop import Restored
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Command, Mode, SetGains, SetMode, SetOutput, SetSetpoint
from loopwright.tuning.reasons import Aborted, Ended, Failed, Reason, Refused
from tests.unit.service.bus_site import NEW, RELAY, Killed, Site

OLD = Gains(200.0, 12.0)
BY_HAND = ControllerMode.MANUAL
OVER_S = 1.7
"""A session whose tuner is silent is over then: it watches for 1.5 s."""
MOVES: dict[str, tuple[Command, ...]] = {
    "set-point": (SetSetpoint(50.25),),
    "gains": (SetGains(NEW), SetSetpoint(50.25)),
    "manual": (SetMode(Mode.MANUAL), SetOutput(60.0)),
    "relay": (RELAY, SetMode(Mode.EXPERIMENT)),
}
EACH_MOVE = pytest.mark.parametrize("move", MOVES)


def under_test(site: Site, move: str, samples: int = 5) -> tuple[object, int]:
    home, number = site.begun()
    for commands in (MOVES[move], *[()] * samples):
        site.loop.step(commands)
    return home, number


def calls_of(move: str) -> int:
    """On the bus, of the way out."""
    site = Site()
    home, _ = under_test(site, move)
    before = site.gateway.calls
    site.loop.restore(home)  # type: ignore[arg-type]
    return site.gateway.calls - before


CALLS = {move: calls_of(move) for move in MOVES}


def moments(move: str, first: int = 1) -> list[int]:
    """Calls of the way out at which to strike: all of the closing, then some of the reading back."""
    calls = CALLS[move]
    return [*range(first, 24, 3), *range(24 + 5 * first, calls + 1, 32)]


class TestKills:
    @EACH_MOVE
    def test_two_in_a_row_leave_nothing_of_the_test(self, move: str) -> None:
        """The second one in every call of the way out; the third gateway finds the loop at home, and nobody's hand."""
        for call in moments(move):
            site = Site()
            home, number = under_test(site, move)
            site.gateway.dead = True
            again, loop = site.another()
            again.kill_at(call)
            with contextlib.suppress(Killed):
                loop.restore(home, number)  # type: ignore[arg-type]
            third, last = site.another()
            restored = last.restore(home, number)  # type: ignore[arg-type]
            assert restored.changed == {}, (call, restored)
            assert site.is_home(), call
            assert not third.dead

    @pytest.mark.parametrize("pace", [0.0, 1.0], ids=["in blocks", "in real time"])
    def test_one_at_any_call_is_home_within_the_watch(self, pace: float) -> None:
        whole = Site(pace)
        under_test(whole, "relay")
        for call in range(1, whole.gateway.calls + 1, 11):
            site = Site(pace)
            site.gateway.kill_at(call)
            with contextlib.suppress(Killed):
                under_test(site, "relay")
            site.pass_time(OVER_S)
            assert site.is_home(), call

    def test_one_while_the_bus_is_away_for_the_recovery(self) -> None:
        site = Site()
        home, number = under_test(site, "gains")
        site.gateway.dead = True
        _, loop = site.another()
        site.lost = OSError(100, "Network is down")
        with pytest.raises(Failed) as caught:
            loop.restore(home, number)  # type: ignore[arg-type]
        assert caught.value.reason is Reason.RESTORE_UNCONFIRMED
        site.lost = None
        assert loop.restore(home, number).changed == {} and site.is_home()  # type: ignore[arg-type]

    def test_an_acceptance_killed_at_any_call_leaves_one_set_or_the_other(self) -> None:
        whole = Site()
        whole.let_run()
        whole.loop.accept(NEW, OLD)
        for call in range(1, whole.gateway.calls + 1, 5):
            site = Site()
            site.let_run()
            site.gateway.kill_at(call)
            with contextlib.suppress(Killed):
                site.loop.accept(NEW, OLD)
            site.pass_time(OVER_S)
            assert site.is_home() and site.channel.accepted.Kp in (200.0, 150.0), call
            _, again = site.another()
            assert again.accept(NEW, OLD).gains == NEW


class TestLateFrames:
    @EACH_MOVE
    def test_those_of_a_dead_tuner_do_nothing(self, move: str) -> None:
        site = Site()
        under_test(site, move)
        late = [frame for frame in site.gateway.sent if frame[0] == sdo_request_id(CONTROLLER_NODE)]
        site.gateway.dead = True
        site.pass_time(OVER_S)
        assert site.is_home()
        for frame in (*late, *random.Random(1).sample(late, len(late))):
            site.replay(frame)
            assert site.is_home()
        site.pass_time(1.0)
        assert site.is_home()

    @EACH_MOVE
    def test_nor_in_the_session_of_the_next_one(self, move: str) -> None:
        site = Site()
        under_test(site, move)
        late = [frame for frame in site.gateway.sent if frame[0] == sdo_request_id(CONTROLLER_NODE)]
        site.gateway.dead = True
        site.pass_time(OVER_S)
        _, loop = site.another()
        numbers: list[int] = []
        home = loop.begin(note_session=numbers.append)
        for frame in late:
            site.replay(frame)
        c, session = site.channel, site.controller.sessions[0]
        assert (session.number, c.mode, c.setpoint, c.on_trial) == (numbers[-1], ControllerMode.AUTOMATIC, 50.0, False)
        loop.step((SetSetpoint(50.1), SetGains(NEW)))
        assert (c.setpoint, c.in_effect.Kp) == (pytest.approx(50.1), 150.0)
        assert loop.restore(home).changed == {}

    def test_a_late_opening_ends_by_the_watch(self) -> None:
        site = Site()
        site.let_run()
        sent = len(site.gateway.sent)
        with contextlib.suppress(Killed):
            site.gateway.before = lambda call: setattr(
                site.gateway, "dead", "controller_order_open" in [name for name, _ in site.written]
            )
            site.loop.begin()
        assert len(site.gateway.sent) > sent
        site.pass_time(OVER_S)
        assert site.is_home() and site.controller.sessions[0].cause in (Cause.HEARTBEAT, Cause.CLOSED)


class TestForeignGains:
    @pytest.mark.parametrize("name", ["controller_staged_kp", "controller_session_kp"])
    def test_one_staged_during_an_acceptance_is_never_accepted(self, name: str) -> None:
        whole = Site()
        whole.let_run()
        whole.loop.accept(NEW, OLD)
        for call in range(1, whole.gateway.calls + 1, 5):
            site = Site()
            site.let_run()

            def strike(number: int, at: int = call, site: Site = site) -> None:
                if number == at:
                    site.hand(name, 999.0)

            site.gateway.before = strike
            assert site.loop.accept(NEW, OLD).gains == NEW, call
            assert site.is_home() and site.channel.accepted == Parameters(150.0, 9.0)
            assert site.loop.accept(OLD, NEW).gains == OLD, "and can be taken back"

    def test_one_tried_during_a_test_ends_it(self) -> None:
        site = Site()
        home, _ = under_test(site, "gains")
        site.hand("controller_staged_kp", 999.0)
        site.hand("controller_parameter_command", 1)
        with pytest.raises(Aborted) as caught:
            for _ in range(5):
                site.loop.step(())
        assert caught.value.reason is Reason.GAINS_CHANGED
        found = site.loop.restore(home)  # type: ignore[arg-type]
        assert set(found.changed) <= {"gains", "trial"} and site.channel.in_effect.Kp == 999.0


HANDS: dict[str, tuple[str, float, Reason, Callable[[Site], bool]]] = {
    "off": ("controller_mode_command", 0, Reason.MODE_CHANGED, lambda site: site.is_home(mode=ControllerMode.OFF)),
    "manual": ("controller_mode_command", 1, Reason.MODE_CHANGED, lambda site: site.is_home(mode=BY_HAND)),
    "set-point": ("controller_setpoint", 51.0, Reason.SETPOINT_CHANGED, lambda site: site.is_home(51.0)),
    "home's set-point": ("controller_setpoint", 50.0, Reason.SETPOINT_CHANGED, lambda site: site.is_home()),
}
EACH_HAND = pytest.mark.parametrize("hand", HANDS)


class TestOperator:
    @EACH_HAND
    @EACH_MOVE
    @pytest.mark.parametrize("samples", [1, 10, 40])
    def test_a_hand_soon_after_a_command_stands(self, hand: str, move: str, samples: int) -> None:
        name, value, reason, stands = HANDS[hand]
        site = Site()
        home, _ = under_test(site, move, samples)
        site.hand(name, value)
        with pytest.raises(Aborted) as caught:
            for _ in range(5):
                site.loop.step(())
        assert caught.value.reason is reason
        site.loop.restore(home)  # type: ignore[arg-type]
        site.pass_time(5.0)
        assert stands(site)
        if hand == "off":
            assert site.mv == 0.0

    @EACH_HAND
    @EACH_MOVE
    def test_a_hand_at_any_call_of_the_way_out_stands(self, hand: str, move: str) -> None:
        name, value, _, stands = HANDS[hand]
        for call in moments(move, 1 + list(HANDS).index(hand) % 3):
            site = Site()
            home, _ = under_test(site, move)
            at = site.gateway.calls + call

            def strike(number: int, at: int = at, site: Site = site) -> None:
                if number == at:
                    site.hand(name, value)

            site.gateway.before = strike
            restored = site.loop.restore(home)  # type: ignore[arg-type]
            site.pass_time(0.5)
            assert stands(site), call
            self._agrees(restored, site, call)

    @staticmethod
    def _agrees(restored: Restored, site: Site, call: int) -> None:
        """What was read may be older than the hand, and never is anything that nobody has chosen."""
        assert restored.state.mode in (Mode.AUTOMATIC, Mode(site.channel.mode)), call
        assert not restored.state.on_trial and restored.state.gains == OLD

    @EACH_HAND
    def test_a_hand_after_the_tuners_death_is_told_by_the_recovery(self, hand: str) -> None:
        name, value, _, stands = HANDS[hand]
        for wait_s in (0.3, 2.0):
            site = Site()
            home, number = under_test(site, "relay")
            site.gateway.dead = True
            site.pass_time(wait_s)
            site.hand(name, value)
            _, loop = site.another()
            restored = loop.restore(home, number)  # type: ignore[arg-type]
            site.pass_time(1.0)
            assert stands(site)
            expected = {"off": {"mode"}, "manual": {"mode"}, "set-point": {"set-point"}, "home's set-point": set()}
            assert set(restored.changed) == expected[hand]


class TestNodes:
    @EACH_MOVE
    def test_pre_operational_by_a_third_node_leaves_homes_output_and_says_so(self, move: str) -> None:
        site = Site()
        home, number = under_test(site, move)
        left = site.controller.sessions[0].home.mv
        site.nmt(NmtCommand.PRE_OPERATIONAL)
        assert site.mv == pytest.approx(left, rel=1e-6)
        with pytest.raises(Failed) as caught:
            for _ in range(5):
                site.loop.step(())
        assert caught.value.reason is Reason.NODE_NOT_OPERATIONAL
        with pytest.raises(Failed) as caught:
            site.loop.restore(home)  # type: ignore[arg-type]
        assert caught.value.reason is Reason.NODE_NOT_OPERATIONAL
        assert site.mv == pytest.approx(left, rel=1e-6) and site.is_home()
        assert not any(can_id == 0 for can_id, _ in site.gateway.sent), "no NMT command of ours"
        site.nmt(NmtCommand.START)
        site.pass_time(0.5)
        assert site.loop.restore(home, number).changed == {} and site.is_home()  # type: ignore[arg-type]

    @pytest.mark.parametrize("node", [PLANT_NODE, CONTROLLER_NODE, 0], ids=["plant", "controller", "all"])
    @pytest.mark.parametrize("command", [NmtCommand.STOP, NmtCommand.PRE_OPERATIONAL], ids=lambda c: c.name.lower())
    def test_whatever_node_leaves_operational_the_job_says_so(self, node: int, command: NmtCommand) -> None:
        site = Site()
        home, number = under_test(site, "relay")
        site.nmt(command, node)
        with pytest.raises(Failed) as caught:
            for _ in range(5):
                site.loop.step(())
        assert caught.value.reason is Reason.NODE_NOT_OPERATIONAL
        with contextlib.suppress(Ended):
            site.loop.restore(home)  # type: ignore[arg-type]
        site.nmt(NmtCommand.START, 0)
        site.pass_time(1.0)
        _, again = site.another()
        assert again.restore(home, number).changed == {} and site.is_home()  # type: ignore[arg-type]

    @EACH_MOVE
    def test_a_transmitter_that_breaks_leaves_homes_output(self, move: str) -> None:
        site = Site()
        home, _ = under_test(site, move)
        left = site.controller.sessions[0].home.mv
        site.transmitter(works=False)
        with pytest.raises(Failed) as caught:
            for _ in range(30):
                site.loop.step(())
        assert caught.value.reason is Reason.BAD_SAMPLE
        restored = site.loop.restore(home)  # type: ignore[arg-type]
        site.pass_time(0.5)
        assert site.mv == pytest.approx(left, rel=1e-6) == restored.state.mv and site.is_home()

    def test_a_transmitter_that_breaks_just_before_the_way_out(self) -> None:
        site = Site()
        home, _ = under_test(site, "relay")
        left = site.controller.sessions[0].home.mv
        site.transmitter(works=False)
        site.loop.step(())
        site.loop.restore(home)  # type: ignore[arg-type]
        site.pass_time(2.0)
        assert site.mv == pytest.approx(left, rel=1e-6) and site.is_home()


class TestTwoGateways:
    def test_two_tuners_exclude_each_other(self) -> None:
        site = Site()
        under_test(site, "set-point")
        gateway, second = site.another(0x7C)
        session = site.controller.sessions[0]

        def first_lives(call: int) -> None:
            site.replay((heartbeat_id(TUNER_NODE), HEARTBEAT_FRAME.pack(NmtState.OPERATIONAL)))
            session.renew(session.number, site.wire.clock.now)

        gateway.before = first_lives
        with pytest.raises(Refused, match="7Dh") as caught:
            second.begin()
        assert caught.value.reason is Reason.LOOP_IN_USE
        assert (session.is_open, site.channel.setpoint) == (True, 50.25)
        site.loop.step(())

    def test_who_was_held_up_while_another_took_the_loop_is_told_that_its_own_session_is_over(self) -> None:
        site = Site()
        home, number = under_test(site, "set-point")
        site.pass_time(OVER_S)
        _, second = site.another(0x7C)
        theirs = second.begin()
        second.step((SetSetpoint(50.1),))
        with pytest.raises(Failed) as caught:
            site.loop.step((SetSetpoint(50.3),))
        assert caught.value.reason is Reason.SESSION_ENDED_BY_DEVICE
        found = site.loop.restore(home, number)  # type: ignore[arg-type]
        assert "session" in found.changed and site.channel.setpoint == pytest.approx(50.1)
        assert second.restore(theirs).changed == {} and site.is_home()

    @pytest.mark.parametrize("Ts", [0.05, 1.0, 30.0])
    def test_anothers_heartbeat_keeps_no_dead_ones_test_alive(self, Ts: float) -> None:
        site = Site(Ts=Ts)
        under_test(site, "set-point", samples=1)
        site.gateway.dead = True
        site.pass_time(OVER_S, beating=0x7C)
        assert site.is_home() and site.controller.sessions[0].cause is Cause.HEARTBEAT

    def test_nor_does_the_next_one_begin_before_it_is_home(self) -> None:
        site = Site()
        under_test(site, "relay")
        site.gateway.dead = True
        _, second = site.another(0x7C)
        assert (second.begin().sp, site.channel.mode) == (50.0, ControllerMode.AUTOMATIC)

    @pytest.mark.parametrize("pace", [0.0, 1.0], ids=["in blocks", "in real time"])
    def test_who_is_started_again_keeps_its_own_dead_session_alive_by_no_beat(self, pace: float) -> None:
        site = Site(pace)
        under_test(site, "set-point")
        site.gateway.dead = True
        died_at = site.wire.clock.now
        _, again = site.another(TUNER_NODE)
        again.begin()
        assert site.wire.clock.now - died_at < OVER_S + 0.3, "not the lease, which takes 3 s, in blocks 30 s"
