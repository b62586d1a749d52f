"""The live loop: a controller and its plant on a CAN bus, as a plan sees it.

The session belongs to the controller (`controller.session`, decision 8): here it is opened, renewed, closed, and what
it left is read back. Every wait in here also sends our heartbeat and renews the lease: a service that hangs or dies
loses the loop, and the controller brings it home by itself.

A simulated plant that runs as fast as the answers come (pace 0) is run in blocks of samples: no sample is lost however
slow we are, and commands act between two blocks, so that equal seeds give equal runs.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import astuple

from loopwright.protocol.bus import BusError
from loopwright.protocol.profile import (
    FOREVER,
    Abort,
    NmtState,
    Order,
    samples_between,
)
from loopwright.protocol.station import NodeTaken, Station
from loopwright.protocol.tuner import BusSample, FailureKind, Tuner, TunerError
from loopwright.protocol.tuner_session import Lease, TunerSession
from loopwright.service.loop_state import LoopState, same_gains
from loopwright.service.loops.bus_endings import cause_of, read_back, why_over, words_of
from loopwright.service.loops.bus_reading import BusReading, not_operational
from loopwright.service.loops.loop import Restored
from loopwright.service.telemetry.metrics import SAMPLES_LOST
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Command, Mode, Sample, SetGains, SetMode, SetOutput, SetRelay, SetSetpoint
from loopwright.tuning.reasons import Aborted, Ended, Failed, Reason, Refused

WATCH_S = 1.5
"""Time of the controller's clock without our heartbeat, or without PV (at least three sampling periods), after which it
ends the session. Virtual machines were seen to stand still for 1.3 s."""
LEASE_WALL_S = 3.0
LEASE_IN_BLOCKS_S = 30.0
CONFIRM_S = 10.0
"""How often the controller is asked whether the session is still open: an SDO, which waits for its turn with others."""
PV_SILENCE_IN_BLOCKS_S = 60.0
"""A plant that we hold sends no PV, and a block may wait for a computation."""
OTHERS_S = LEASE_WALL_S + 1.0
"""How long a session of another tuner may take to end before we begin."""
HALT_S, HALT_AGAIN_S = 5.0, 0.5
"""How long a plant that is run in blocks may take to halt, and when it is told once more."""
SHORTEST_LEASE = 20
SILENCE_S = 1.0
"""Wall time without a sample (at least three sampling periods) after which the nodes are asked whether they live."""
RESTORE_PATIENCE_S = 4.0
RELAY_LONGEST = 1_000_000  # samples; plans end their relays, and so does the lease
MAX_GAP = 5
_SLICE_S = 0.05  # of a wait: after each, lease and stop are looked at
_AGAIN_S = 0.05
_HALTED_S = 0.03  # without a sample: the plant has halted

_NOT_OURS = (Abort.NO_OBJECT, Abort.NO_SUBINDEX, Abort.LENGTH, Abort.READ_ONLY, Abort.WRITE_ONLY)


class BusLoop:
    """One channel of a controller node. plant_node: the plant I/O, if it offers one to ask (a simulated one does).

    station: this process on the bus.  pv_limits: at which the relay ends in the controller; None: the PV span.
    block: samples per block of a plant at pace 0.  max_gap: samples in a row that may be missing.
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
        block: int = 10,
        max_gap: int = MAX_GAP,
    ) -> None:
        self._url = bus_url
        self._node = controller_node
        self._plant = plant_node
        self._channel = channel
        self._station = station or Station()
        self._pv_limits = pv_limits
        self._block = block
        self._max_gap = max_gap
        self._tuner: Tuner | None = None
        self._session: TunerSession | None = None
        self._held: threading.Lock | None = None
        self._halted = False
        self._stop: Callable[[], Reason | None] = lambda: None
        self._in_blocks = False
        self._pace = 1.0
        self._left = 0  # samples of the present block still to come
        self._commands: list[Command] = []
        self._sample_time_s = 0.0
        self._silence_s = SILENCE_S
        self._lease = Lease(SHORTEST_LEASE, 1, 1, 1)
        self._confirmed_at = 0.0
        self._number = 0
        """The number of the session that we have opened last; 0: there is none."""
        self._first_n: int | None = None
        self._last_n = 0
        self._passed = 0

    # -- what a Loop does

    def read(self, beside_tests: bool = False) -> LoopState:
        with self._translated() as tuner:
            reading = self._reading(tuner)
            if not beside_tests:
                return reading.state()
            while True:
                session = tuner.number("controller_session")
                state = reading.beside_the_test() if session else reading.state()
                if tuner.number("controller_session") == session:
                    return state

    def begin(
        self,
        stop: Callable[[], Reason | None] = lambda: None,
        remember: Callable[[int], None] = lambda session: None,
    ) -> LoopState:
        self._stop = stop
        self._number = 0
        try:
            with self._translated() as tuner:
                self._reading(tuner).identify()
                self._reading(tuner).compare_times()
                self._take_plant(tuner)
                home = self._open(tuner, remember)
                self._take_time(tuner)  # nobody else's test is on it any more
                tuner.drain()
                self._first_n, self._left, self._passed = None, 0, 0
                self._commands.clear()
                return home
        except BaseException:
            if self._number:  # the answer to the opening may have been lost
                with suppress(Ended), self._translated() as tuner:
                    self._close(tuner, self._number)
            self._release()
            raise

    @property
    def waits(self) -> bool:
        return self._in_blocks

    def step(self, commands: Sequence[Command]) -> Sample:
        with self._translated() as tuner:
            self._commands += commands
            if self._left <= 0:
                self._confirm_if_due(tuner)
                for command in self._commands:
                    self._carry_out(tuner, command)
                self._commands.clear()
                if self._in_blocks:
                    tuner.write("plant_samples_to_run", self._block)
                    self._left = self._block
            return self._count(self._next_sample(tuner))

    def restore(self, home: LoopState, session: int | None = None) -> Restored:
        number = session if session is not None else self._number
        give_up = self._station.monotonic() + RESTORE_PATIENCE_S
        try:
            while True:
                try:
                    with self._translated() as tuner:
                        how = self._close(tuner, number) if number else "no session was opened"
                        return read_back(self._reading(tuner), home, number, how)
                except Ended as ended:
                    if self._station.monotonic() > give_up:
                        if ended.reason is Reason.NODE_NOT_OPERATIONAL:
                            raise
                        raise Failed(Reason.RESTORE_UNCONFIRMED, ended.detail) from ended
                    self._station.sleep(_AGAIN_S)
        finally:
            self._release()

    def accept(self, gains: Gains, instead_of: Gains) -> LoopState:
        """In a short session of its own, so that an acceptance that is cut off leaves one set or the other."""
        why: Ended | None = None
        self._number = 0
        try:
            try:
                with self._translated() as tuner:
                    self._reading(tuner).identify()
                    self._pace = tuner.number("plant_pace") if self._plant is not None else 1.0
                    self._sample_time_s = tuner.number("sample_time", node=self._node) / 1e6
                    held = self._open(tuner).gains
                    if not same_gains(held, instead_of) and not same_gains(held, gains):
                        text = f"the controller holds {held}, not {instead_of}: somebody has changed the gains"
                        raise Refused(Reason.GAINS_CHANGED, text)
                    self._order(tuner, Order.ACCEPT, *astuple(gains))
            except Ended as ended:
                why = ended
                if not self._number:
                    raise
            state = self._let_go(why)
        finally:
            self._release()
        if state.on_trial or not same_gains(state.gains, gains):
            raise why or Failed(Reason.RESTORE_UNCONFIRMED, f"accepted {gains}, read back {state.gains}")
        return state

    def close(self) -> None:
        self._release()
        self._forget()

    # -- the way in

    def _take_plant(self, tuner: Tuner) -> None:
        """Waits for its turn on a plant that is run in blocks; before anything of ours is armed in the controller."""
        self._sample_time_s = tuner.number("sample_time", node=self._node) / 1e6
        self._pace = tuner.number("plant_pace") if self._plant is not None else 1.0
        self._in_blocks = self._pace == 0.0
        if not self._in_blocks or self._plant is None:
            return
        lock = self._station.plant(self._url, self._plant)
        while not lock.acquire(timeout=0.1):
            self._heed_stop(f"while another test was using plant node {self._plant:02X}h")
        self._held = lock

    def _take_time(self, tuner: Tuner) -> None:
        """Who drives the samples: the plant by its clock, or we in blocks."""
        self._silence_s = max(SILENCE_S, 3.0 * self._sample_time_s / (self._pace or math.inf))
        if self._in_blocks:
            self._halted = True
            self._halt(tuner)
        elif self._plant is not None and not tuner.number("plant_samples_to_run"):
            tuner.write("plant_samples_to_run", FOREVER)

    def _halt(self, tuner: Tuner) -> None:
        """Tells the plant more than once: one that is reset meanwhile runs again as it was started."""
        give_up = self._station.monotonic() + HALT_S
        again_at = 0.0
        while True:
            now = self._station.monotonic()
            if now >= again_at:
                tuner.write("plant_samples_to_run", 0)
                again_at = now + HALT_AGAIN_S
            if tuner.sample(_HALTED_S) is None:
                return
            self._heed_stop("while the plant was brought to a halt")
            self._confirm_if_due(tuner)
            if now > give_up:
                text = f"plant node {self._plant:02X}h runs on although it has been told to halt (2011h)"
                raise Failed(Reason.SAMPLES_LOST, text)

    def _open(self, tuner: Tuner, remember: Callable[[int], None] = lambda session: None) -> LoopState:
        """Opens our session and returns home."""

        def note(number: int) -> None:
            remember(number)
            self._number = number

        self._wait_for_others(tuner)
        tuner.hold()  # not before: a process before us may have had our node-ID, and its session would hear our beats
        self._session = TunerSession(tuner)
        self._lease = self._terms()
        try:
            self._session.open(self._lease, note)
        except TunerError as error:
            if error.kind is FailureKind.ABORT:  # there is no session: nothing to close, nothing to look after
                note(0)
            if error.code == Abort.LOCAL_CONTROL:
                text = "an RPDO has just moved the set-point: an outer loop, a ramp or a recipe drives it"
                raise Refused(Reason.SETPOINT_IS_DRIVEN, text) from error
            if error.code == Abort.DEVICE_STATE:
                raise self._in_use(tuner) from error
            raise
        self._confirmed_at = self._station.monotonic()
        tuner.keep(self._number, lambda: self._heed_stop("while other loops had their turn with the node"))
        tuner.restarted, tuner.session_is_open = False, True
        home = self._reading(tuner).home()
        if tuner.session_is_open:  # else a hand was on the loop meanwhile, and the status has said so
            tuner.mode, tuner.on_trial, tuner.sp = home.mode, False, home.sp
        return home

    def _wait_for_others(self, tuner: Tuner) -> None:
        """The session of a tuner that has died ends within its lease; that of one that lives is not ours to end."""
        give_up = self._station.monotonic() + OTHERS_S
        while tuner.number("controller_session"):
            if self._station.monotonic() > give_up:
                raise self._in_use(tuner)
            self._heed_stop("while another tuner held the loop")
            self._station.sleep(_AGAIN_S)

    def _in_use(self, tuner: Tuner) -> Refused:
        self._reading(tuner).check_controller_operational()
        holder = int(tuner.number("controller_session_holder"))
        if holder:
            return Refused(Reason.LOOP_IN_USE, f"the tuner with node-ID {holder:02X}h holds a session on this loop")
        if tuner.number("controller_on_trial"):
            text = "somebody tries other gains by hand: accept them or take them back (2120h), then repeat"
            return Refused(Reason.GAINS_CHANGED, text)
        return Refused(Reason.LOOP_IN_USE, "another tuner had this loop in the moment of the opening")

    def _terms(self) -> Lease:
        """What we pay for at a time. At pace 0 samples say nothing of time."""
        if not self._pace:
            samples, lease_s, silence_s = FOREVER, LEASE_IN_BLOCKS_S, PV_SILENCE_IN_BLOCKS_S
        else:
            samples, lease_s = math.ceil(LEASE_WALL_S * self._pace / self._sample_time_s), LEASE_WALL_S
            silence_s = max(WATCH_S, 3.0 * self._sample_time_s / self._pace)
        ms = (math.ceil(1000.0 * wait_s) for wait_s in (lease_s, silence_s, WATCH_S))
        return Lease(min(max(samples, SHORTEST_LEASE), FOREVER), *ms)

    # -- on the way

    def _carry_out(self, tuner: Tuner, command: Command) -> None:
        """What an order has brought about is known from its answer: a status frame may be lost."""
        match command:
            case SetSetpoint(value):
                self._order(tuner, Order.SETPOINT, value)
                tuner.sp = tuner.number("controller_setpoint")
            case SetMode(Mode.EXPERIMENT):
                pass  # SetRelay has started it
            case SetMode(mode):
                self._order(tuner, Order.MODE, mode)
                tuner.mode = mode
            case SetGains(gains):
                self._order(tuner, Order.TRY, *astuple(gains))
                tuner.on_trial = True
            case SetOutput(value):
                self._order(tuner, Order.OUTPUT, value)
            case SetRelay():
                low, high = self._pv_limits or tuple(tuner.number(f"controller_pv_{end}") for end in ("low", "high"))
                self._order(
                    tuner, Order.RELAY, command.amplitude, command.hysteresis, command.working_output, RELAY_LONGEST,
                    low, high, command.amplitude_low or 0.0, command.average,
                )  # fmt: skip
                tuner.mode = Mode.EXPERIMENT

    def _order(self, tuner: Tuner, order: Order, *values: float) -> None:
        assert self._session is not None
        try:
            self._session.give(order, values)
        except TunerError as error:
            if error.code in (Abort.DEVICE_STATE, Abort.INVALID_VALUE) and not self._session.is_open:
                raise self._over(tuner) from error
            raise

    def _confirm_if_due(self, tuner: Tuner) -> None:
        """Asks whether the session is still ours: the tuner renews its lease by frames without an answer, and a status
        frame that tells of its end may be lost."""
        if self._station.monotonic() - self._confirmed_at < CONFIRM_S:
            return
        assert self._session is not None
        try:
            self._session.renew()
        except TunerError as error:
            if error.code == Abort.DEVICE_STATE:
                raise self._over(tuner) from error
            raise
        self._confirmed_at = self._station.monotonic()

    def _heed_stop(self, when: str) -> None:
        reason = self._stop()
        if reason is not None:
            raise Aborted(reason, when)

    def _next_sample(self, tuner: Tuner) -> BusSample:
        give_up: float | None = None
        while True:
            found = tuner.sample(_SLICE_S)
            if tuner.restarted or not tuner.session_is_open:
                self._see_whether_it_is_over(tuner)
            if found is not None and (self._first_n is None or found.n != self._last_n):  # a frame may come twice
                return found
            now = self._station.monotonic()
            give_up = give_up or now + self._silence_s
            if now > give_up:
                raise self._silent(tuner)
            self._confirm_if_due(tuner)
            self._heed_stop("while waiting for a sample")

    def _see_whether_it_is_over(self, tuner: Tuner) -> None:
        """A status frame from before the opening may come late; the controller knows."""
        tuner.restarted, tuner.session_is_open = False, True
        if int(tuner.number("controller_session")) != self._number:
            raise self._over(tuner)

    def _over(self, tuner: Tuner) -> Ended:
        """Why our session has ended without us."""
        tuner.keep(0)
        return why_over(self._reading(tuner), self._number, self._lease.pv_silence_ms / 1000.0)

    def _silent(self, tuner: Tuner) -> Ended:
        """No samples: who is it? A node that is gone raises by its time-out."""
        reading = self._reading(tuner)
        reading.check_controller_operational()
        reading.check_plant_operational()
        if int(tuner.number("controller_session")) != self._number:
            return self._over(tuner)
        return Failed(Reason.SAMPLES_LOST, f"no sample for {self._silence_s:g} s although the nodes answer")

    def _count(self, found: BusSample) -> Sample:
        first = self._first_n is None
        if first:
            self._first_n = found.n
        passed = 1 if first else samples_between(self._last_n, found.n)
        self._last_n = found.n
        if passed < 1:
            raise Failed(Reason.SAMPLES_LOST, f"the plant started anew: sample {found.n} after {found.n - passed}")
        if passed > 1:
            SAMPLES_LOST.labels(self._url).inc(passed - 1)
        if passed > self._max_gap + 1:
            raise Failed(Reason.SAMPLES_LOST, f"{passed - 1} samples missing before sample {found.n}")
        self._left -= passed if self._in_blocks else 0
        self._passed += passed
        return Sample((self._passed - 1) * self._sample_time_s, found.sp, found.pv, found.mv, found.mode)

    # -- the way out

    def _close(self, tuner: Tuner, number: int) -> str:
        """How the session has ended, in words."""
        tuner.keep(0)
        if int(tuner.number("controller_session")) == number:
            session = TunerSession(tuner)
            session.take_up(number)
            with suppress(TunerError):  # a hand may be faster; what is read next counts
                session.close()
            if int(tuner.number("controller_session")) == number:
                raise Failed(Reason.RESTORE_UNCONFIRMED, f"session {number:08X}h could not be closed")
            return "the session was closed"
        if int(tuner.number("controller_session_last")) == number:
            return f"the controller had ended the session ({words_of(cause_of(tuner))})"
        return "the controller knows nothing of the session: it has been restarted, or others have been on it since"

    def _let_go(self, why: Ended | None) -> LoopState:
        """Closes the session of an acceptance and reads what is accepted now."""
        give_up = self._station.monotonic() + RESTORE_PATIENCE_S
        while True:
            try:
                with self._translated() as tuner:
                    self._close(tuner, self._number)
                    return self._reading(tuner).state()
            except Ended as ended:
                if self._station.monotonic() > give_up:
                    why = why or ended
                    text = "the end of the session is not confirmed, the controller ends it by itself within seconds"
                    raise type(why)(why.reason, f"{why.detail}; {text}: read the loop before going on") from ended
                self._station.sleep(_AGAIN_S)

    def _release(self) -> None:
        """Our heartbeat ends; a plant that we ran in blocks runs on by itself, and others may take it."""
        if self._tuner is not None:
            self._tuner.beating = False
            self._tuner.keep(0)
        if self._halted:
            with suppress(Ended), self._translated() as tuner:
                tuner.write("plant_samples_to_run", FOREVER)
            self._halted = False
        if self._held is not None:
            self._held.release()
            self._held = None

    def _forget(self) -> None:
        if self._tuner is not None:
            self._tuner.close()
            self._tuner = None

    # -- common

    @contextmanager
    def _translated(self) -> Iterator[Tuner]:
        """The tuner, opened when needed; what goes wrong on the bus becomes a reason of the closed list."""
        try:
            if self._tuner is None:
                self._tuner = Tuner(self._url, self._node, self._plant, self._channel, station=self._station)
            yield self._tuner
        except NodeTaken as error:
            raise Refused(Reason.LOOP_IN_USE, str(error)) from error
        except BusError as error:
            self._forget()
            raise Failed(Reason.BUS_LOST, str(error)) from error
        except OSError as error:  # an interface that disappears between two calls
            self._forget()
            text = f"bus {self._url!r} is lost ({error.strerror or error}): see that its interface is there and up"
            raise Failed(Reason.BUS_LOST, text) from error
        except TunerError as error:
            if error.kind is FailureKind.TIMEOUT:
                raise self._no_answer(error) from error
            if error.code in _NOT_OURS:
                raise Refused(Reason.DEVICE_MISMATCH, str(error)) from error
            raise Refused(Reason.BAD_INPUT, f"the controller refused: {error}") from error

    def _no_answer(self, error: TunerError) -> Failed:
        """A node that is stopped beats, and answers no SDO."""
        states = self._tuner.node_states if self._tuner is not None else {}
        for node in (self._node, self._plant):
            if node is not None and states.get(node) == NmtState.STOPPED:
                return not_operational(node, NmtState.STOPPED)
        return Failed(Reason.NODE_LOST, str(error))

    def _reading(self, tuner: Tuner) -> BusReading:
        return BusReading(tuner, self._node, self._plant, self._channel)
