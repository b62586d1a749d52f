"""The live loop: a controller and its plant on a CAN bus.

The session (`bus_session`) belongs to the controller: this module opens and closes it, and `bus_restore` reads the loop
back. Every wait for a sample (`bus_samples`) or an answer also sends the heartbeat and renews the lease: a service that
hangs or dies loses the session, and the controller itself restores the loop.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import astuple

from loopwright.protocol.profile import Order
from loopwright.protocol.station import Station
from loopwright.protocol.tuner import Tuner
from loopwright.service.loops.bus_connection import BusConnection, Read
from loopwright.service.loops.bus_reading import BusReading
from loopwright.service.loops.bus_restore import LOSSY_BUS_S, close_session, end_acceptance, hold, restore
from loopwright.service.loops.bus_samples import BLOCK, MAX_GAP, BusSamples
from loopwright.service.loops.bus_session import BusSession
from loopwright.service.loops.loop import Restored
from loopwright.service.states.loop_state import LoopState, same_gains
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import (
    Command,
    Mode,
    Sample,
    SetGains,
    SetMode,
    SetOutput,
    SetPvLimits,
    SetRelay,
    SetSetpoint,
)
from loopwright.tuning.reasons import Aborted, Ended, Failed, Reason, Refused

BEGIN_PATIENCE_S = 2.0
"""Wall time for which a node may leave a request unanswered before anything has moved, s: a gateway with one processor
has other work while a test begins."""
RELAY_LONGEST = 1_000_000  # samples; plans end their relays, and so does the lease


class BusLoop:
    """One channel of a controller node.

    plant_node: node-ID of the plant I/O, if it can be asked (a simulated one can).
    station: this process on the bus.
    pv_limits: limits at which the controller ends the relay, PV units; None for the PV span.
    block: samples per block of a plant at pace 0.
    max_gap: samples in a row that may be missing.
    read: makes the readings of the controller.
    """

    def __init__(
        self,
        bus_url: str,
        controller_node: int,
        plant_node: int | None,
        channel: int = 1,
        *,
        station: Station | None = None,
        pv_limits: tuple[float, float] | None = None,
        block: int = BLOCK,
        max_gap: int = MAX_GAP,
        read: Read = BusReading,
    ) -> None:
        self._connection = BusConnection(bus_url, controller_node, plant_node, channel, station or Station(), read)
        self.session = BusSession(self._connection, self._check_stop_request)
        self._samples = BusSamples(self._connection, self.session, self._check_stop_request, block, max_gap)
        self._pv_limits = pv_limits
        self._stop: Callable[[], Reason | None] = lambda: None
        self._commands: list[Command] = []

    def read(self, beside_tests: bool = False) -> LoopState:
        with self._connection.tuner() as tuner:
            reading = self._connection.reading(tuner)
            if not beside_tests:
                return reading.state()
        with self._connection.tuner() as tuner, tuner.retrying(BEGIN_PATIENCE_S, LOSSY_BUS_S):
            while True:
                session = tuner.number("controller_session")
                state = reading.beside_the_test() if session else reading.state()
                if tuner.number("controller_session") == session:
                    return state

    def begin(
        self,
        stop: Callable[[], Reason | None] = lambda: None,
        note_session: Callable[[int], None] = lambda session: None,
    ) -> LoopState:
        self._stop = stop
        self.session.number = 0
        try:
            with self._connection.tuner() as tuner, tuner.retrying(BEGIN_PATIENCE_S, LOSSY_BUS_S):
                self._connection.reading(tuner).identify()
                self._connection.reading(tuner).check_knows(Order.HOLD)
                self._connection.reading(tuner).compare_times()
                self._samples.take_plant(tuner)
                home = self.session.open(tuner, self._samples.pace, self._samples.sample_time_s, note_session)
                self._samples.begin(tuner)
                self._commands.clear()
                return home
        except BaseException:
            if self.session.number:  # the session may be open although the answer was lost
                with suppress(Ended), self._connection.tuner() as tuner:
                    close_session(tuner, self.session.number)
            self._release()
            raise

    @property
    def waits(self) -> bool:
        return self._samples.in_blocks

    def step(self, commands: Sequence[Command]) -> Sample:
        with self._connection.tuner() as tuner:
            self._commands += commands
            if self._samples.block_is_over:
                self.session.confirm_if_due(tuner)
                for command in self._commands:
                    self._carry_out(tuner, command)
                self._commands.clear()
                self._samples.start_block(tuner)
            return self._samples.next(tuner)

    def hold(self) -> None:
        if not hold(self._connection, self.session.number):
            with self._connection.tuner() as tuner:
                raise self.session.why_over(tuner)

    def restore(self, home: LoopState, session: int | None = None) -> Restored:
        try:
            return restore(self._connection, home, session if session is not None else self.session.number)
        finally:
            self._release()

    def accept(self, gains: Gains, instead_of: Gains) -> LoopState:
        """Accepts the gains in a short session of its own, so that an interrupted acceptance leaves one set or the
        other."""
        why: Ended | None = None
        self.session.number = 0
        try:
            try:
                with self._connection.tuner() as tuner:
                    self._connection.reading(tuner).identify()
                    self._samples.read_pace(tuner)
                    self._samples.read_sample_time(tuner)
                    held = self.session.open(tuner, self._samples.pace, self._samples.sample_time_s).gains
                    if not same_gains(held, instead_of) and not same_gains(held, gains):
                        text = f"the controller holds {held}, not {instead_of}: the gains were changed meanwhile"
                        raise Refused(Reason.GAINS_CHANGED, text)
                    self.session.order(tuner, Order.ACCEPT, *astuple(gains))
            except Ended as ended:
                why = ended
                if not self.session.number:
                    raise
            state = end_acceptance(self._connection, self.session.number, why)
        finally:
            self._release()
        if state.on_trial or not same_gains(state.gains, gains):
            raise why or Failed(Reason.RESTORE_UNCONFIRMED, f"accepted {gains}, read back {state.gains}")
        return state

    def close(self) -> None:
        self._release()
        self._connection.close()

    def _carry_out(self, tuner: Tuner, command: Command) -> None:
        """Gives the orders of a command. Their effect is known from the answers, because a status frame may be lost."""
        order = self.session.order
        match command:
            case SetSetpoint(value):
                order(tuner, Order.SETPOINT, value)
                tuner.sp = tuner.number("controller_setpoint")
            case SetMode(Mode.EXPERIMENT):
                pass  # SetRelay has started it
            case SetMode(mode):
                order(tuner, Order.MODE, mode)
                tuner.mode = mode
            case SetGains(gains):
                order(tuner, Order.TRY, *astuple(gains))
                tuner.on_trial = True
            case SetOutput(value):
                order(tuner, Order.OUTPUT, value)
            case SetPvLimits(low, high):
                order(tuner, Order.WATCH, low, high)
            case SetRelay():
                low, high = self._pv_limits or tuple(tuner.number(f"controller_pv_{end}") for end in ("low", "high"))
                order(
                    tuner, Order.RELAY, command.amplitude, command.hysteresis, command.working_output, RELAY_LONGEST,
                    low, high, command.amplitude_low or 0.0, command.average,
                )  # fmt: skip
                tuner.mode = Mode.EXPERIMENT

    def _check_stop_request(self, when: str) -> None:
        """Raises Aborted when the job is asked to stop.

        when: the present wait, in words.
        """
        reason = self._stop()
        if reason is not None:
            raise Aborted(reason, when)

    def _release(self) -> None:
        """Ends the heartbeat, and releases the plant."""
        self._connection.stop_beating()
        self._samples.release()
